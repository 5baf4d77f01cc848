# SPDX-License-Identifier: Apache-2.0
"""The page over HTTP, in a thread of its own: files of this package, the newest frame, and events as they come.

An open page is one request that does not end (server-sent events). It gets the newest state whenever it has taken the one
before: a slow one misses some, a hung one is closed, and neither holds up anything or takes memory.
"""

import asyncio
import json
import logging
import threading
import weakref
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import resources

from tornado.httpserver import HTTPServer
from tornado.iostream import StreamClosedError
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler

from starpos.errors import StarposError, one_line
from starpos_dashboard import access

PATIENCE_S = 10.0  # for a page to take what is sent
QUIET_S = 20.0  # of a connection that asks nothing
END_S = 2.0
RETRY_MS = 3000  # after which a page that lost its connection comes again
HEADER_LIMIT, BODY_LIMIT, READ_LIMIT = 1 << 14, 1 << 10, 1 << 16
SPARE_CONNECTIONS = 16  # besides six for each page, which is what a browser opens
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}


class DashboardError(StarposError):
    """The page cannot be served."""


@dataclass(eq=False)
class OpenPage:
    """A page that listens. `looks`: it shows the frame; `sent`: number of the last fix it has."""

    looks: bool
    news: asyncio.Event = field(default_factory=asyncio.Event)
    sent: int = 0


def listen(address: str, port: int) -> list:
    """Bound sockets; DashboardError with what to do where that cannot be."""
    try:
        return bind_sockets(port, address)
    except UnicodeError:
        raise DashboardError(
            f"{address[:80]!r} is no address: set the parameter address to one of this machine's"
        ) from None
    except OSError as e:
        cures = {
            98: "another program has this port: stop it, or set the parameter port",
            13: "set port above 1023",
        }
        cure = cures.get(e.errno, "set the parameter address to one of this machine's")
        raise DashboardError(
            f"{address}:{port} cannot be listened on ({one_line(e.strerror)}): {cure}"
        ) from None


def files() -> dict[str, tuple[str, bytes]]:
    """Content type and content by path: all there is to be had, so that no request ever names a file."""
    root = resources.files(__package__) / "assets"
    found = {}
    for folder, prefix in ((root, "/"), (root / "vendor", "/vendor/")):
        for entry in folder.iterdir():
            kind = TYPES.get("." + entry.name.rpartition(".")[2])
            if kind:
                found[prefix + entry.name] = kind, entry.read_bytes()
    return found | {"/": found["/index.html"]}


class DashboardServer:
    """`start`, then `show` what pages are to see, from any thread; `stop` ends it.

    sockets: of `listen`; names: under which it may be asked for; clients: pages at once.
    """

    def __init__(self, sockets: list, names: frozenset[str], clients: int):
        self.clients = clients
        self.refused = 0  # pages for which there was no place
        self.files = files()
        self.names = names
        self.frame: bytes | None = None
        self.state, self.track = "", ()
        self.open: set[OpenPage] = set()
        self.trouble = ""
        self._sockets = sockets
        self._thread = threading.Thread(target=self._run, name="dashboard", daemon=True)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ready = threading.Event()

    @property
    def port(self) -> int:
        return self._sockets[0].getsockname()[1]

    @property
    def pages(self) -> int:
        """How many are open."""
        return len(self.open)

    @property
    def looking(self) -> bool:
        """Whether one of them shows the frame."""
        return any(page.looks for page in tuple(self.open))

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()
        self._ready.wait(END_S)

    def show(self, state: str, track: tuple) -> None:
        """The newest state as JSON, and the track of which each page gets what it has not."""
        self.state, self.track = state, track
        self._call(self._wake)

    def show_frame(self, jpeg: bytes | None) -> None:
        self.frame = jpeg

    def stop(self) -> None:
        """Close every connection and end the thread."""
        if self._loop is not None:
            self._call(self._ended.set)
            self._thread.join(END_S)

    def _call(self, function):
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function)

    def _wake(self):
        for page in self.open:
            page.news.set()

    def _run(self):
        try:
            asyncio.run(self._serve())
        except Exception as e:
            self.trouble = f"the server ended ({type(e).__name__}: {one_line(e)})"

    async def _serve(self):
        logging.getLogger("tornado").setLevel(logging.CRITICAL)  # what a client sends is no line in our log
        self._ended = asyncio.Event()
        application = Application(
            [("/events", Events), ("/frame.jpg", FrameReply), ("/.*", File)],
            server=self,
            log_function=lambda handler: None,
            compress_response=False,
        )
        http = BoundedServer(
            application,
            idle_connection_timeout=QUIET_S,
            body_timeout=QUIET_S,
            max_header_size=HEADER_LIMIT,
            max_body_size=BODY_LIMIT,
            max_buffer_size=READ_LIMIT,
            chunk_size=READ_LIMIT // 4,
        )
        http.limit = lambda: 6 * self.clients + SPARE_CONNECTIONS
        http.add_sockets(self._sockets)
        self._loop = asyncio.get_running_loop()
        self._ready.set()
        await self._ended.wait()
        http.stop()
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(http.close_all_connections(), END_S / 2)


class BoundedServer(HTTPServer):
    """Closes at once what comes beyond `limit()` connections."""

    def initialize(self, *args, **options):
        super().initialize(*args, **options)
        self._streams = weakref.WeakSet()

    def handle_stream(self, stream, address):
        if sum(not s.closed() for s in self._streams) >= self.limit():
            stream.close()
            return
        self._streams.add(stream)
        super().handle_stream(stream, address)


class Reply(RequestHandler):
    """Reading only, from here only; errors are one sentence."""

    @property
    def server(self) -> DashboardServer:
        return self.settings["server"]

    def set_default_headers(self):
        self.clear_header("Server")
        for name, value in access.HEADERS.items():
            self.set_header(name, value)
        self.set_header("Cache-Control", "no-store")

    def prepare(self):
        headers = self.request.headers
        if self.request.method not in ("GET", "HEAD"):
            self.set_header("Allow", "GET, HEAD")
            raise HTTPError(405, reason="this page only shows: GET and HEAD")
        if not access.host_is_known(headers.get("Host", ""), self.server.names):
            raise HTTPError(
                421, reason="not served under this name: the parameter hosts lists those that are"
            )
        if access.comes_from_elsewhere(headers.get("Sec-Fetch-Site"), headers.get("Sec-Fetch-Mode")):
            raise HTTPError(403, reason="not for pages of other sites")

    def write_error(self, status_code, **about):
        if status_code == 405:
            self.set_header("Allow", "GET, HEAD")
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code}: {self._reason}\n")

    async def deliver(self) -> bool:
        """Send what was written; False where the other side is gone, or takes too long and is closed."""
        try:
            await asyncio.wait_for(self.flush(), PATIENCE_S)
            return True
        except asyncio.TimeoutError:
            self.request.connection.stream.close()
        except StreamClosedError:
            pass
        return False

    async def send(self, kind: str, content: bytes):
        """The whole reply; 304 where the browser has it already."""
        self.set_header("Content-Type", kind)
        try:
            await asyncio.wait_for(self.finish(content), PATIENCE_S)
        except asyncio.TimeoutError:
            self.request.connection.stream.close()
        except StreamClosedError:
            pass


class File(Reply):
    """One of the package's."""

    async def get(self):
        kind, content = self.server.files.get(self.request.path, ("", b""))
        if not kind:
            raise HTTPError(404, reason="there is no such page")
        self.set_header("Cache-Control", "no-cache")
        await self.send(kind, content)

    head = get


class FrameReply(Reply):
    """The newest annotated frame."""

    async def get(self):
        if self.server.frame is None:
            raise HTTPError(404, reason="there is no frame now")
        await self.send("image/jpeg", self.server.frame)

    head = get


class Events(Reply):
    """State and track, as they change."""

    _page: OpenPage | None = None

    def head(self):
        self.set_header("Content-Type", "text/event-stream")

    async def get(self):
        self.set_header("Content-Type", "text/event-stream")
        self.write(f"retry: {RETRY_MS}\n\n")
        if self.server.pages >= self.server.clients:
            self.server.refused += 1
            self.write(f"event: full\ndata: {self.server.clients}\n\n")
            return
        self._page = page = OpenPage(looks=self.request.query == "frame")
        self.server.open.add(page)
        try:
            while await self.deliver():
                await page.news.wait()
                page.news.clear()
                self._write_news(page)
        finally:
            self.server.open.discard(page)

    def _write_news(self, page: OpenPage):
        points = [p for p in self.server.track if p[0] > page.sent]
        if points:
            whole = {"begin": page.sent == 0, "points": points}
            self.write(f"event: track\ndata: {json.dumps(whole, separators=(',', ':'))}\n\n")
            page.sent = points[-1][0]
        self.write(f"event: state\ndata: {self.server.state}\n\n")

    def on_connection_close(self):
        if self._page:
            self._page.news.set()  # which it cannot deliver

# SPDX-License-Identifier: Apache-2.0
"""Rules of access: which requests are answered, and how a browser may show the page.

HTTP server of the page, in a thread of its own: files of this package, the newest frame, and events.

An open page is one request that does not end (server-sent events). A page gets the newest state whenever it has taken the
one before. So a slow page misses some states, and a hung page is closed; neither delays anything or takes memory.
"""

import asyncio
import ipaddress
import json
import logging
import re
import socket
import threading
import weakref
from collections.abc import Awaitable, Callable
from contextlib import suppress
from importlib import resources
from typing import Any

from starpos.errors import StarposError, one_line
from starpos.report.coast import COAST_FILE

try:
    from tornado.http1connection import HTTP1Connection
    from tornado.httpserver import HTTPServer
    from tornado.iostream import IOStream, StreamClosedError
    from tornado.netutil import bind_sockets
    from tornado.web import Application, HTTPError, RequestHandler
except ImportError:
    raise StarposError(
        "the dashboard needs tornado, which is not installed: sudo apt install python3-tornado, "
        "or pip install tornado"
    ) from None

HOST_NAME = re.compile(r"\[[0-9a-fA-F:.%]+\]|[A-Za-z0-9._-]+")
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


def own_names() -> frozenset[str]:
    name = socket.gethostname().lower()
    return frozenset({"localhost", name, f"{name}.local"})


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def host_is_known(header: str, names: frozenset[str]) -> bool:
    """Whether a request's Host is a plain address or one of the names.

    A foreign page whose name was changed to lead here (DNS rebinding) sends its own name.
    """
    match = re.fullmatch(rf"({HOST_NAME.pattern})(:\d{{1,5}})?", header)
    if not match:
        return False
    name = match[1].strip("[]").lower().rstrip(".")
    try:
        ipaddress.ip_address(name)
        return True
    except ValueError:
        return name in names


def comes_from_elsewhere(site: str | None, mode: str | None) -> bool:
    """Whether another site's page asks, except by a link, judged by a browser's Sec-Fetch-Site and Sec-Fetch-Mode."""
    return site not in (None, "none", "same-origin") and mode != "navigate"


# For a page to take what is sent.
PATIENCE_S = 10.0
# Time after which a connection without a request is closed.
QUIET_S = 20.0
END_S = 2.0
# Time after which a page that lost its connection tries again.
RETRY_MS = 3000
HEADER_LIMIT, BODY_LIMIT, READ_LIMIT = 1 << 14, 1 << 10, 1 << 16
# Besides the six connections for each page that a browser opens.
SPARE_CONNECTIONS = 16
# (number, latitude, longitude) of fixes.
Track = tuple[tuple[int, float, float], ...]
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}


def listen(address: str, port: int) -> list[socket.socket]:
    """Bind the sockets; StarposError that says what to do if they cannot be bound."""
    try:
        return bind_sockets(port, address)
    except UnicodeError:
        raise StarposError(
            f"{address[:80]!r} is no address: set the parameter address to one of this machine's"
        ) from None
    except OSError as e:
        cures = {
            98: "another program has this port: stop it, or set the parameter port",
            13: "set port above 1023",
        }
        cure = cures.get(e.errno or 0, "set the parameter address to one of this machine's")
        raise StarposError(
            f"{address}:{port} cannot be listened on ({one_line(e.strerror)}): {cure}"
        ) from None


def files() -> dict[str, tuple[str, bytes]]:
    """Read content type and content of all files, by path, so that no request can name any other file.

    The coast lines are the same as in starpos's reports.
    """
    root = resources.files(__package__) / "assets"
    found = {}
    for folder, prefix in ((root, "/"), (root / "vendor", "/vendor/")):
        for entry in folder.iterdir():
            kind = TYPES.get("." + entry.name.rpartition(".")[2])
            if kind:
                found[prefix + entry.name] = kind, entry.read_bytes()
    found["/land-110m.json"] = TYPES[".json"], COAST_FILE.read_bytes()
    return found | {"/": found["/index.html"]}


class DashboardServer:
    """Serves the page from `start` to `stop`; any thread may `show` a new state.

    sockets: from `listen`.  names: host names under which it is served.  clients: maximum number of pages at once.
    """

    def __init__(self, sockets: list[socket.socket], names: frozenset[str], clients: int) -> None:
        self.clients = clients
        # Pages for which there was no place.
        self.refused = 0
        self.files = files()
        self.names = names
        self.frame: bytes | None = None
        self.state = ""
        self.track: Track = ()
        self.open: set[Events] = set()
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
        return len(self.open)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()
        self._ready.wait(END_S)

    def show(self, state: str, track: Track) -> None:
        """Send the newest state (JSON), and the part of the track that a page does not have yet."""
        self.state, self.track = state, track
        self._call(self._wake)

    def stop(self) -> None:
        """Close every connection and end the thread."""
        if self._loop is not None:
            self._call(self._ended.set)
            self._thread.join(END_S)

    def _call(self, function: Callable[[], object]) -> None:
        if self._loop is None:
            return
        # The loop may have ended.
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function)

    def _wake(self) -> None:
        for page in self.open:
            page.news.set()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as e:
            self.trouble = f"the server ended ({type(e).__name__}: {one_line(e)})"

    async def _serve(self) -> None:
        # A wrong request of a client is not worth a line in our log.
        logging.getLogger("tornado").setLevel(logging.CRITICAL)
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
    """Closes at once every connection beyond `limit()`."""

    limit: Callable[[], int]

    def initialize(self, *args: Any, **options: Any) -> None:
        super().initialize(*args, **options)
        self._streams: weakref.WeakSet[IOStream] = weakref.WeakSet()

    def handle_stream(self, stream: IOStream, address: tuple) -> None:
        if sum(not s.closed() for s in self._streams) >= self.limit():
            stream.close()
            return
        self._streams.add(stream)
        super().handle_stream(stream, address)


class Reply(RequestHandler):
    """Answers requests to read only, and only from this page; an error is one sentence."""

    @property
    def server(self) -> DashboardServer:
        return self.settings["server"]

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        for name, value in HEADERS.items():
            self.set_header(name, value)
        self.set_header("Cache-Control", "no-store")

    def prepare(self) -> None:
        headers = self.request.headers
        if self.request.method not in ("GET", "HEAD"):
            raise HTTPError(405, reason="this page only shows: GET and HEAD")
        if not host_is_known(headers.get("Host", ""), self.server.names):
            raise HTTPError(
                421, reason="not served under this name: the parameter hosts lists those that are"
            )
        if comes_from_elsewhere(headers.get("Sec-Fetch-Site"), headers.get("Sec-Fetch-Mode")):
            raise HTTPError(403, reason="not for pages of other sites")

    def write_error(self, status_code: int, **about: Any) -> None:
        if status_code == 405:
            self.set_header("Allow", "GET, HEAD")
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code}: {self._reason}\n")

    async def sent(self, sending: Awaitable[None]) -> bool:
        """Wait for what is sent; False if the other side is gone, or takes too long and is closed."""
        with suppress(StreamClosedError):
            try:
                await asyncio.wait_for(sending, PATIENCE_S)
                return True
            except asyncio.TimeoutError:
                # without waiting for the other side
                if isinstance(self.request.connection, HTTP1Connection):
                    self.request.connection.stream.close()
        return False

    async def send(self, kind: str, content: bytes) -> None:
        """Send the whole reply; 304 if the browser has it already."""
        self.set_header("Content-Type", kind)
        await self.sent(self.finish(content))


class File(Reply):
    """Answers with a file of this package."""

    async def get(self) -> None:
        kind, content = self.server.files.get(self.request.path, ("", b""))
        if not kind:
            raise HTTPError(404, reason="there is no such page")
        self.set_header("Cache-Control", "no-cache")
        await self.send(kind, content)

    head = get


class FrameReply(Reply):
    """Answers with the newest annotated frame."""

    async def get(self) -> None:
        if self.server.frame is None:
            raise HTTPError(404, reason="there is no frame now")
        await self.send("image/jpeg", self.server.frame)

    head = get


class Events(Reply):
    """Sends state and track as they change, to a page that is open."""

    def initialize(self) -> None:
        self.news = asyncio.Event()
        # Number of the last fix that was sent.
        self._sent_fix = 0

    def head(self) -> None:
        self.set_header("Content-Type", "text/event-stream")

    async def get(self) -> None:
        self.set_header("Content-Type", "text/event-stream")
        self.write(f"retry: {RETRY_MS}\n\n")
        if self.server.pages >= self.server.clients:
            self.server.refused += 1
            self.write(f"event: full\ndata: {self.server.clients}\n\n")
            return
        self.server.open.add(self)
        try:
            while await self.sent(self.flush()):
                await self.news.wait()
                self.news.clear()
                self._write_news()
        finally:
            self.server.open.discard(self)

    def _write_news(self) -> None:
        points = [p for p in self.server.track if p[0] > self._sent_fix]
        if points:
            whole = {"begin": self._sent_fix == 0, "points": points}
            self.write(f"event: track\ndata: {json.dumps(whole, separators=(',', ':'))}\n\n")
            self._sent_fix = points[-1][0]
        self.write(f"event: state\ndata: {self.server.state}\n\n")

    def on_connection_close(self) -> None:
        # The page's loop wakes up, cannot deliver, and ends.
        self.news.set()

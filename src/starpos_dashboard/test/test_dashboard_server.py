# SPDX-License-Identifier: Apache-2.0
"""The page's server against clients that ask for too much, take too little, or come from elsewhere."""

import http.client
import json
import resource
import socket
from contextlib import ExitStack, closing

import pytest

from starpos_dashboard import server as access
from starpos_testing.lacking import require
from starpos_testing.patience import WAIT_S, until

SECRETS = ("/../setup.py", "/..%2fserver.py", "/vendor/../../server.py", "//etc/passwd", "/assets/index.html",
           "/vendor/d3-geo.LICENSE", "/%00", "/index.html/..", "/frame.jpg")  # fmt: skip


@pytest.fixture
def server():
    require("tornado")
    from starpos_dashboard.server import DashboardServer, listen

    server = DashboardServer(listen("127.0.0.1", 0), access.own_names() | {"robot.example"}, clients=3)
    server.start()
    yield server
    server.stop()
    assert not server.alive


@pytest.fixture
def server_of_little_patience(monkeypatch, server):
    from starpos_dashboard import server as module

    monkeypatch.setattr(module, "QUIET_S", 0.2)
    impatient = module.DashboardServer(module.listen("127.0.0.1", 0), access.own_names(), clients=3)
    impatient.start()
    yield impatient
    impatient.stop()


def ask(server, path="/", method="GET", **headers):
    """Ask for a page: (status, headers, body)."""
    with closing(http.client.HTTPConnection("127.0.0.1", server.port, timeout=WAIT_S)) as connection:
        connection.request(method, path, headers={k.replace("_", "-"): v for k, v in headers.items()})
        reply = connection.getresponse()
        return reply.status, reply.headers, reply.read()


class Viewer:
    """A page that listens, as a browser does; `events` yields (name, data)."""

    def __init__(self, server, path="/events"):
        self.socket = socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S)
        self.socket.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost:{server.port}\r\n\r\n".encode())
        self.lines = self.socket.makefile("r", newline="\n")

    def events(self):
        name = ""
        for line in self.lines:
            if line.startswith("event: "):
                name = line[7:].strip()
            elif line.startswith("data: "):
                yield name, json.loads(line[6:])

    def close(self):
        self.lines.close()
        self.socket.close()


def wait(server, condition):
    """Wait until it comes true; each question gives the server's thread a turn."""
    until(lambda: condition() or not ask(server, "/icon.svg"))


def served(server) -> bool:
    try:
        return ask(server)[0] == 200
    except (OSError, http.client.HTTPException):
        return False


def test_the_page_and_all_it_names_are_there(server):
    status, headers, page = ask(server)
    assert status == 200 and headers["Content-Type"] == "text/html; charset=utf-8"
    for path, kind in (
        ("/main.js", "text/javascript"),
        ("/style.css", "text/css"),
        ("/vendor/d3-geo.min.js", "text/"),
        ("/land-110m.json", "application/json"),
    ):
        status, headers, _ = ask(server, path)
        assert status == 200 and headers["Content-Type"].startswith(kind)
    assert (
        b"http://" not in page
        and b"https://" not in page
        and b"<script>" not in page
        and b"style=" not in page
    )


def test_all_files_together_are_small(server):
    assert sum(len(content) for _, content in server.files.values()) < 250_000


def test_the_rules_go_with_every_answer(server):
    for path in ("/", "/main.js", "/nowhere", "/frame.jpg"):
        _, headers, _ = ask(server, path)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "script-src 'self'" in policy and "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff" and headers["DashboardServer"] is None
        assert headers["Access-Control-Allow-Origin"] is None


@pytest.mark.parametrize("path", SECRETS)
def test_nothing_else_is_to_be_had(server, path):
    status, _, body = ask(server, path)
    assert status == 404 and len(body) < 100


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"])
def test_it_only_shows(server, method):
    for path in ("/", "/events", "/frame.jpg"):
        status, headers, _ = ask(server, path, method)
        assert (status, headers["Allow"]) == (405, "GET, HEAD")


def test_head_is_get_without_the_body(server):
    for path in ("/", "/events"):
        status, headers, body = ask(server, path, "HEAD")
        assert (status, body) == (200, b"") and headers["Content-Type"]


def test_a_file_the_browser_has_is_not_sent_again(server):
    _, headers, _ = ask(server, "/main.js")
    assert ask(server, "/main.js", If_None_Match=headers["Etag"])[0] == 304


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "[evil]"])
def test_a_foreign_name_is_refused(server, host):
    assert ask(server, Host=host)[0] == 421
    assert ask(server, "/events", Host=host)[0] == 421


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:1", "127.0.0.1:99", "10.0.0.7", "[::1]:80", "robot.example"]
)
def test_its_own_names_and_plain_addresses_are_served(server, host):
    assert ask(server, Host=host)[0] == 200


def test_a_page_of_another_site_gets_nothing_but_may_link_here(server):
    assert ask(server, "/frame.jpg", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors")[0] == 403
    assert ask(server, "/events", Sec_Fetch_Site="same-site", Sec_Fetch_Mode="cors")[0] == 403
    assert ask(server, "/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200


def test_a_viewer_gets_the_state_and_of_the_track_what_it_has_not(server):
    with closing(Viewer(server)) as viewer:
        wait(server, lambda: server.pages == 1)
        server.show('{"a":1}', ((1, 5.0, 6.0), (2, 5.5, 6.5)))
        events = viewer.events()
        assert next(events) == ("track", {"begin": True, "points": [[1, 5.0, 6.0], [2, 5.5, 6.5]]})
        assert next(events) == ("state", {"a": 1})
        server.show('{"a":2}', ((2, 5.5, 6.5), (3, 7.0, 8.0)))
        assert next(events) == ("track", {"begin": False, "points": [[3, 7.0, 8.0]]})
        assert next(events) == ("state", {"a": 2})
    wait(server, lambda: server.pages == 0)


def test_the_newest_frame_is_served_and_gone_when_it_is_taken_away(server):
    server.frame = b"\xff\xd8jpeg"
    status, headers, body = ask(server, "/frame.jpg?7")
    assert (status, body) == (200, b"\xff\xd8jpeg") and headers["Cache-Control"] == "no-store"
    server.frame = None
    assert ask(server, "/frame.jpg")[0] == 404


def test_one_page_too_many_is_told_so_and_the_others_go_on(server):
    with ExitStack() as stack:
        viewers = [stack.enter_context(closing(Viewer(server))) for _ in range(3)]
        wait(server, lambda: server.pages == 3)
        late = stack.enter_context(closing(Viewer(server)))
        assert next(late.events()) == ("full", 3)
        assert server.refused == 1 and server.pages == 3
        server.show("{}", ())
        assert all(next(v.events()) == ("state", {}) for v in viewers)


def test_a_hung_page_holds_nobody_up_and_takes_no_memory(server):
    """It never reads: 100 MB are shown meanwhile, and another page gets the last of them."""
    with closing(Viewer(server)) as hung, closing(Viewer(server)) as quick:
        hung.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        wait(server, lambda: server.pages == 2)
        events, filler = quick.events(), "x" * 100_000
        server.show(json.dumps({"n": -1, "x": filler}), ())
        next(events)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for n in range(1000):
            server.show(json.dumps({"n": n, "x": filler}), ())
        assert any(data["n"] == 999 for _, data in events)
        # In kB.
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000


def test_a_page_that_takes_nothing_is_closed(server, monkeypatch):
    monkeypatch.setattr("starpos_dashboard.server.PATIENCE_S", 0.2)
    with closing(Viewer(server)) as hung:
        hung.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        wait(server, lambda: server.pages == 1)
        server.show(json.dumps("x" * 20_000_000), ())
        wait(server, lambda: server.pages == 0)


def test_connections_have_a_limit_and_places_come_free_again(server):
    limit = 6 * server.clients + 16
    with ExitStack() as stack:
        for _ in range(limit):
            stack.enter_context(closing(socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S)))
        with closing(socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S)) as one_more:
            # Closed at once.
            assert one_more.recv(1) == b""
    until(lambda: served(server))


def test_a_connection_that_says_nothing_is_closed(server_of_little_patience):
    with closing(
        socket.create_connection(("127.0.0.1", server_of_little_patience.port), timeout=WAIT_S)
    ) as idle:
        idle.sendall(b"GET / HTTP/1.1\r\nHost: loc")
        assert idle.recv(1) == b""


@pytest.mark.parametrize(
    "junk",
    [
        b"\x00\xff\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost@evil\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: " + b"a" * 60_000 + b"\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9999999999\r\n\r\n",
    ],
)
def test_junk_ends_its_own_connection_only(server, junk):
    with closing(socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S)) as connection:
        connection.sendall(junk)
        try:
            answer = connection.recv(64)
        except ConnectionResetError:
            answer = b""
        assert answer == b"" or answer.startswith(b"HTTP/1.1 4")
    assert ask(server)[0] == 200


# tornado leaves the socket that it could not bind to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning")
def test_a_port_in_use_is_said_in_a_sentence(server):
    from starpos.errors import StarposError
    from starpos_dashboard.server import listen

    with pytest.raises(StarposError, match=f"127.0.0.1:{server.port} .*another program has this port"):
        listen("127.0.0.1", server.port)
    with pytest.raises(StarposError, match="set the parameter address"):
        listen("192.0.2.1", 0)
    with pytest.raises(StarposError, match="set the parameter address"):
        listen("no.such.name.invalid", 0)
    with pytest.raises(StarposError, match="is no address: set the parameter address"):
        listen("x" * 5000, 0)


def test_it_ends_while_pages_are_open(server):
    with closing(Viewer(server)) as viewer:
        wait(server, lambda: server.pages == 1)
        server.stop()
        assert not server.alive
        # To its end.
        assert viewer.lines.read().startswith("HTTP/1.1 200")


def test_only_loopback_addresses_are_loopback():
    assert all(map(access.is_loopback, ("127.0.0.1", "127.9.9.9", "::1", "localhost")))
    assert not any(map(access.is_loopback, ("0.0.0.0", "::", "192.168.1.5", "robot.example", "")))

# SPDX-License-Identifier: Apache-2.0
"""Tycho-2's original files from a mirror: fetched whole, resumed, checked, and refused where they are others."""

import hashlib
import socket
import tarfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from starpos.errors import CatalogueError
from starpos.sky import deeper, tycho2
from starpos_testing.command_line import run
from starpos_testing.skies.tycho2_files import write_sky


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """The bytes of an archive of the original files of a small sky."""
    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("tycho2")
    files = write_sky(
        folder / "originals", rng.uniform(0, 360, 200), rng.uniform(-80, 80, 200), rng.uniform(5, 12, 200)
    )
    with tarfile.open(folder / "made.tar.xz", "w:xz") as made:
        made.add(files, arcname="tycho2-2")
    return (folder / "made.tar.xz").read_bytes()


class Mirror:
    """A server of one file; it keeps what was asked for: path and range.

    cut: number of bytes after which it breaks off.  ranges: whether it knows them.
    """

    def __init__(self, content, cut=None, ranges=True):
        mirror = self
        self.asked = []

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                mirror.asked.append((self.path, self.headers["Range"]))
                if not self.path.endswith(tycho2.IN_MIRROR):
                    return self.send_error(404)
                first = 0
                if ranges and self.headers["Range"]:
                    first = int(self.headers["Range"].removeprefix("bytes=").rstrip("-"))
                self.send_response(206 if first else 200)
                self.send_header("Content-Length", str(len(content) - first))
                self.end_headers()
                self.wfile.write(content[first:cut])

            def log_message(self, *_):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/debian"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def mirror():
    """Makes a Mirror."""
    made = []

    def make(*args, **kwargs):
        made.append(Mirror(*args, **kwargs))
        return made[-1]

    yield make
    for m in made:
        m.server.shutdown()
        m.server.server_close()


@pytest.fixture(autouse=True)
def own_cache(archive, tmp_path, monkeypatch):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tycho2, "SHA256", hashlib.sha256(archive).hexdigest())
    monkeypatch.setattr(tycho2, "BYTES", len(archive))
    monkeypatch.setattr(tycho2, "CHUNK_BYTES", 1000)
    deeper.KEPT.forget()
    yield tmp_path / "cache" / "starpos"
    deeper.KEPT.forget()


def test_one_command_brings_the_deeper_catalogue_and_leaves_nothing_else(
    archive, mirror, own_cache, monkeypatch, capsys
):
    there = mirror(archive)
    monkeypatch.setattr(tycho2, "MIRRORS", (there.url,))
    status, _, said = run(capsys, "catalogue", "deepen", "--fetch")
    assert status == 0 and "small fields take them from now on" in said[-1]
    assert len(deeper.kept()) >= 200
    assert [p.name for p in own_cache.iterdir()] == [f"{deeper.KEPT.prefix}tycho2"]
    assert there.asked == [(f"/debian/{tycho2.IN_MIRROR}", None)]


def test_a_transfer_that_broke_off_goes_on_where_it_was(archive, mirror):
    cut, whole = mirror(archive, cut=3000), mirror(archive)
    with pytest.raises(CatalogueError, match=rf"it ended after 3000 of {len(archive)} bytes|broke off"):
        tycho2.fetch(cut.url)
    shares = []
    path = tycho2.fetch(whole.url, lambda what, done: shares.append(done))
    assert path.read_bytes() == archive
    assert [asked for _, asked in whole.asked] == ["bytes=3000-"]
    assert shares[0] > 3000 / len(archive) and shares[-1] == 1.0


def test_a_server_without_ranges_sends_all_again(archive, mirror):
    with pytest.raises(CatalogueError):
        tycho2.fetch(mirror(archive, cut=3000).url)
    assert tycho2.fetch(mirror(archive, ranges=False).url).read_bytes() == archive


def test_where_the_first_mirror_fails_the_second_goes_on(archive, mirror, monkeypatch):
    cut, whole = mirror(archive, cut=5000), mirror(archive)
    monkeypatch.setattr(tycho2, "MIRRORS", (cut.url, whole.url))
    assert tycho2.fetch().read_bytes() == archive
    assert [asked for _, asked in whole.asked] == ["bytes=5000-"]


@pytest.mark.parametrize("change", [lambda a: a[:-1] + b"\0", lambda a: a + b"more", lambda a: a[:5000]])
def test_other_bytes_are_refused_and_no_catalogue_is_made(change, archive, mirror, capsys):
    status, _, (said,) = run(capsys, "catalogue", "deepen", "--fetch", mirror(change(archive)).url)
    assert status == 2 and tycho2.IN_MIRROR in said and "give another mirror of Debian" in said
    assert deeper.kept() is None
    assert tycho2.fetch(mirror(archive).url).read_bytes() == archive


def test_the_address_of_the_file_itself_will_do(archive, tmp_path):
    (tmp_path / "copy.tar.xz").write_bytes(archive)
    assert tycho2.fetch((tmp_path / "copy.tar.xz").as_uri()).read_bytes() == archive


def test_a_proxy_of_the_environment_is_asked(archive, mirror, monkeypatch):
    proxy = mirror(archive)
    monkeypatch.setenv("http_proxy", proxy.url.removesuffix("/debian"))
    monkeypatch.delenv("no_proxy", raising=False)
    assert tycho2.fetch("http://mirror.invalid/debian").read_bytes() == archive
    assert proxy.asked == [(f"http://mirror.invalid/debian/{tycho2.IN_MIRROR}", None)]


def test_what_cannot_be_reached_says_what_to_do(mirror, archive):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        with pytest.raises(CatalogueError, match=r"refused: check the network, or give another mirror"):
            tycho2.fetch(f"http://127.0.0.1:{closed.getsockname()[1]}/debian")
    with pytest.raises(CatalogueError, match="the server answers 404"):
        tycho2.fetch(mirror(archive).url + "/pool.xz")
    with pytest.raises(CatalogueError, match="unknown url type"):
        tycho2.fetch("gopher://mirror.invalid/debian")
    with pytest.raises(CatalogueError, match="no URL of a mirror"):
        tycho2.fetch("mirror.invalid/debian")


def test_two_do_not_fetch_at_once(archive, mirror):
    path = tycho2.fetch(mirror(archive).url)
    there = mirror(archive).url
    with (
        open(path, "ab") as other,
        tycho2._alone(other, path),
        pytest.raises(CatalogueError, match="another process fetches it"),
    ):
        tycho2.fetch(there)


def test_a_cache_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(CatalogueError, match="cannot be written"):
        tycho2.fetch("http://mirror.invalid/debian")


def test_the_command_wants_either_files_or_a_mirror(capsys):
    assert run(capsys, "catalogue", "deepen")[0] == 2
    assert run(capsys, "catalogue", "deepen", "folder", "--fetch")[0] == 2

# SPDX-License-Identifier: Apache-2.0
import os
import socket
import stat

import pytest

from starpos import files


@pytest.fixture(params=["pipe", "socket", "device", "link to a pipe"])
def other_thing(request, tmp_path):
    """The path of what is neither a file nor a folder."""
    path = tmp_path / "thing"
    if request.param == "pipe":
        os.mkfifo(path)
    elif request.param == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    elif request.param == "device":
        path.symlink_to("/dev/null")
    else:
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to("pipe")
    return path


def test_what_is_no_regular_file_is_refused_at_once(other_thing):
    with pytest.raises(OSError, match="no regular file") as raised:
        files.open_regular(other_thing)
    assert raised.value.strerror.startswith("it is a pipe")


def test_a_pipe_that_takes_the_place_of_a_file_while_it_is_opened_does_not_hang(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"x")
    os.mkfifo(tmp_path / "pipe")
    status = os.stat(tmp_path / "file")
    monkeypatch.setattr(files.os, "stat", lambda path: status)
    with pytest.raises(OSError, match="no regular file"):
        files.open_regular(tmp_path / "pipe")


def test_a_folder_and_names_of_no_file(tmp_path):
    with pytest.raises(IsADirectoryError):
        files.open_regular(tmp_path)
    for name in ("none", "a\0b"):
        with pytest.raises(FileNotFoundError):
            files.open_regular(tmp_path / name)


def test_a_file_is_read_up_to_its_limit(tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    assert files.read_regular(tmp_path / "file", 5) == b"12345"
    with pytest.raises(OSError, match="5 bytes, and may have 4"):
        files.read_regular(tmp_path / "file", 4)


def test_a_link_stays_one_when_it_is_written_through(tmp_path):
    store, here = tmp_path / "store", tmp_path / "here"
    store.mkdir()
    here.mkdir()
    (store / "real").write_bytes(b"old")
    (here / "link").symlink_to("../store/real")
    (here / "link of link").symlink_to("link")
    (here / "leads nowhere yet").symlink_to("../store/new")
    for name in ("link", "link of link", "leads nowhere yet"):
        files.write_whole(here / name, name.encode())
        assert (here / name).is_symlink() and (here / name).read_bytes() == name.encode()
    assert {p.name for p in store.iterdir()} == {"real", "new"}
    assert len(list(here.iterdir())) == 3


def test_nothing_but_a_file_is_written_over(other_thing):
    with pytest.raises(OSError, match="no regular file"):
        files.write_whole(other_thing, b"new")
    assert not stat.S_ISREG(os.stat(other_thing).st_mode)


def test_a_ring_of_links_is_not_replaced(tmp_path):
    ring = tmp_path / "ring"
    ring.symlink_to(ring)
    with pytest.raises(OSError, match="symbolic links"):
        files.write_whole(ring, b"new")
    assert ring.is_symlink()
    with pytest.raises(OSError, match="symbolic links"):
        files.open_regular(ring)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        files.write_whole(tmp_path / "file", b"new")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_bytes() == b"old"

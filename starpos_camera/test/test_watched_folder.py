# SPDX-License-Identifier: Apache-2.0
"""Files that come into a folder: each once, whole, in order, at a bounded cost; and `files.watch` on top of it."""

import os
import resource
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import attempts
import pytest
from attempts import made
from sensor_msgs.msg import Image

from starpos.errors import FrameError, StarposError
from starpos.simulation.scene import write_fits
from starpos_camera.sources import files
from starpos_camera.sources.files import MAX_LOOKED_AT, PATIENCE, Files, WatchedFolder
from starpos_camera.sources.source import CaptureError, CaptureSettings, NothingYet
from starpos_testing.patience import WAIT_S

REST_S = 2.0
SETTINGS = CaptureSettings(None, None, 5.0)
OK, ERROR = 0, 2


class Clock:
    """Seconds that pass on command."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


class Watch:
    """A watched folder that is done with all it gives, one look after another."""

    def __init__(self, path):
        self.path, self.clock = path, Clock()
        self.folder = WatchedFolder(path, lambda name: name.endswith(".fits"), REST_S, self.clock)

    def look(self, after_s=0.0):
        """The name of the file that is there after some seconds, or None; it stays in use."""
        self.clock.now += after_s
        found = self.folder.next()
        return found and found[0].name

    def take(self, after_s=REST_S):
        """The names that come in looks without a pause, after two with one."""
        names = [self.look(), self.look(after_s)]
        while names[-1]:
            self.folder.done(self.path / names[-1])
            names.append(self.look())
        return [name for name in names if name]


@pytest.fixture
def watch(tmp_path):
    """A folder with old.fits in it, looked at once."""
    (tmp_path / "in").mkdir()
    put(tmp_path / "in" / "old.fits")
    watch = Watch(tmp_path / "in")
    assert watch.take() == []
    return watch


def put(path, age_s=0.0, content=b"x"):
    """A file as of some seconds ago."""
    path.write_bytes(content)
    moment = time.time() - age_s
    os.utime(path, (moment, moment))


def test_what_was_there_is_not_new_and_what_comes_is_taken_once(watch):
    put(watch.path / "a.fits")
    put(watch.path / "a.txt")
    # Not at rest yet.
    assert watch.look() is None
    assert watch.take() == ["a.fits"]
    assert watch.take() == watch.take(60.0) == []


def test_many_at_once_come_in_the_order_of_their_times_then_of_their_names(watch):
    count = MAX_LOOKED_AT - 2
    for k in range(count):
        put(watch.path / f"{k:03d}.fits", age_s=10 * k + 100)
    for name in ("b.fits", "a.fits"):
        put(watch.path / name)
        os.utime(watch.path / name, (1.8e9, 1.8e9))
    assert watch.take() == [f"{k:03d}.fits" for k in reversed(range(count))] + ["a.fits", "b.fits"]


def test_more_than_are_looked_at_in_one_go_all_come(watch):
    for k in range(3 * MAX_LOOKED_AT):
        put(watch.path / f"{k:03d}.fits")
    taken = [name for _ in range(5) for name in watch.take()]
    assert sorted(taken) == [f"{k:03d}.fits" for k in range(3 * MAX_LOOKED_AT)]


def test_a_file_that_grows_is_left_until_it_rests(watch):
    for size in range(1, 6):
        put(watch.path / "a.fits", content=b"x" * size)
        assert watch.look(REST_S) is None
    assert watch.look(0.9 * REST_S) is None
    assert watch.look(0.1 * REST_S) == "a.fits"


def test_a_file_that_is_renamed_into_place_is_new_however_old_it_is(watch, tmp_path):
    put(tmp_path / "elsewhere", age_s=1e6)
    (tmp_path / "elsewhere").rename(watch.path / "a.fits")
    assert watch.take() == ["a.fits"]


def test_one_that_could_not_be_read_is_given_again_when_it_has_changed_and_at_last(watch):
    put(watch.path / "a.fits")
    watch.look()
    path, last = watch.folder.next() or (watch.path / watch.look(REST_S), False)
    assert not last
    watch.folder.try_again(path)
    put(watch.path / "b.fits")
    # It keeps no other from coming.
    assert watch.take() == ["b.fits"]
    put(path, content=b"more")
    watch.look()
    assert watch.look(REST_S) == "a.fits"
    watch.folder.try_again(path)
    assert watch.look((PATIENCE - 1) * REST_S - 0.1) is None
    watch.clock.now += 0.2
    assert watch.folder.next() == (path, True)


def test_one_that_goes_again_is_forgotten(watch):
    put(watch.path / "a.fits")
    watch.look()
    (watch.path / "a.fits").unlink()
    assert watch.take() == []
    put(watch.path / "a.fits")
    assert watch.take() == ["a.fits"]


def test_a_folder_or_a_pipe_of_a_frames_name_is_none(watch):
    (watch.path / "a.fits").mkdir()
    os.mkfifo(watch.path / "b.fits")
    (watch.path / "c.fits").symlink_to("nowhere")
    assert watch.take() == []


def test_a_folder_that_comes_later_is_new_altogether(tmp_path):
    watch = Watch(tmp_path / "later")
    for _ in range(2):
        with pytest.raises(FileNotFoundError):
            watch.look(1.0)
    watch.path.mkdir()
    put(watch.path / "a.fits", age_s=1e6)
    assert watch.take() == ["a.fits"]


def test_a_folder_that_goes_and_comes_back_brings_what_is_new_in_it(watch, tmp_path, record_property):
    put(watch.path / "a.fits")
    assert watch.take() == ["a.fits"]
    watch.path.rename(tmp_path / "away")
    with pytest.raises(FileNotFoundError):
        watch.look(1.0)
    put(tmp_path / "away" / "b.fits", age_s=1e6)
    (tmp_path / "away").rename(watch.path)
    assert watch.take() == ["b.fits"]
    record_property("fault", "watched folder gone and back")
    record_property("result", "said; what came meanwhile is taken, nothing twice")


def test_a_disk_that_is_unmounted_and_mounted_again_is_not_taken_for_new(watch, tmp_path, record_property):
    put(watch.path / "a.fits")
    assert watch.take() == ["a.fits"]
    watch.path.rename(tmp_path / "disk")
    # The empty folder a disk is mounted on.
    watch.path.mkdir()
    assert watch.take() == []
    put(tmp_path / "disk" / "b.fits", age_s=-1.0)
    watch.path.rmdir()
    (tmp_path / "disk").rename(watch.path)
    assert watch.take() == ["b.fits"]
    record_property("fault", "watched disk unmounted and mounted again")
    record_property("result", "what came meanwhile is taken, nothing twice")


def test_listing_a_huge_folder_takes_a_tenth_of_the_time(watch, monkeypatch):
    listed, real = [], os.listdir

    def slow(path):
        listed.append(watch.clock.now)
        watch.clock.now += 3.0
        return real(path)

    monkeypatch.setattr(os, "listdir", slow)
    begin = watch.clock.now
    for k in range(300):
        put(watch.path / f"{k}.fits")
        watch.look(1.0)
    assert 3.0 * len(listed) < 0.12 * (watch.clock.now - begin)


def test_of_a_file_in_the_folder_eight_bytes_are_kept(watch):
    archive = 5000
    for k in range(archive):
        (watch.path / f"archive-{k}.fits").touch()
    watch.folder = WatchedFolder(watch.path, lambda name: name.endswith(".fits"), REST_S, watch.clock)
    tracemalloc.start()
    try:
        watch.look()
        assert tracemalloc.get_traced_memory()[0] < 10 * archive
    finally:
        tracemalloc.stop()


def kept_by_the_folder() -> int:
    """Bytes that the watched folder's own code holds; other threads may allocate meanwhile."""
    own = tracemalloc.Filter(True, files.__file__)
    return sum(s.size for s in tracemalloc.take_snapshot().filter_traces([own]).statistics("filename"))


def test_of_a_file_that_came_and_went_nothing_is_kept(watch):
    tracemalloc.start()
    try:
        sizes = {}
        for k in range(600):
            put(watch.path / f"{k}.fits")
            assert watch.take(20.0) == [f"{k}.fits"]
            (watch.path / f"{k}.fits").unlink()
            if k in (100, 599):
                sizes[k] = kept_by_the_folder()
        # A size is 40.
        assert (sizes[599] - sizes[100]) / 500 < 80
    finally:
        tracemalloc.stop()


def values(path, **changes):
    return attempts.values("files", files__path=str(path), files__watch=True, **changes)


def make(path, **changes):
    return made(values(path, **changes), SETTINGS)


def until_something(source):
    """The next exposure, or the error other than waiting."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        try:
            return source.capture(SETTINGS)
        except NothingYet:
            continue
        except StarposError as error:
            return error
    pytest.fail("nothing has come")


def name_of(exposure):
    return exposure.frame.source.rsplit("/", 1)[1]


def test_frames_are_taken_as_they_come_and_a_broken_one_is_said_once(folder):
    """The fixture's 1.fits is truncated."""
    (folder / "in").mkdir()
    source = make(folder / "in", files__rest=0.01)
    with pytest.raises(NothingYet, match="waiting for frames"):
        source.capture(SETTINGS)
    for k in range(3):
        (folder / f"{k}.fits").rename(folder / "in" / f"{k}.fits")
    got = [until_something(source) for _ in range(3)]
    assert [name_of(e) for e in got[:2]] == ["0.fits", "2.fits"]
    assert isinstance(got[2], FrameError) and "1.fits" in str(got[2])
    for _ in range(20):
        with pytest.raises(NothingYet):
            source.capture(SETTINGS)


def test_patterns_hidden_files_and_folders_that_are_not_there(folder):
    source = make(folder / "in" / "b*.fits", files__rest=0.01)
    assert "no such folder" in source.lacking()
    with pytest.raises(CaptureError, match="cannot be listed"):
        source.capture(SETTINGS)
    (folder / "in").mkdir()
    assert source.lacking() is None
    whole = (folder / "0.fits").read_bytes()
    for name in ("a.fits", "b.fits", ".b.fits", "b.fits.part"):
        (folder / "in" / name).write_bytes(whole)
    assert name_of(until_something(source)) == "b.fits"
    with pytest.raises(NothingYet):
        source.capture(SETTINGS)


@pytest.fixture
def small_disk(tmp_path):
    """A folder of at most 2 MB, and how: a file system of its own, or a limit of the processes that write into it."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(place)], capture_output=True, check=False
    )
    if mounted.returncode:
        yield place, "a limit of the file size"
        return
    yield place, "a full tmpfs of 2 MB"
    subprocess.run(["umount", str(place)], check=True)


def copy(source: Path, target: Path, most: int | None) -> int:
    """Copy in a process of its own, with files of limited size; its exit status."""

    def limit():
        if most is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    program = "import signal, sys, shutil; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); shutil.copyfile(*sys.argv[1:])"
    command = [sys.executable, "-c", program, str(source), str(target)]
    return subprocess.run(command, preexec_fn=limit, stderr=subprocess.DEVNULL, check=False).returncode


def test_a_full_disk(tmp_path, frame, small_disk, record_property):
    """The frames are 620 kB each: the fourth does not fit."""
    disk, how = small_disk
    write_fits(tmp_path / "frame.fits", frame, "2026-11-02T18:00:00")
    source = make(disk, files__rest=0.05)
    with pytest.raises(NothingYet):
        source.capture(SETTINGS)
    for k in range(3):
        assert copy(tmp_path / "frame.fits", disk / f"{k}.fits", None) == 0
        assert name_of(until_something(source)) == f"{k}.fits"
    size = (tmp_path / "frame.fits").stat().st_size
    assert copy(tmp_path / "frame.fits", disk / "3.fits", None if "tmpfs" in how else size // 3) != 0
    assert 0 < (disk / "3.fits").stat().st_size < size
    said = until_something(source)
    assert isinstance(said, FrameError) and "3.fits" in str(said)
    (disk / "0.fits").unlink()
    assert copy(tmp_path / "frame.fits", disk / "4.fits", None) == 0
    assert name_of(until_something(source)) == "4.fits"
    record_property("fault", "disk full in the watched folder")
    record_property("result", f"({how}) the truncated file is not published, said once; the next is taken")


def test_the_node_waits_for_frames_and_takes_them(folder, start, listener):
    (folder / "in").mkdir()
    images = listener.hear(Image, "camera/image_raw")
    start("camera", f"files.path:={folder}/in", "files.watch:=true", "files.rest:=0.1", "cadence:=0.2")
    listener.wait_for_state("camera: Capture", OK, "waiting for frames")
    (folder / "1.fits").rename(folder / "in" / "1.fits")
    listener.wait_for_state("camera: Capture", ERROR, "1.fits")
    (folder / "2.fits").rename(folder / "in" / "2.fits")
    listener.wait(lambda: images)
    counted = listener.wait_for_state("camera: Capture", OK, "taking frames")
    assert (counted["frames"], counted["failed"]) == ("1", "1")


@pytest.mark.parametrize(
    ("path", "changes", "words"),
    [
        ("/x", {"files__loop": True}, "files.loop"),
        ("/x*/y*.fits", {}, "last part"),
    ],
)
def test_what_cannot_be_watched_is_refused(path, changes, words):
    assert words in Files.refusal(values(path, **changes), SETTINGS)

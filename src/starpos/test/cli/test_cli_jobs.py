# SPDX-License-Identifier: Apache-2.0
"""--jobs, and nights in folders: the same answers, byte by byte, whoever works them and whatever happens on the way."""

import argparse
import gzip
import json
import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
import zlib
from contextlib import contextmanager
from pathlib import Path

import pytest
from archives import frames, run, solve
from cli_calls import KNOWN, WIDE

from starpos.cli import inputs
from starpos.cli.console import BAR_AFTER_S
from starpos_testing.patience import WAIT_S


@pytest.mark.parametrize(
    ("more", "jobs"), [(("--json", "--self-calibrate"), 2), ((), "auto")], ids=["turned", "table of each"]
)
def test_solve_gives_the_same_however_many_processes(more, jobs, archive, capfd):
    one = run(capfd, solve(archive / "turned", *more))
    # It reports the broken frame.
    assert one[0] == 2
    assert one[1].count('"status": "ok"') == (8 + 1 if "--json" in more else 0)
    assert one[2].count("stars_0002b.csv") == 1
    assert run(capfd, solve(archive / "turned", *more, "--jobs", jobs)) == one


@pytest.mark.parametrize("command", [("detect",), ("identify", *WIDE)], ids=["detect", "identify"])
def test_detect_and_identify_give_the_same(command, archive, capfd):
    given = [*frames(archive / "turned"), *frames(archive / "still", "*.fits"), "none.fits", "--json"]
    one = run(capfd, [*command, *given])
    assert one[0] == 2
    assert run(capfd, [*command, *given, "--jobs", "2"]) == one


def test_frames_that_cannot_be_read_do_not_tell_the_instrument(archive, capfd, tmp_path):
    """The header of the first that can be read does, here as there."""
    none = [str(tmp_path / f"{k}.fits") for k in range(3)]
    still = archive / "still"
    for given in (none, [*none, *frames(still, "*.fits")]):
        command = ["solve", *given, "--tilt", str(still / "tilt.csv"), "--json"]
        one = run(capfd, command)
        assert one[0] == 2
        assert one[1].count('"status": "ok"') == (2 + 1 if given != none else 0)
    assert run(capfd, [*command, "--jobs", "2"]) == one


def test_a_damaged_gz_and_a_pipe_cost_their_own_frames(archive, capfd, tmp_path):
    whole, other = frames(archive / "still", "*.fits")
    packed = bytearray(gzip.compress(Path(whole).read_bytes()))
    # where zlib itself finds it
    packed[10] ^= 255
    with pytest.raises(zlib.error):
        gzip.decompress(packed)
    (tmp_path / "damaged.fits.gz").write_bytes(packed)
    os.mkfifo(tmp_path / "pipe.fits")
    given = [whole, *map(str, tmp_path.iterdir()), other]
    status, out, err = run(capfd, ["detect", *given, "--json"])
    assert status == 2 and len(err.splitlines()) == 2 and "this program failed" not in err
    assert ['"stars": []' in line for line in out.splitlines()] == [False, True, True, False]
    command = ["solve", *given, "--tilt", str(archive / "still" / "tilt.csv"), "--json"]
    status, out, err = run(capfd, [*command, "--jobs", "2"])
    told = [json.loads(line) for line in out.splitlines()]
    assert status == 2 and [frame["stars_matched"] > 0 for frame in told[:4]] == [True, False, False, True]


def test_a_folder_is_a_night_and_each_makes_its_own_fix(archive, capfd):
    nights = [archive / "turned", archive / "still"]
    alone = ""
    for night in nights:
        given = frames(night, "*.fits") or frames(night)
        alone += run(capfd, ["solve", *given, "--tilt", str(night / "tilt.csv"), *KNOWN, "--json"])[1]
    status, out, _ = run(capfd, ["solve", *map(str, nights), *KNOWN, "--json", "--jobs", "2"])
    assert status == 2
    rows = [json.loads(line) for line in out.splitlines()]
    assert [r.pop("night") for r in rows if "combined" in r] == [str(n) for n in nights]
    assert rows == [json.loads(line) for line in alone.splitlines()]


def test_a_night_that_is_none_is_that_nights_failure(archive, tmp_path, capfd):
    empty, untold = tmp_path / "empty", tmp_path / "untold"
    empty.mkdir()
    untold.mkdir()
    shutil.copy(archive / "turned" / "stars_0000.csv", untold)
    still = str(archive / "still")
    status, out, err = run(capfd, ["solve", str(empty), still, str(untold), *KNOWN])
    assert (status, len(err.splitlines())) == (2, 2)
    assert f"{empty}: no frames in it" in err
    assert str(untold / "tilt.csv") in err
    assert f"{still}: 2 frames together" in out
    assert run(capfd, ["solve", str(empty), *KNOWN])[0] == 2


def test_a_night_without_a_fix_is_exit_1(archive, tmp_path, capfd):
    dark = tmp_path / "dark"
    dark.mkdir()
    rows = (archive / "turned" / "stars_0000.csv").read_text().splitlines()
    (dark / "stars.csv").write_text("\n".join(rows[:4]) + "\n")
    shutil.copy(archive / "turned" / "tilt.csv", dark)
    assert run(capfd, ["solve", str(dark), str(archive / "still"), *KNOWN])[0] == 1
    assert run(capfd, ["solve", str(archive / "still"), *KNOWN])[0] == 0


BAD_CALLS = {
    "fewer processes than none": ("--jobs", "-1"),
    "more processes than sense": ("--jobs", "100000"),
    "a word for a number": ("--jobs", "many"),
}


@pytest.mark.parametrize("kind", BAD_CALLS)
@pytest.mark.parametrize("command", ["solve", "identify", "detect"])
def test_a_bad_call_is_exit_2_and_one_line(kind, command, archive, capfd):
    given = ["--tilt", str(archive / "turned" / "tilt.csv")] if command == "solve" else []
    status, out, err = run(capfd, [command, *frames(archive / "turned"), *given, *BAD_CALLS[kind]])
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    if kind == "a word for a number":
        assert "'many' is neither a whole number nor auto" in err


def test_frames_without_tilts_and_save_of_several_nights_are_refused(archive, tmp_path, capfd):
    status, _, err = run(capfd, ["solve", *frames(archive / "turned"), *KNOWN])
    assert (status, len(err.splitlines())) == (2, 1)
    assert "--tilt" in err
    astray = str(tmp_path / "astray")
    for given, why in (
        ([str(archive / "still"), astray], "no such file or folder"),
        ([__file__], "no tilts"),
    ):
        status, _, err = run(capfd, ["solve", *given, *KNOWN])
        assert status == 2 and err.startswith(f"starpos solve: {given[-1]}: ") and why in err
    nights = [str(archive / "turned"), str(archive / "still")]
    save = ["--self-calibrate", "--save", str(tmp_path / "a.yaml")]
    status, _, err = run(capfd, ["solve", *nights, *KNOWN, *save])
    assert (status, len(err.splitlines())) == (2, 1)
    assert "one night" in err


@contextmanager
def started(archive, times=4, **options):
    """`starpos solve --jobs 2` of eight frames, several times each, in a process group of its own; its first answer.

    The answers are by default more than its small pipe holds: it cannot have ended before they are read.
    """
    night = archive / "turned"
    many = [p for p in frames(night) if "2b" not in p] * times
    command = ["solve", *many, "--tilt", str(night / "tilt.csv"), *KNOWN, "--json", "--jobs", "2"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    # A shell's background ignores it.
    process = subprocess.Popen(
        ["env", "--default-signal=INT", sys.executable, "-m", "starpos", *command],
        text=True,
        pipesize=4096,
        start_new_session=True,
        **pipes,
    )
    try:
        yield process, process.stdout.readline(), many
    finally:
        process.kill()
        process.communicate()


def workers_of(pid):
    """Ids of the process's children that work frames."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(c) for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]


def complaints(err):
    """Lines of standard error without progress, which appears on a busy machine."""
    return err.splitlines()


def gone(pidfd):
    """Whether the process ends within the test's patience."""
    return bool(select.select([pidfd], [], [], 30)[0])


def test_a_worker_killed_on_the_way_changes_no_answer(archive, capfd):
    with started(archive) as (process, first, many):
        workers = workers_of(process.pid)
        assert len(workers) == 2
        os.kill(workers[0], signal.SIGKILL)
        # communicate() would lose what was read together with the first line
        rest, err = process.stdout.read(), process.stderr.read()
        process.wait(WAIT_S)
    assert (process.returncode, complaints(err)) == (0, [])
    *each, combined = (first + rest).splitlines()
    assert len(each) == len(many)
    known = {}
    for path, line in zip(many, each, strict=True):
        assert json.loads(line)["file"] == path
        assert known.setdefault(path, line) == line
    assert json.loads(combined)["frames"] == 8


@pytest.mark.parametrize("ends", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "kill -9"])
def test_workers_end_with_their_parent(ends, archive):
    with started(archive) as (process, *_):
        fds = [os.pidfd_open(w) for w in workers_of(process.pid)]
        if ends == signal.SIGINT:
            # As a terminal does.
            os.killpg(process.pid, ends)
        else:
            process.kill()
        _, err = process.communicate(timeout=WAIT_S)
        assert (process.returncode, complaints(err)) == (130 if ends == signal.SIGINT else -ends, [])
        assert len(fds) == 2
        assert all(gone(fd) for fd in fds)
        for fd in fds:
            os.close(fd)


def test_workers_end_where_nobody_reads_on(archive):
    with started(archive) as (process, *_):
        fds = [os.pidfd_open(w) for w in workers_of(process.pid)]
        process.stdout.close()
        assert process.wait(timeout=WAIT_S) == 0
        assert complaints(process.stderr.read()) == []
        assert all(gone(fd) for fd in fds)
        for fd in fds:
            os.close(fd)


def test_a_terminal_is_shown_how_far_it_is(archive):
    ours, theirs = pty.openpty()
    with started(archive, stderr=theirs) as (process, _, many):
        # Its answers fill the pipe: it takes as long as a bar waits, however quick the machine.
        time.sleep(BAR_AFTER_S)
        shown, last = b"", f"frame {len(many)} of {len(many)}".encode()
        answers = process.stdout.fileno()
        open_ends = {ours, answers}
        while not (last in shown and shown.endswith(b"100 %\r\n")):
            ready = select.select(open_ends, [], [], WAIT_S)[0]
            assert ready, shown
            if ours in ready:
                shown += os.read(ours, 65536)
            if answers in ready and not os.read(answers, 65536):
                open_ends.remove(answers)
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize(
    ("jobs", "pictures", "lists", "gigabytes", "processes"),
    [
        (None, 15, 100, 8, 1),
        (None, 17, 0, 8, 2),
        (None, 200, 0, 8, 6),
        (None, 200, 0, 2, 2),
        (None, 200, 0, 0.5, 1),
        (1, 200, 0, 8, 1),
        (0, 3, 2, 0.5, 5),
    ],
)
def test_pictures_that_pay_have_processes(tmp_path, monkeypatch, jobs, pictures, lists, gigabytes, processes):
    large, small = tmp_path / "large.jpg", tmp_path / "small.csv"
    small.touch()
    with open(large, "wb") as file:
        file.truncate(2_000_000)
    monkeypatch.setattr(inputs, "processors", lambda: 6)
    monkeypatch.setattr(inputs, "memory_bytes", lambda: int(gigabytes * 2**30))
    monkeypatch.setattr(inputs, "workers", lambda number: max(number, 1))
    paths = [str(large)] * pictures + [str(small)] * lists
    assert inputs.workers_of(argparse.Namespace(jobs=jobs), paths) == processes

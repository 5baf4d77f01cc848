# SPDX-License-Identifier: Apache-2.0
"""--scheduler: a cluster of two worker processes on this machine gives the answers of one process, or says why not."""

import fcntl
import os
import signal
import socket
from pathlib import Path

import pytest
from archives import frames, run, solve

import starpos
from starpos.errors import FrameError
from starpos.parallel import cluster as cluster_module
from starpos.parallel.cluster import Cluster, ClusterError, same_here
from starpos_testing.lacking import needs

# a scheduler and its workers start as processes of their own, each with the whole of Python's science
pytestmark = [needs("distributed"), pytest.mark.timeout(1500)]


@pytest.fixture(scope="module")
def cluster():
    """Workers that a nanny replaces, as dask's own command line starts them."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1"
        ) as local,
    ):
        yield local.scheduler_address


# the work, which goes to the workers by name


def killed_once(of):
    """A file whose worker is killed the first time."""
    seen = Path(of + ".seen")
    if of.endswith("3") and not seen.exists():
        seen.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Path(of).name


def killed(of):
    os.kill(os.getpid(), signal.SIGKILL)


def read(of):
    return Path(of).read_text()


def opencv_threads(of):
    import cv2

    return cv2.getNumThreads()


@pytest.mark.parametrize("more", [(), ("--self-calibrate",)], ids=["each", "turned"])
def test_a_cluster_gives_the_same_answers(more, cluster, archive, capfd, monkeypatch):
    # The workers have another folder.
    monkeypatch.chdir(archive / "turned")
    command = [Path(a).name if a.endswith(".csv") else a for a in solve(archive / "turned", "--json", *more)]
    status, out, err = run(capfd, command)
    # It reports the broken frame.
    assert status == 2
    there = run(capfd, [*command, "--scheduler", cluster])
    assert there[:2] == (status, out)
    assert len(there[2].splitlines()) == len(err.splitlines())


@pytest.mark.parametrize("command", ["detect", "identify"])
def test_detect_and_identify_go_to_a_cluster_too(command, cluster, archive, capfd):
    given = [command, *frames(archive / "still", "*.fits"), "none.fits", "--json"]
    assert run(capfd, [*given, "--scheduler", cluster]) == run(capfd, given)


def test_a_worker_killed_on_the_way_costs_no_answer(cluster, tmp_path):
    given = [tmp_path / str(k) for k in range(12)]
    for path in given:
        path.touch()
    with Cluster(cluster) as workers:
        answers = list(workers.map((killed_once, str(path)) for path in given))
    assert answers == [path.name for path in given]
    assert (tmp_path / "3.seen").exists()


def test_a_frame_that_ends_every_worker_is_given_up(cluster, tmp_path):
    bad = tmp_path / "bad.fits"
    bad.write_text("bad")
    with Cluster(cluster) as workers:
        error, good = workers.map([(killed, str(bad)), (read, str(bad))])
    assert isinstance(error, FrameError)
    assert "bad.fits: given up: the workers that took it died, the last one with no other work" in str(error)
    assert good == "bad"


@pytest.fixture
def older(monkeypatch):
    """Makes this process's starpos another than the workers'."""

    def make():
        monkeypatch.setattr(starpos, "__version__", "0.0.1")
        same_here.cache_clear()

    yield make
    same_here.cache_clear()


def test_a_worker_of_another_starpos_is_refused(cluster, tmp_path, older):
    (tmp_path / "a").write_text("a")
    told = (
        r"tcp://.*: the starpos of this worker is 0\.1\.0 .*, here it is 0\.0\.1 .*: install the same there"
    )
    with Cluster(cluster) as workers:
        # As a worker that comes when the others have been asked.
        older()
        with pytest.raises(ClusterError, match=told):
            list(workers.map([(read, str(tmp_path / "a"))]))
    with pytest.raises(ClusterError, match=told), Cluster(cluster):
        pass


def test_a_worker_that_lacks_the_works_module_says_so(cluster, tmp_path, monkeypatch):
    (tmp_path / "late_starpos.py").write_text("def late(of): return of\n")
    monkeypatch.syspath_prepend(tmp_path)
    from late_starpos import late

    with Cluster(cluster) as workers, pytest.raises(ClusterError, match="a worker cannot load this starpos"):
        list(workers.map([(late, str(tmp_path / "late_starpos.py"))]))


def test_files_that_a_worker_does_not_see_are_told(cluster, tmp_path):
    mine = tmp_path / "mine"
    mine.write_text("mine")
    with mine.open() as f:
        # A path of this process only.
        number = fcntl.fcntl(f, fcntl.F_DUPFD, 500)
    try:
        with Cluster(cluster) as workers, pytest.raises(ClusterError, match="does not see it"):
            list(workers.map([(read, f"/proc/self/fd/{number}")]))
    finally:
        os.close(number)


def test_workers_leave_one_another_their_processors(cluster, tmp_path):
    (tmp_path / "a").write_text("a")
    with Cluster(cluster) as workers:
        assert list(workers.map([(opencv_threads, str(tmp_path / "a"))] * 6))[-1] == 1


def test_no_scheduler_is_told(archive, capfd, monkeypatch):
    monkeypatch.setattr(cluster_module, "ANSWER_WITHIN_S", 0.5)
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{s.getsockname()[1]}"
        status, out, err = run(capfd, ["detect", *frames(archive / "turned"), "--scheduler", address])
    assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert f"{address}: no scheduler" in err

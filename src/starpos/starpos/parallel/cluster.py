# SPDX-License-Identifier: Apache-2.0
"""Do calls on a dask.distributed cluster; its workers need the same files under the same paths and the same starpos."""

import hashlib
import logging
import os
import pickle
import stat
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import starpos
from starpos.errors import StarposError, one_line
from starpos.parallel.processes import Call, Files, answer_of, given_up, worked
from starpos.sky import catalogue, deeper

# Versions by name.
Same = dict[str, str]


@lru_cache(maxsize=1)
def same_here() -> Same:
    """Versions of starpos, its catalogues and the Earth orientation tables in this process."""
    root = Path(starpos.__file__).parent
    digest = hashlib.sha256()
    for source in sorted(root.rglob("*.py")):
        digest.update(str(source.relative_to(root)).encode() + b"\0" + source.read_bytes())
    return {
        "starpos": f"{starpos.__version__} ({digest.hexdigest()[:8]})",
        "star catalogue": catalogue.load_catalogue().fingerprint,
        "deeper catalogue": "none" if (more := deeper.kept()) is None else more.fingerprint,
        "astropy-iers-data": metadata.version("astropy-iers-data"),
    }


def differing(there: Same, here: Same) -> str:
    """Part of a sentence: the first version that differs, and what to do."""
    what = next(name for name in here if there.get(name) != here[name])
    return f"the {what} of this worker is {there.get(what)}, here it is {here[what]}: install the same there"


PIP = "pip install distributed"
ANSWER_WITHIN_S = 10
# Calls sent to the cluster before their answers are needed: number per thread, and minimum.
AHEAD, MIN_AHEAD = 3, 64
SCHEMES = ("tcp", "tls", "ws", "wss", "ucx")
# Number of calls after which the cluster's threads are counted again.
COUNT_EVERY = 100


class ClusterError(StarposError):
    """The cluster cannot be used."""


class Cluster:
    """An existing cluster, by its scheduler's address; nothing of ours stays there on leaving."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._client: Any = None

    def __enter__(self) -> "Cluster":
        try:
            import distributed
        except ImportError:
            raise ClusterError(
                f"--scheduler works through dask.distributed, which is not here: {PIP}"
            ) from None
        for name in [n for n in logging.root.manager.loggerDict if n.split(".")[0] == "distributed"]:
            # our own errors say what matters
            logging.getLogger(name).setLevel(logging.CRITICAL)
        if not _is_address(self._address):
            raise ClusterError(f"--scheduler {self._address}: no address: give one as tcp://HOST:8786")
        if self._address.startswith("tls") and not (
            distributed.Security().get_connection_args("client").get("ssl_context")
        ):
            raise ClusterError(
                f"{self._address}: no keys for it: name them in dask's configuration, distributed.comm.tls"
            )
        try:
            self._client = distributed.Client(
                self._address, timeout=ANSWER_WITHIN_S, set_as_default=False, name="starpos"
            )
        # a TimeoutError is an OSError
        except (OSError, ValueError, RuntimeError) as error:
            raise ClusterError(
                f"{self._address}: no scheduler of dask.distributed answers there ({one_line(error)}): start one, or "
                "give another address"
            ) from None
        try:
            self._check()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def _check(self) -> None:
        """Raise ClusterError if a worker's starpos differs from ours; later workers are checked at each call."""
        here = same_here()
        there = self._client.run(same_here, on_error="return")
        if not there:
            print(f"starpos: {self._address} has no workers yet: waiting for them", file=sys.stderr)
        for worker, theirs in there.items():
            if isinstance(theirs, BaseException):
                raise ClusterError(
                    f"{worker}: this worker cannot load this starpos ({one_line(theirs)}): install the same there"
                )
            if theirs != here:
                raise ClusterError(f"{worker}: {differing(theirs, here)}")

    def map(self, calls: Iterable[Call]) -> Iterator:
        """See Workers.

        If a worker dies, dask also gives up the calls that only waited there. So each such call is done again while no
        other call of ours is under way; if its worker dies again, it is given up.
        """
        calls, here = iter(calls), same_here()
        under_way: deque[tuple[Call, Any]] = deque()
        told = ahead = 0
        while True:
            if told % COUNT_EVERY == 0:
                ahead = max(MIN_AHEAD, AHEAD * sum(self._client.nthreads().values()))
            while len(under_way) < ahead and (call := next(calls, None)) is not None:
                under_way.append((call, self._begun(call, here)))
            if not under_way:
                return
            call, future = under_way.popleft()
            told += 1
            try:
                outcome = self._outcome(call, future, here, [f for _, f in under_way])
            except (CancelledError, OSError) as error:
                raise ClusterError(
                    f"{self._address}: the scheduler has gone ({one_line(error)}): start it and run this again"
                ) from None
            # from a worker that joined later
            except (ImportError, AttributeError) as error:
                raise ClusterError(
                    f"{self._address}: a worker cannot load this starpos ({one_line(error)}): install the same there"
                ) from None
            yield answer_of(outcome)

    def _outcome(self, call: Call, future: Any, here: Same, others: list) -> bytes:
        """The pickled answer of a call, done again alone if its worker died; others are the futures after it."""
        from distributed import KilledWorker

        if isinstance(future, bytes):
            return future
        try:
            return future.result()
        except KilledWorker:
            for other in others:
                if not isinstance(other, bytes):
                    # waits until it has ended
                    other.exception()
        try:
            return self._begun(call, here).result()
        except KilledWorker as error:
            return pickle.dumps(
                given_up(
                    call[1],
                    f"the workers that took it died, the last one with no other work ({one_line(error)})",
                )
            )

    def _begun(self, call: Call, here: Same) -> Any:
        """Start a call and return its future, or its pickled answer if its files cannot be seen by a worker."""
        work, files = call
        sizes = {}
        for path in (*getattr(work, "files", ()), *([files] if isinstance(files, str) else ())):
            try:
                status = os.stat(path)
            except (OSError, ValueError):
                return worked(work, files)
            if not stat.S_ISREG(status.st_mode):
                return worked(work, files)
            sizes[os.path.abspath(path)] = status.st_size
        files = os.path.abspath(files) if isinstance(files, str) else tuple(map(os.path.abspath, files))
        # sent as bytes that the worker unpickles itself: so a failure to load them reaches us as an error
        return self._client.submit(pickle.loads, pickle.dumps(_Task(work, files, sizes, here)), pure=False)


@dataclass(frozen=True)
class _Task:
    """A call as it is sent to a worker; unpickling it does the work and gives the pickled answer."""

    work: Callable
    files: Files
    # Bytes of each file, by name.
    sizes: dict[str, int]
    here: Same

    def __reduce__(self) -> tuple[Callable[..., bytes], tuple]:
        return _on_worker, (self.work, self.files, self.sizes, self.here)


def _is_address(text: str) -> bool:
    """Whether a Client can be made of the text; with other texts it prints errors when Python ends."""
    try:
        parts = urlsplit(text if "://" in text else f"tcp://{text}")
        return parts.scheme in SCHEMES and bool(parts.hostname) and parts.port is not None
    except ValueError:
        return False


def _on_worker(work: Callable, files: Files, sizes: dict[str, int], here: Same) -> bytes:
    """Do a call on this worker, if its starpos and its files are the same as the sender's."""
    from distributed import get_worker

    name = get_worker().address
    there = same_here()
    if there != here:
        return pickle.dumps(ClusterError(f"{name}: {differing(there, here)}"))
    for path, size in sizes.items():
        try:
            seen = os.stat(path).st_size
        except OSError:
            seen = None
        if seen != size:
            what = "does not see it" if seen is None else f"sees {seen} bytes of {size}"
            return pickle.dumps(
                ClusterError(
                    f"{path}: worker {name} {what}: its machine needs the same files under the same paths"
                )
            )
    # the worker's own threads already share its processors
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    return worked(work, files)

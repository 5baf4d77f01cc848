# SPDX-License-Identifier: Apache-2.0
"""The work on one frame, wherever it is done: the call that is sent, and the answer that comes back."""

import pickle
import traceback
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

from starpos.errors import FrameError, StarposError, one_line

Files = str | tuple[str, ...]
# The work, which can be pickled, and the file or files it is done on.
Call = tuple[Callable[[Any], Any], Files]


class Workers(Protocol):
    """A place where calls are done; a context manager that leaves nothing running."""

    def __enter__(self) -> "Workers": ...

    def __exit__(self, *_: object) -> None: ...

    def map(self, calls: Iterable[Call]) -> Iterator:
        """Yield the answers in the order of the calls, each as soon as all before it are there.

        A FrameError is an answer; any other StarposError of the work is raised.
        """


def worked(work: Callable, files: Files) -> bytes:
    """Do the work and return its answer, or its StarposError, pickled.

    Work in this process uses it too: the sum of an array that is a view may differ in the last digit from the sum of its
    pickled copy, and the answers must be the same everywhere.
    """
    try:
        answer = work(files)
    except StarposError as error:
        answer = error
    # a failure on one frame must not lose the others
    except Exception as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        answer = FrameError(
            f"{files}: this program failed on it ({type(error).__name__}: {one_line(error)}; {at.filename}:{at.lineno}): "
            "please report it with the frame"
        )
    return pickle.dumps(answer)


def answer_of(outcome: bytes) -> Any:
    """Unpickle what `worked` returned; a StarposError that is not a FrameError is raised."""
    # from this program's own processes, or from a cluster that the user trusts to run code
    answer = pickle.loads(outcome)
    if isinstance(answer, StarposError) and not isinstance(answer, FrameError):
        raise answer
    return answer


def given_up(files: Files, why: str) -> FrameError:
    """The answer for a frame whose work ends the process that does it."""
    return FrameError(f"{files}: given up: {why}")


class Here:
    """Workers in this process: one call after the other."""

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def map(self, calls: Iterable[Call]) -> Iterator:
        """See Workers."""
        return (answer_of(worked(*call)) for call in calls)

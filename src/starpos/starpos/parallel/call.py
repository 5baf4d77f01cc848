# SPDX-License-Identifier: Apache-2.0
"""One frame's work, wherever it is done: what goes there, and what comes back."""

import pickle
import traceback
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

from starpos.errors import FrameError, StarposError, one_line

Files = str | tuple[str, ...]
# The work, which can be pickled, and the file or files it is done on.
Call = tuple[Callable[[Any], Any], Files]


class Workers(Protocol):
    """Where calls are worked; a context manager that leaves nothing running."""

    def map(self, calls: Iterable[Call]) -> Iterator:
        """The answers in the order of the calls, each as soon as all before it are there.

        A FrameError is an answer; any other StarposError of the work is raised.
        """


def worked(work: Callable, of: Files) -> bytes:
    """The answer, or the StarposError instead of one, pickled: an array that was a view of another may add up to another
    last digit than its copy, so what is done here goes through this too."""
    try:
        answer = work(of)
    except StarposError as error:
        answer = error
    except Exception as error:  # the other frames are worth having
        at = traceback.extract_tb(error.__traceback__)[-1]
        answer = FrameError(
            f"{of}: this program failed on it ({type(error).__name__}: {one_line(error)}; {at.filename}:{at.lineno}): "
            "please report it with the frame"
        )
    return pickle.dumps(answer)


def answer_of(outcome: bytes) -> Any:
    """What `worked` pickled; raises what is no frame's own failure."""
    answer = pickle.loads(
        outcome
    )  # of this program's own processes, or of a cluster that could run anything anyway
    if isinstance(answer, StarposError) and not isinstance(answer, FrameError):
        raise answer
    return answer


def given_up(of: Files, why: str) -> FrameError:
    """The answer for a frame that ends its workers."""
    return FrameError(f"{of}: given up: {why}")


class Here:
    """In this process, one call after the other."""

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def map(self, calls: Iterable[Call]) -> Iterator:
        """As Workers has it."""
        return (answer_of(worked(*call)) for call in calls)

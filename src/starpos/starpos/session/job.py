# SPDX-License-Identifier: Apache-2.0
"""Jobs of several seconds: the outcome, the runner's interface, and a runner without a thread."""

import traceback
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Protocol

from starpos.errors import StarposError


@dataclass(frozen=True)
class Outcome:
    """The value that a job returned, or the sentence that says why it failed."""

    value: Any = None
    trouble: str = ""


class Coming(Protocol):
    """An Outcome that will come, as rclpy's Future."""

    def add_done_callback(self, callback: Callable[[Any], None]) -> None: ...

    def result(self) -> Any: ...

    def __await__(self) -> Generator[Any, Any, Any]: ...


class Jobs(Protocol):
    """Runs one job at a time; its Outcome comes when its owner is free for it, never within `run`."""

    @property
    def busy(self) -> bool: ...

    def run(self, job: Callable[[], Any]) -> Coming: ...


def outcome_of(job: Callable[[], Any], say: Callable[[str], object]) -> Outcome:
    """Do a job; a defect ends this job only, and `say` gets its traceback."""
    try:
        return Outcome(job())
    except StarposError as e:
        return Outcome(trouble=str(e))
    except Exception as e:
        say(traceback.format_exc())
        return Outcome(trouble=f"it failed ({type(e).__name__}: {e})")


class _Promised:
    """The Outcome of a job that JobsInTurn runs."""

    def __init__(self) -> None:
        self._outcome: Outcome | None = None
        self._callbacks: list[Callable[[Any], None]] = []

    def add_done_callback(self, callback: Callable[[Any], None]) -> None:
        self._callbacks.append(callback)

    def result(self) -> Outcome | None:
        return self._outcome

    def __await__(self) -> Generator[Any, Any, Any]:
        while self._outcome is None:
            yield
        return self._outcome

    def come(self, outcome: Outcome) -> None:
        self._outcome = outcome
        for callback in self._callbacks:
            callback(self)


class JobsInTurn:
    """Jobs that are done in this thread, each at the next `work`."""

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._next: tuple[Callable[[], Any], _Promised] | None = None

    @property
    def busy(self) -> bool:
        """Whether a job waits."""
        return self._next is not None

    def run(self, job: Callable[[], Any]) -> _Promised:
        """Keep a job for `work`; must not be called while one waits."""
        assert self._next is None
        self._next = job, _Promised()
        return self._next[1]

    def work(self) -> None:
        """Do the job that waits, if there is one."""
        if self._next is not None:
            job, promised = self._next
            outcome = outcome_of(job, self._say)
            self._next = None
            promised.come(outcome)

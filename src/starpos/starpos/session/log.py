# SPDX-License-Identifier: Apache-2.0
"""What a session needs from its driver: a log for its sentences, and an account of its messages."""

from typing import Protocol


class Log(Protocol):
    """Takes sentences, as rclpy's logger does; of an error, which is a defect, the traceback."""

    def info(self, message: str) -> object: ...

    def warning(self, message: str) -> object: ...

    def error(self, message: str) -> object: ...


class Changes:
    """Logs a state once until it changes."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._logged: object = None

    def say(self, sentence: str, good: bool, state: object = None) -> None:
        """Log a sentence, unless its state (or it itself) was logged last."""
        state = state or sentence
        if state == self._logged:
            return
        self._logged = state
        if good:
            self._log.info(sentence)
        else:
            self._log.warning(sentence)


class Heard(Protocol):
    """Keeps account of the messages, by the relative name of their topic."""

    def came(self, name: str) -> object: ...

    def refuse(self, name: str, sentence: str) -> object: ...

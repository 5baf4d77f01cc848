# SPDX-License-Identifier: Apache-2.0
"""What a session needs from whoever drives it: a log for its sentences, and an account of its messages."""

from typing import Protocol


class Log(Protocol):
    """Takes sentences, as rclpy's logger does; of an error, which is a defect, the traceback."""

    def info(self, message: str) -> object: ...

    def warning(self, message: str) -> object: ...

    def error(self, message: str) -> object: ...


class Heard(Protocol):
    """Keeps account of the messages, by the relative name of their topic."""

    def came(self, name: str) -> object: ...

    def refuse(self, name: str, sentence: str) -> object: ...


class LogOfChanges:
    """Says a state in a log when it becomes another one."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._said: object = None

    def say(self, sentence: str, good: bool, state: object = None) -> None:
        """Say a sentence, as information or a warning, unless the state (by default the sentence) was said last."""
        state = state or sentence
        if state == self._said:
            return
        self._said = state
        if good:
            self._log.info(sentence)
        else:
            self._log.warning(sentence)

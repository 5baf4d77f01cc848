# SPDX-License-Identifier: Apache-2.0
"""What a node says of its health: a level, a sentence and values, in diagnostic_msgs' levels."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Level(IntEnum):
    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnostic task: a level, a sentence, and named values (numbers, strings, booleans)."""

    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)

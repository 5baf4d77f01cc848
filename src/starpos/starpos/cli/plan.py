# SPDX-License-Identifier: Apache-2.0
"""How `starpos solve` works on a night."""

from dataclasses import dataclass

from starpos.cli.archive import NightFolder
from starpos.fix.solver import Solver
from starpos.instrument.tilts import NO_TILTS, Tilts
from starpos.night.reading import Given
from starpos.night.work import OnFile


@dataclass(frozen=True)
class Plan:
    """How to solve a night: the work on each frame, the instruments, and the solver of its first frame.

    solver: None if no frame can be read; then each one reports why.
    """

    night: NightFolder
    work: OnFile
    given: Given
    solver: Solver | None = None
    tilts: Tilts = NO_TILTS

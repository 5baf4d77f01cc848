# SPDX-License-Identifier: Apache-2.0
"""The faults that tools/soaks/soak.py faults injects: each module registers its own."""

from kinds import times, stars, tilts, turns, graph, images  # noqa: F401, I001  (the order of the table)
from kinds.registry import KINDS, UNTOLD, Kind

__all__ = ["KINDS", "UNTOLD", "Kind"]

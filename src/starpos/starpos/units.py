# SPDX-License-Identifier: Apache-2.0
"""Sizes of units that are not SI, in radians and seconds."""

import math

ARCSEC = math.radians(1 / 3600)
MAS = ARCSEC / 1000
# A milliarcsecond in degrees.
MAS_DEG = 1 / 3.6e6
DAY_S = 86400.0
HOUR_S = 3600.0

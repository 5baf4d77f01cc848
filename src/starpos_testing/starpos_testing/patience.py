# SPDX-License-Identifier: Apache-2.0
"""How long tests wait."""

WAIT_S = 120.0  # for any event: ten times what the slowest takes on a machine that is not busy, and more

# SPDX-License-Identifier: Apache-2.0
"""How long tests wait."""

# For any event: ten times what the slowest takes on a machine that is not busy, and more.
WAIT_S = 120.0

# SPDX-License-Identifier: Apache-2.0
"""Stars and tilt in, position and heading out: node solver."""

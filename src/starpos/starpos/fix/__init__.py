# SPDX-License-Identifier: Apache-2.0
"""The fix: stars and tilt in, place and heading out, with the whole error budget."""

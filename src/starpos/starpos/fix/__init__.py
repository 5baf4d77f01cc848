# SPDX-License-Identifier: Apache-2.0
"""The fix: place and heading from stars and tilt, with the whole error budget."""

# SPDX-License-Identifier: Apache-2.0
"""Place and heading of an instrument under way: stars give the attitude, an IMU the vertical, with no prior knowledge."""

# SPDX-License-Identifier: Apache-2.0
"""Place and heading of an instrument under way: stars tell the attitude, an IMU the vertical, both from nothing known."""

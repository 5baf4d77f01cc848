# SPDX-License-Identifier: Apache-2.0
"""Simulated skies, frames, cameras and bags for the tests of `starpos`; without ROS."""

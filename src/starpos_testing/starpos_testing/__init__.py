# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests: `skies` without ROS, nodes as processes, the running `graph`."""

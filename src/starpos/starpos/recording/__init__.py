# SPDX-License-Identifier: Apache-2.0
"""Recorded nights: bounds of bags, and messages as the dataclasses of this package, without ROS."""

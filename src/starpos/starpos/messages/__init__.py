# SPDX-License-Identifier: Apache-2.0
"""Converts messages into this package's types: those of rclpy in a node, and those of `rosbags` from a bag.

A message that cannot be right raises the error of its type, in one sentence.
"""

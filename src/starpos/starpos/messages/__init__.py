# SPDX-License-Identifier: Apache-2.0
"""Converts messages into this package's types: rclpy's messages in a node, and `rosbags`' from a bag.

A message that cannot be right raises the error of its type, in one sentence.
"""

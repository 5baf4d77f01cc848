# SPDX-License-Identifier: Apache-2.0
"""A night into a rosbag2, and from one into the graph."""

# SPDX-License-Identifier: Apache-2.0
"""A session: the messages of an instrument, one after another, to its solutions; without ROS."""

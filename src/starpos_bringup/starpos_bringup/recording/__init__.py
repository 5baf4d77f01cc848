# SPDX-License-Identifier: Apache-2.0
"""Recording of a night as a rosbag2, and playing it into the graph."""

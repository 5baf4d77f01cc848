# SPDX-License-Identifier: Apache-2.0
"""The parameters of the nodes: their rows, which are data (data/NODE.yaml), and values for them from files and texts."""

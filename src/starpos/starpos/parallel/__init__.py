# SPDX-License-Identifier: Apache-2.0
"""The same work on many frames: here, on several processes of this machine, or on a dask.distributed cluster.

All three take calls (work, of), which are one frame's each, and give their answers back in the calls' order.
"""

# SPDX-License-Identifier: Apache-2.0
"""Tools for the whole instrument: launching, default parameters, recording and playing."""

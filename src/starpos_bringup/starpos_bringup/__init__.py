# SPDX-License-Identifier: Apache-2.0
"""The whole instrument at once: launching, default parameters, recording and playing."""

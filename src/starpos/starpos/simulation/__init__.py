# SPDX-License-Identifier: Apache-2.0
"""Simulated frames and nights, and Monte-Carlo runs, with their truth."""

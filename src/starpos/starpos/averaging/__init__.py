# SPDX-License-Identifier: Apache-2.0
"""Averages of many fixes of one place."""

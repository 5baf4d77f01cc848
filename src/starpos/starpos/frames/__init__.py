# SPDX-License-Identifier: Apache-2.0
"""Frames and star lists: reading them from files and bytes, their times, and drawing on them."""

# SPDX-License-Identifier: Apache-2.0
"""The Earth: its rotation, its shape, its air and its gravity."""

# SPDX-License-Identifier: Apache-2.0
"""Frames of the sky from a camera, files or a simulation, and the stars in them."""

# SPDX-License-Identifier: Apache-2.0
"""Sources of frames: a module for each kind of camera."""

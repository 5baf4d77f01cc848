# SPDX-License-Identifier: Apache-2.0
"""The instrument from the sky: A3 at a known place or by turning, and the camera."""

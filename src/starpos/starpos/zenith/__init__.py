# SPDX-License-Identifier: Apache-2.0
"""The deflection of the vertical by a zenith camera: sightings of stars and tilts at a known site, in several faces."""

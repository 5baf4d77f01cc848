# SPDX-License-Identifier: Apache-2.0
"""GNSS with the stars: it teaches A3, the inclinometer's errors and the deflection of the vertical, and is guarded."""

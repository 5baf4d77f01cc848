# SPDX-License-Identifier: Apache-2.0
"""Sources of readings: a module for each sensor."""

# SPDX-License-Identifier: Apache-2.0
"""Code that all starpos nodes share: clean exits, validated parameters, diagnostics, message conversions."""

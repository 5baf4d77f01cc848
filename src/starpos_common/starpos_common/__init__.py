# SPDX-License-Identifier: Apache-2.0
"""What every starpos node shares: clean exits, validated parameters, diagnostics, message conversions."""

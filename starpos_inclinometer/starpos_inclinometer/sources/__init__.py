# SPDX-License-Identifier: Apache-2.0
"""Where readings come from: a module a sensor."""

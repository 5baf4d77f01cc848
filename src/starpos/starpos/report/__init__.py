# SPDX-License-Identifier: Apache-2.0
"""A report on nights: what their frames gave, how steady that is, and what limits it.

`measures` computes numbers, `night_figures` and `coast` draw them, and `page` makes one HTML page.
"""

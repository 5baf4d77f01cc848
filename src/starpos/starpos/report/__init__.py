# SPDX-License-Identifier: Apache-2.0
"""A report on nights: what their frames gave, how steady that is, and what limits it.

`measures` computes numbers, the `*_figures` draw them, `page` makes one HTML page, and `writing` puts it on disk.
"""

# SPDX-License-Identifier: Apache-2.0
"""A report on a night: what its frames gave, how steady that is, and what limits it.

`folder` and `bag` read what there is to solve, `working` makes a Night of it, `measures` computes numbers, the
`*_figures` draw them, `page` makes one HTML page, and `writing` puts it on disk.
"""

# SPDX-License-Identifier: Apache-2.0
"""A night on a page: what its frames gave, how steady that is, and what limits it.

`folder` and `bag` say what there is to solve, `working` makes a Night of it, `measures` takes its numbers, the
`*_figures` draw them, `page` makes one HTML page of all, and `writing` puts it on disk.
"""

# SPDX-License-Identifier: Apache-2.0
"""One night, from its frames to its place: the path shared by the library, the commands, the report and the nodes.

`reading` reads and detects, `searching` identifies a frame by every way there is, `work` is the work on one frame.
`solving` goes through a night, or calibrates it by turning; `together` averages the fixes and checks them. The results
are values (`night`, `remarks`), which the commands and the report only word and draw.
"""

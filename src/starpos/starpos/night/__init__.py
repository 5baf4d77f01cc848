# SPDX-License-Identifier: Apache-2.0
"""One night, from its frames to its place: the way that the library, the commands, the report and the nodes all take.

`reading` reads and detects, `searching` identifies a frame by every way there is, `work` is what is done on one frame,
`solving` goes through a night, or turns it, `together` averages the fixes and doubts them. What comes of it are values
(`night`, `remarks`), which the commands and the report only word and draw.
"""

# SPDX-License-Identifier: Apache-2.0
"""One night, from its frames to its place: the path shared by the library, the commands and the report.

`reading` reads and detects, `work` is the work on one frame. `solving` is the driver: it answers a night's frames one
by one, by turning or compared with GNSS; `together` averages the fixes and checks them. A night comes from `opening` or
`bag`. The results are values (`night`, `remarks`), which the commands and the report only word and draw.
"""

# SPDX-License-Identifier: Apache-2.0
"""Network load between the mount's computer and the robot's: two hosts of Linux namespaces, full frames.

As root, with iproute2 and /dev/net/tun.  Counts the bytes of Ethernet in both directions, including DDS's own.  Detection
runs on the mount, so only stars and tilts cross.
"""

import tempfile
from pathlib import Path

from starpos_testing.domain import own_domain

CADENCE_S = 2.0


def options(parser) -> None:
    parser.add_argument("--frames", type=int, default=10)


def run(options) -> int:
    from starpos_testing.graph.link import FULL_FRAME_BYTES, TILT_RATE_HZ, traffic

    with own_domain(), tempfile.TemporaryDirectory() as folder:
        seen = traffic(Path(folder), options.frames, CADENCE_S)
    each, second = seen.bytes_per_frame, seen.bytes_per_second
    print(f"{seen.frames} frames, {seen.stars:.0f} stars each")
    print(f"a frame's stars      {each / 1e3:8.1f} kB")
    print(
        f"tilts, {TILT_RATE_HZ:2d} Hz         {second / 1e3:8.1f} kB/s, whatever DDS says beside them included"
    )
    print(f"at a frame a second  {(each + second) * 8e-6:8.2f} Mbit/s")
    print(
        f"raw frames would be  {FULL_FRAME_BYTES * 8e-6:8.0f} Mbit/s (calculated: {FULL_FRAME_BYTES} bytes each)"
    )
    return 0

# SPDX-License-Identifier: Apache-2.0
"""An unused ROS domain, for tests, demonstrations and soaks."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Above 101 the ports of DDS meet those that Linux hands out.
DOMAINS = range(1, 101)
# The lock of ROS's domain_coordinator, for domain 0: its users keep clear of ours so.
LOCK_PORT = 32768
# UDP ports: DDS's of domain 0, and how many each domain has (RTPS 2.5, 9.6.2.3).
FIRST_PORT, PORTS = 7400, 250


def _inhabited() -> set[int]:
    """The domains with listeners on this machine."""
    tables = [Path("/proc/net/udp"), Path("/proc/net/udp6")]
    rows = [row.split() for table in tables if table.is_file() for row in table.read_text().splitlines()[1:]]
    return {(int(row[1].rpartition(":")[2], 16) - FIRST_PORT) // PORTS for row in rows}


@contextmanager
def own_domain() -> Iterator[int]:
    """Set ROS_DOMAIN_ID to an empty domain and reserve it, on this machine only."""
    taken = _inhabited() | {int(os.environ.get("ROS_DOMAIN_ID") or 0)}
    for number in DOMAINS:
        if number in taken:
            continue
        with socket.socket() as lock:
            try:
                lock.bind(("", LOCK_PORT + number))
            except OSError:
                continue
            os.environ["ROS_DOMAIN_ID"] = str(number)
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            os.environ.pop("ROS_STATIC_PEERS", None)
            yield number
            return
    raise RuntimeError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are taken on this machine")

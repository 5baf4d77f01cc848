# SPDX-License-Identifier: Apache-2.0
"""Two hosts on one machine (Linux namespaces), and a cable between them that may lose and delay frames.

Each host has its own network, shared memory and name, so that only the cable joins them.  All of this ends with the
process that made it.
"""

import base64
import contextlib
import fcntl
import heapq
import json
import os
import queue
import random
import select
import shutil
import struct
import subprocess
import sys
import threading
import time
from itertools import count
from pathlib import Path

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import NavSatFix

from starpos_interfaces.msg import Solution
from starpos_testing.graph.graph import Executable, executable
from starpos_testing.lacking import lacks
from starpos_testing.patience import WAIT_S

DEVICE = "link0"
KINDS = {"solver/solution": Solution, "fix": NavSatFix}
TUN, TUNSETIFF, IFF_TAP, IFF_NO_PI = "/dev/net/tun", 0x400454CA, 0x0002, 0x1000
# time between two looks at a condition, which need not depend on a message
LOOK_S = 0.2
# the largest frame of a device with the usual MTU of 1500
ETHERNET_BYTES = 1514


def need() -> None:
    """Skip the test if this machine lacks the package, or the rights, to act as two hosts."""
    if not shutil.which("ip"):
        lacks("iproute2")
    unshared = subprocess.run(["unshare", "--net", "--mount", "true"], check=False, capture_output=True)
    if os.geteuid() or unshared.returncode:
        pytest.skip("network namespaces take root and the right to make them (CAP_SYS_ADMIN)")
    try:
        os.close(os.open(TUN, os.O_RDWR))
    except OSError as error:
        pytest.skip(f"{TUN}: {error.strerror}")


class Host:
    """A host; environment: variables that are set on it for ROS."""

    def __init__(self, name: str, **environment: str):
        made = (
            f"mount -t tmpfs tmpfs /dev/shm && hostname {name} && ip link set lo up && echo made && exec cat"
        )
        command = ["unshare", "--net", "--mount", "--uts", "--ipc", "--", "sh", "-c", made]
        # `cat` reads from this process and so ends with it
        self._holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._holder.stdout is not None
        assert self._holder.stdout.readline() == b"made\n"
        self.pid, self.name = self._holder.pid, name
        self.running: list[Program] = []
        ours = {k: v for k, v in os.environ.items() if k != "ROS_STATIC_PEERS"}
        self.environment = ours | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"} | environment

    def command(self, *words: str) -> list[str]:
        """A command line that runs these words on the host; signals reach them."""
        return ["nsenter", f"--target={self.pid}", "--net", "--mount", "--uts", "--ipc", "--", *words]

    def ip(self, *words: str) -> None:
        subprocess.run(self.command("ip", *words), check=True)

    def start(self, log: Path, package: str, name: str, *parameters: str, arguments=()) -> "Program":
        """Start an executable of this workspace; its output goes to `log`."""
        self.running.append(Program(self, log, package, name, arguments, parameters))
        return self.running[-1]

    def stop(self) -> None:
        """End all programs on the host."""
        while self.running:
            self.running.pop().end()

    def __enter__(self) -> "Host":
        return self

    def __exit__(self, *error) -> None:
        self.stop()
        self._holder.communicate()


class Program(Executable):
    """An executable on a host."""

    def __init__(self, host: Host, log: Path, package: str, name: str, arguments, parameters):
        options = [word for p in parameters for word in ("-p", p)]
        words = [executable(package, name), *arguments, *(["--ros-args", *options] if options else [])]
        self.name, self.log = name, log
        with log.open("w") as out:
            command = host.command(*words)
            self.process = subprocess.Popen(command, stdout=out, stderr=out, env=host.environment)


class Cable:
    """Ethernet between two hosts, 10.11.12.1 and .2, with faults.

    loss: share of the frames that are lost.  delay_s: of each frame.  multicast: whether multicast frames pass.
    passed: bytes that each host has sent, with Ethernet's headers.  refused: multicast frames that did not pass.
    """

    ADDRESSES = ("10.11.12.1", "10.11.12.2")

    def __init__(self, *hosts: Host):
        self.loss, self.delay_s, self.multicast = 0.0, 0.0, True
        self.passed, self.refused = [0, 0], [0, 0]
        self._random, self._order = random.Random(11), count()
        # frames on their way: (when, order, receiver, frame)
        self._late: list[tuple[float, int, int, bytes]] = []
        self._ends = [
            self._plug_in(k, *pair) for k, pair in enumerate(zip(hosts, self.ADDRESSES, strict=True))
        ]
        self._end_us, self._ended = os.pipe()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _plug_in(self, k: int, host: Host, address: str) -> int:
        device, end = f"sp{os.getpid()}-{k}", os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH22x", device.encode(), IFF_TAP | IFF_NO_PI))
        subprocess.run(["ip", "link", "set", device, "netns", str(host.pid), "name", DEVICE], check=True)
        host.ip("address", "add", f"{address}/24", "dev", DEVICE)
        host.ip("link", "set", DEVICE, "up")
        return end

    def __enter__(self) -> "Cable":
        return self

    def __exit__(self, *error) -> None:
        os.close(self._ended)
        self._thread.join()
        for end in (*self._ends, self._end_us):
            os.close(end)

    def _carry(self) -> None:
        while True:
            wait_s = max(self._late[0][0] - time.monotonic(), 0.0) if self._late else None
            ready, _, _ = select.select([*self._ends, self._end_us], [], [], wait_s)
            if self._end_us in ready:
                return
            for sender, end in enumerate(self._ends):
                if end in ready:
                    self._take(sender, _read(end))
            while self._late and self._late[0][0] <= time.monotonic():
                _, _, receiver, frame = heapq.heappop(self._late)
                _write(self._ends[receiver], frame)

    def _take(self, sender: int, frame: bytes) -> None:
        # the lowest bit of the first byte marks a group; ff:... is the broadcast that asks for addresses
        group = frame[:1] != b"\xff" and frame[:1] and frame[0] & 1
        if group and not self.multicast:
            self.refused[sender] += 1
        elif frame and self._random.random() >= self.loss:
            self.passed[sender] += len(frame)
            when = time.monotonic() + self.delay_s
            heapq.heappush(self._late, (when, next(self._order), 1 - sender, frame))

    # last, because its name hides the type's from there on
    @property
    def bytes(self) -> int:
        """Bytes that have gone over the cable so far, both ways."""
        return sum(self.passed)


def _read(end: int) -> bytes:
    try:
        return os.read(end, ETHERNET_BYTES)
    except OSError:
        # The device is down.
        return b""


def _write(end: int, frame: bytes) -> None:
    # The device is down, or its queue is full.
    with contextlib.suppress(OSError):
        os.write(end, frame)


class Ear:
    """A listener on a host to the topics of the solver there."""

    def __init__(self, host: Host):
        command = host.command(sys.executable, str(Path(__file__).with_name("host_ear.py")), *KINDS)
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=host.environment
        )
        self._lines: queue.Queue[bytes] = queue.Queue()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()
        # by topic and stamp, the newest message
        self.heard: dict[str, dict] = {topic: {} for topic in KINDS}
        # by stamp, the monotonic time of a solution
        self.at_s: dict[tuple, float] = {}

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)

    def __enter__(self) -> "Ear":
        return self

    def __exit__(self, *error) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        # the program ends with its input
        self._process.stdin.close()
        try:
            self._process.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._thread.join()
        self._process.stdout.close()

    @property
    def solutions(self) -> dict:
        return self.heard["solver/solution"]

    @property
    def fixed(self) -> list[tuple[int, int]]:
        """The stamps of the solutions that are fixes, in order."""
        return sorted(stamp for stamp, s in self.solutions.items() if s.status == Solution.OK)

    def comes(self, condition, seconds: float) -> bool:
        """Whether a condition becomes true within a time in s."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            try:
                line = json.loads(self._lines.get(timeout=min(LOOK_S, max(end - time.monotonic(), 0.0))))
            except queue.Empty:
                continue
            message = deserialize_message(base64.b64decode(line["data"]), KINDS[line["topic"]])
            stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
            self.heard[line["topic"]][stamp] = message
            if line["topic"] == "solver/solution":
                self.at_s[stamp] = line["at_s"]
        return True

    def wait(self, condition, *hosts: Host, seconds=WAIT_S) -> None:
        """Wait until a condition is true; raises AssertionError with the output of the hosts' programs."""
        if not self.comes(condition, seconds):
            said = [f"{h.name} {p.name}: {p.output[-2000:]}" for h in hosts for p in h.running]
            raise AssertionError("\n".join([f"waited {seconds:g} s in vain", *said]))

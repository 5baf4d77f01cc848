# SPDX-License-Identifier: Apache-2.0
"""The real indiserver with the real CCD simulator, or with a driver of ours that lies; and another client of it."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

from starpos_testing.lacking import lacks
from starpos_testing.patience import WAIT_S

SIMULATOR, DEVICE = "indi_simulator_ccd", "CCD Simulator"
LIAR = Path(__file__).parent / "indi_liar.py"


class IndiServer:
    """An indiserver of its own port, with its drivers; `start` again after `kill`."""

    def __init__(self, folder, *drivers):
        for program in ("indiserver", SIMULATOR):
            if not shutil.which(program):
                lacks("indi-bin")
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self._drivers = drivers or (SIMULATOR,)
        self._process = None

    def start(self, **lies):
        """Begin to serve; `lies` are what the driver of ours is to say."""
        command = [
            "indiserver",
            "-v",
            "-p",
            str(self.port),
            "-u",
            str(self.folder / "socket"),
            *self._drivers,
        ]
        environment = os.environ | {"HOME": str(self.folder), "STARPOS_LIES": json.dumps(lies)}
        self._process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for line in self._process.stderr:
            if "listening to port" in line:
                break
        else:
            raise AssertionError("indiserver has not started")
        return self

    def drivers(self) -> list[int]:
        """The drivers' process ids."""
        number = self._process.pid
        return [int(n) for n in Path(f"/proc/{number}/task/{number}/children").read_text().split()]

    def kill(self):
        """The server, and its drivers, which end with it."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        self._process.stderr.close()
        self._process = None

    def kill_driver(self):
        for number in self.drivers():
            os.kill(number, signal.SIGKILL)


class OtherClient:
    """Another client of the server: commands a device, and waits for its reply."""

    def __init__(self, server):
        self._socket = socket.create_connection(("127.0.0.1", server.port), WAIT_S)
        self._heard = b""
        self._socket.sendall(b'<getProperties version="1.7"/>')

    def tell(self, kind: str, vector: str, device: str = DEVICE, **members):
        """kind: Switch, Number or Text."""
        inner = "".join(f'<one{kind} name="{name}">{value}</one{kind}>' for name, value in members.items())
        text = f'<new{kind}Vector device="{device}" name="{vector}">{inner}</new{kind}Vector>'
        self._socket.sendall(text.encode())

    def meet(self, device: str):
        """Wait until the device has said what it is made of: its driver has started."""
        while f'device="{device}"'.encode() not in self._heard:
            data = self._socket.recv(65536)
            assert data, "the server has gone"
            self._heard += data

    def hear(self, vector: str, state: str, first: str = ""):
        """Wait until the device sets the vector with this state, and its first member so; what was said is forgotten."""
        pattern = rf'<set\w+Vector[^>]*name="{vector}"[^>]*state="{state}"[^>]*>\s*<\w+[^>]*>\s*{first}'
        pattern = re.compile(pattern.encode())
        while not (found := pattern.search(self._heard)):
            data = self._socket.recv(65536)
            assert data, "the server has gone"
            self._heard += data
        self._heard = self._heard[found.end() :]

    def catch_up(self):
        """Forget what was said until now."""
        self._socket.sendall(f'<getProperties version="1.7" device="{DEVICE}" name="CONNECTION"/>'.encode())
        self._heard = b""
        while b'name="CONNECTION"' not in self._heard:
            self._heard += self._socket.recv(65536)
        self._heard = b""

    def close(self):
        self._socket.close()


def executable_liar(folder) -> str:
    """A driver's program, which is what indiserver starts."""
    path = folder / "indi_liar"
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{LIAR}"\n')
    path.chmod(0o755)
    return str(path)

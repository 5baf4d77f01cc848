# SPDX-License-Identifier: Apache-2.0
"""The firmware on an emulated board (sim): built, started, given a tilt, and read."""

import json
import os
import select
import shutil
import subprocess
import tty
from pathlib import Path

from starpos_inclinometer.sources.mcu_protocol import Continuity, LineParser, Sample
from starpos_testing.lacking import lacks
from starpos_testing.patience import WAIT_S

FIRMWARE = Path(__file__).parent.parent / "firmware"
ELF, SIM = "{}.elf", "inclinometer-sim"
NEEDED = {
    "gcc-avr": lambda: shutil.which("avr-gcc"),
    "avr-libc": lambda: preprocesses("avr-gcc", "-mmcu=atmega8", "avr/io.h"),
    "libsimavr-dev": lambda: preprocesses("cc", "-I/usr/include/simavr", "simavr/sim_avr.h"),
    "libelf-dev": lambda: preprocesses("cc", "-I/usr/include", "libelf.h"),
}


def preprocesses(compiler, option, header) -> bool:
    command = [compiler, option, "-E", "-include", header, "-x", "c", os.devnull]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def build(folder) -> Path:
    """The firmware and its emulator, compiled into the folder."""
    for package, there in NEEDED.items():
        if not there():
            lacks(package)
    command = ["make", "-C", str(FIRMWARE), f"BUILD={folder}", "all", "sim"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return folder


class Board:
    """A board that runs; at speed 0 its time passes by `run` only."""

    def __init__(self, folder, *options, speed=0, board="paper"):
        command = [
            folder / SIM,
            folder / ELF.format(board),
            "--board",
            board,
            "--speed",
            str(speed),
            *options,
        ]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.path = self.process.stdout.readline().strip()
        assert self.path, self.process.communicate()[1]
        self.parser = LineParser()
        self.continuity = Continuity(self.parser.counts)
        self._host = None
        self._read = self._written = 0

    def tell(self, command) -> dict:
        """The board's identity after the command; what it sends meanwhile is lost without a reader."""
        print(command, file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        assert answer.startswith("{"), answer
        return json.loads(answer)

    def connect(self):
        """Be the host: from now on `run` reads what is sent."""
        self._host = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._host)

    def run(self, milliseconds, send=b"") -> bytes:
        """Let time pass once the bytes have been sent; all that comes in that time."""
        os.write(self._host, send)
        self._written += len(send)
        print(f"run {milliseconds} {self._written}", file=self.process.stdin, flush=True)
        answer, data, total = self.process.stdout.fileno(), b"", None
        while total is None or self._read < total:
            ready, _, _ = select.select(
                [self._host] if total is not None else [self._host, answer], [], [], WAIT_S
            )
            assert ready, f"{self._read} of {total} bytes came"
            if self._host in ready:
                data += (chunk := os.read(self._host, 65536))
                self._read += len(chunk)
            if answer in ready:
                total = json.loads(self.process.stdout.readline())["sent"]
        return data

    def messages(self, milliseconds, send=b"") -> list:
        """The messages in what comes."""
        return self.parse(self.run(milliseconds, send))

    def parse(self, data) -> list:
        """Every message in the bytes, samples with what was lost before them: no other judgement."""
        messages = self.parser.parse(data)
        return [self.continuity.follow(m) if isinstance(m, Sample) else m for m in messages]

    def close(self) -> str:
        """End it; return violations of the parts' data sheets by the firmware."""
        complaints = self.tell("state")["complaints"]
        self.process.terminate()
        _, error = self.process.communicate(timeout=WAIT_S)
        assert (self.process.returncode, error) == (0, "")
        if self._host is not None:
            os.close(self._host)
        return complaints

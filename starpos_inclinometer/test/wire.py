# SPDX-License-Identifier: Apache-2.0
"""The cable between a board and its host, which can be pulled, and spoil what goes through it."""

import os
import random
import select
import threading
import tty

from starpos_inclinometer.sources.mcu_protocol import LineParser, Sample
from starpos_testing.emulator import Faults, Pty

WATCH_S = 0.05


class Wire:
    """Carries lines from the board's port to the one under `path`, each through `faults`, and bytes back.

    sent: every sample the board has said since the wire was made.
    """

    def __init__(self, board_path, path):
        self.path = str(path)
        self.faults = Faults()
        self.sent: list[Sample] = []
        self._board_path = board_path
        self._parser = LineParser()
        self._rng = random.Random(1)
        self._thread = None
        self._cut = threading.Event()
        self.join()

    def join(self):
        """Plug it in."""
        self._cut.clear()
        port = Pty(self.path)
        self._thread = threading.Thread(target=self._carry, args=(port,))
        self._thread.start()

    def cut(self):
        """Pull it out, in the middle of a line if there is one."""
        if self._thread:
            self._cut.set()
            self._thread.join()
            self._thread = None

    def _carry(self, port):
        board = os.open(self._board_path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(board)
        rest = b""
        try:
            while not self._cut.is_set():
                ready, _, _ = select.select([board], [], [], WATCH_S if not rest else 0.01)
                if back := port.read():
                    os.write(board, back)
                if not ready:
                    continue
                *lines, rest = (rest + os.read(board, 4096)).split(b"\n")
                for line in lines:
                    whole = line + b"\n"
                    self.sent += [m for m in self._parser.parse(whole) if isinstance(m, Sample)]
                    port.write(self.faults.apply(whole, self._rng))
        finally:
            port.write(rest)
            port.close()
            os.close(board)

# SPDX-License-Identifier: Apache-2.0
"""An emulated device that tests plug in and pull out, and a place for its port; the firmware, built."""

import threading

import pytest
from board import build
from reader import Reader

from starpos_testing.emulator import Emulator, Mcu


class Bench:
    """A port's path and, while it is plugged in, an emulator behind it."""

    def __init__(self, path):
        self.path = str(path)
        self.emulator = None
        self._thread = None
        self._stop = threading.Event()

    def plug(self, mcu=None, **options):
        self._stop.clear()
        self.emulator = Emulator(mcu or Mcu(seed=1), self.path, **options)
        self._thread = threading.Thread(target=self.emulator.run, args=(self._stop.is_set,))
        self._thread.start()

    def unplug(self):
        if self._thread:
            self._stop.set()
            self._thread.join()
            self._thread = None


@pytest.fixture
def bench(tmp_path):
    bench = Bench(tmp_path / "port")
    yield bench
    bench.unplug()


@pytest.fixture
def read(bench):
    """Makes readers of the bench's port, or of another."""
    readers = []

    def make(path=bench.path, **options):
        readers.append(Reader(path, **options))
        return readers[-1]

    yield make
    for reader in readers:
        reader.close()


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """The folder of the firmware and its emulated board; without what compiles them the tests of it skip."""
    return build(tmp_path_factory.mktemp("firmware"))

# SPDX-License-Identifier: Apache-2.0
"""An INDI server as a blocking caller sees it: indipyclient's event loop in a thread of its own."""

import asyncio
import concurrent.futures
import logging
import threading
from collections.abc import Callable, Coroutine
from dataclasses import dataclass

from starpos.errors import one_line
from starpos_camera.sources.source import CaptureError

BEAT_S = 0.5  # a server that has gone is noticed two of these later
LEAVE_S = 2.0


@dataclass(frozen=True, eq=False)
class Blob:
    """What a BLOB vector brought: its bytes, and what the driver says they are (`size` before any compression)."""

    data: bytes
    size: int
    format: str


class IndiServer:
    """One connection to an INDI server, made when this is, and of no more use once it is lost.

    `run` is for the caller's thread, `close` for any; all else is for the coroutine that `run` runs.
    """

    def __init__(self, host: str, port: int):
        from indipyclient import IPyClient

        logging.getLogger("indipyclient").setLevel(logging.CRITICAL)  # it prints; what matters we say
        self._client = IPyClient(host, port)
        self._client.timeout_enable = False
        self._client.rxevent = self._on_event
        self.lost = False
        self.blob: Blob | None = None  # the newest
        self.definitions: dict[
            str, int
        ] = {}  # of each device's CONNECTION, since it came or was disconnected
        self._loop = self._talking = self._working = None
        self._leaving = False
        self._changed = asyncio.Event()
        started = threading.Event()
        self._thread = threading.Thread(target=self._run_loop, args=(started,), name="indi", daemon=True)
        self._thread.start()
        started.wait()

    def run(self, work: Coroutine):
        """What the coroutine returns or raises; CaptureError if `close` ends it."""
        watched = self._watch(work)
        try:
            future = asyncio.run_coroutine_threadsafe(watched, self._loop)
            while not future.done() and self._thread.is_alive():
                concurrent.futures.wait([future], BEAT_S)
        except RuntimeError:  # the loop has ended
            watched.close()
            future = None
        if future is None or not future.done() or future.cancelled():
            work.close()
            raise CaptureError("the connection to the INDI server was closed; the frame is given up.")
        return future.result()

    def close(self):
        """Cancel the work, which may still tell the device of it, and leave the server."""
        leaving = self._leave()
        try:
            asyncio.run_coroutine_threadsafe(leaving, self._loop)
        except RuntimeError:  # the loop has ended
            leaving.close()
            return
        self._thread.join(2 * LEAVE_S)

    @property
    def connected(self) -> bool:
        return self._client.connected

    def device_names(self) -> list[str]:
        """Of those that are there now."""
        return [one_line(name) for name, found in self._client.items() if found.enable]

    def device(self, name: str) -> "IndiDevice":
        """One by its name, whether it is there or not."""
        return IndiDevice(self, self._client, name)

    async def until(self, condition: Callable[[], object], seconds: float) -> bool:
        """Wait until something holds that a server or a device says; False where the time or the server ends before."""
        end = self._loop.time() + seconds
        while not (found := condition()) and not self.lost and (left := end - self._loop.time()) > 0:
            if self._leaving:  # wait_for of Python 3.11 may lose a cancellation
                raise asyncio.CancelledError
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), min(left, BEAT_S))
            except asyncio.TimeoutError:
                # no device has it, so nobody answers; but that a server has gone is noticed by writing only
                await self._client.send_getProperties("starpos", "CONNECTION")
        return bool(found)

    async def _on_event(self, event):
        if event.eventtype == "ConnectionLost":
            self.lost = True
        elif event.eventtype == "Delete" and event.vectorname in (None, "CCD1"):  # gone, or disconnected
            self.definitions.pop(event.devicename, None)
        elif event.eventtype == "Define" and event.vectorname == "CONNECTION":
            self.definitions[event.devicename] = self.definitions.get(event.devicename, 0) + 1
        elif event.eventtype == "SetBLOB":
            for name, data in event.items():
                self.blob = Blob(data, *event.sizeformat[name])
                event.vector.member(name).membervalue = b"-"  # else the client keeps it until the next comes
        self._changed.set()

    def _run_loop(self, started):
        async def talk():
            self._loop, self._talking = asyncio.get_running_loop(), asyncio.current_task()
            started.set()
            await self._client.asyncrun()

        try:
            asyncio.run(talk())
        except asyncio.CancelledError:
            pass
        finally:
            self.lost = True

    async def _watch(self, work):
        self._working = asyncio.current_task()
        return await work

    async def _leave(self):
        self._leaving = True
        self._changed.set()
        if self._working and not self._working.done():
            self._working.cancel()
            await asyncio.wait({self._working}, timeout=LEAVE_S)
        self._talking.cancel()


class IndiDevice:
    """What a device of a server says, as of now, and what it is told. One that is not there has no vectors."""

    def __init__(self, server: IndiServer, client, name: str):
        self.server, self.name = server, name
        self._client = client

    def has(self, vector: str) -> bool:
        return self._vector(vector) is not None

    async def settled(self, seconds: float) -> bool:
        """Wait until it has defined all it has: nothing marks the end, but it answers one question after the other."""

        def answers():
            return self.server.definitions.get(self.name, 0)

        for _ in range(answers(), 2):
            await self._client.send_getProperties(self.name, "CONNECTION")
        return await self.server.until(lambda: answers() > 1, seconds)

    def state(self, vector: str) -> str | None:
        """Idle, Ok, Busy or Alert; None where there is no such vector."""
        found = self._vector(vector)
        return found.state if found is not None else None

    def value(self, vector: str, member: str) -> str | None:
        """The text of a member, None where there is none."""
        found = self._vector(vector)
        return found.get(member) if found is not None else None

    def number(self, vector: str, member: str) -> float | None:
        """The same as a number, None also where it is none."""
        return _number(self.value(vector, member))

    def limits(self, vector: str, member: str) -> tuple[float | None, float | None]:
        """The least and the greatest value that a number the device has may be given."""
        found = self._vector(vector).member(member)
        return _number(found.min), _number(found.max)

    def said(self) -> str:
        """Its last message since `forget`, in brackets; "" if it said nothing."""
        messages = self._client[self.name].messages if self.name in self._client else ()
        return f" ({one_line(messages[0][1])})" if messages else ""

    def forget(self):
        """Its messages until now, and the server's BLOB."""
        self.server.blob = None
        if self.name in self._client:
            self._client[self.name].messages.clear()

    async def send(self, vector: str, **members: str):
        """Set members of a vector, which is Busy until the device answers. Sending to one that has gone does nothing."""
        await self._client.send_newVector(self.name, vector, members=members)

    async def enable_blobs(self, vector: str):
        """Have the server send us what the vector brings, beside all else."""
        await self._client.send_enableBLOB("Also", self.name, vector)

    def _vector(self, vector):
        found = self._client[self.name].get(vector) if self.name in self._client else None
        return found if found is not None and found.enable else None


def _number(text):
    from indipyclient import getfloat

    try:
        return getfloat(text)
    except TypeError:
        return None

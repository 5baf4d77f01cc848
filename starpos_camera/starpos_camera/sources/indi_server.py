# SPDX-License-Identifier: Apache-2.0
"""Connection to an INDI server for blocking callers: indipyclient's event loop runs in a thread of its own."""

import asyncio
import concurrent.futures
import logging
import threading
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from starpos.errors import one_line
from starpos_camera.sources.source import CaptureError

if TYPE_CHECKING:
    from indipyclient import IPyClient

# A server that has gone is noticed after two of these.
BEAT_S = 0.5
LEAVE_S = 2.0
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Blob:
    """Content of a BLOB vector: bytes, and their format and size as the driver states them (size before compression)."""

    data: bytes
    size: int
    format: str


class IndiServer:
    """One connection to an INDI server, opened at once; make a new one when it is lost.

    The caller's thread calls `run`, any thread `close`; only the coroutine inside `run` uses the rest.
    """

    def __init__(self, host: str, port: int) -> None:
        from indipyclient import IPyClient

        # The library prints errors that are reported here anyway.
        logging.getLogger("indipyclient").setLevel(logging.CRITICAL)
        self._client = IPyClient(host, port)
        self._client.timeout_enable = False
        self._client.rxevent = self._on_event
        self.lost = False
        # The newest one.
        self.blob: Blob | None = None
        # How often each device has defined CONNECTION since it came or was disconnected.
        self.definitions: dict[str, int] = {}
        # The thread sets the loop before `started`.
        self._loop: asyncio.AbstractEventLoop
        self._talking: asyncio.Task[Any] | None = None
        self._working: asyncio.Task[Any] | None = None
        self._leaving = False
        self._changed = asyncio.Event()
        started = threading.Event()
        self._thread = threading.Thread(target=self._run_loop, args=(started,), name="indi", daemon=True)
        self._thread.start()
        started.wait()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine; return or raise as it does; CaptureError if `close` ends it."""
        watched = self._watch(work)
        future: concurrent.futures.Future[T] | None = None
        try:
            future = asyncio.run_coroutine_threadsafe(watched, self._loop)
            while not future.done() and self._thread.is_alive():
                concurrent.futures.wait([future], BEAT_S)
        except RuntimeError:
            # The loop has ended.
            watched.close()
            future = None
        if future is None or not future.done() or future.cancelled():
            work.close()
            raise CaptureError("the connection to the INDI server was closed; the frame is given up.")
        return future.result()

    def close(self) -> None:
        """Cancel the work, which may still send commands to the device, and leave the server."""
        leaving = self._leave()
        try:
            asyncio.run_coroutine_threadsafe(leaving, self._loop)
        except RuntimeError:
            # The loop has ended.
            leaving.close()
            return
        self._thread.join(2 * LEAVE_S)

    @property
    def connected(self) -> bool:
        return self._client.connected

    def device_names(self) -> list[str]:
        """Names of the devices that are there now."""
        return [one_line(name) for name, found in self._client.items() if found.enable]

    def device(self, name: str) -> "IndiDevice":
        """Return a device by its name, whether it is there or not."""
        return IndiDevice(self, self._client, name)

    async def until(self, condition: Callable[[], object], seconds: float) -> bool:
        """Wait for a condition on what server and devices say; False if the time or the connection ends before."""
        end = self._loop.time() + seconds
        while not (found := condition()) and not self.lost and (left := end - self._loop.time()) > 0:
            # wait_for of Python 3.11 may lose a cancellation.
            if self._leaving:
                raise asyncio.CancelledError
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), min(left, BEAT_S))
            except asyncio.TimeoutError:
                # Only writing shows that a server has gone. No device has this name, so none answers.
                await self._client.send_getProperties("starpos", "CONNECTION")
        return bool(found)

    async def _on_event(self, event: Any) -> None:
        if event.eventtype == "ConnectionLost":
            self.lost = True
        elif event.eventtype == "Delete" and event.vectorname in (None, "CCD1"):
            # The device has gone, or was disconnected.
            self.definitions.pop(event.devicename, None)
        elif event.eventtype == "Define" and event.vectorname == "CONNECTION":
            self.definitions[event.devicename] = self.definitions.get(event.devicename, 0) + 1
        elif event.eventtype == "SetBLOB":
            for name, data in event.items():
                self.blob = Blob(data, *event.sizeformat[name])
                # Otherwise the client keeps the bytes until the next BLOB comes.
                event.vector.member(name).membervalue = b"-"
        self._changed.set()

    def _run_loop(self, started: threading.Event) -> None:
        async def talk() -> None:
            self._loop, self._talking = asyncio.get_running_loop(), asyncio.current_task()
            started.set()
            await self._client.asyncrun()

        try:
            asyncio.run(talk())
        except asyncio.CancelledError:
            pass
        finally:
            self.lost = True

    async def _watch(self, work: Coroutine[Any, Any, T]) -> T:
        self._working = asyncio.current_task()
        return await work

    async def _leave(self) -> None:
        self._leaving = True
        self._changed.set()
        if self._working and not self._working.done():
            self._working.cancel()
            await asyncio.wait({self._working}, timeout=LEAVE_S)
        if self._talking is not None:
            self._talking.cancel()


class IndiDevice:
    """The present vectors of a device, and commands to it. A device that is not there has no vectors."""

    def __init__(self, server: IndiServer, client: "IPyClient", name: str) -> None:
        self.server, self.name = server, name
        self._client = client

    def has(self, vector: str) -> bool:
        return self._vector(vector) is not None

    async def settled(self, seconds: float) -> bool:
        """Wait until the device has defined all its vectors.

        Nothing marks their end, but a device answers questions in order: a second answer comes after the definitions.
        """

        def answers() -> int:
            return self.server.definitions.get(self.name, 0)

        for _ in range(answers(), 2):
            await self._client.send_getProperties(self.name, "CONNECTION")
        return await self.server.until(lambda: answers() > 1, seconds)

    def state(self, vector: str) -> str | None:
        """Idle, Ok, Busy or Alert; None without such a vector."""
        found = self._vector(vector)
        return found.state if found is not None else None

    def value(self, vector: str, member: str) -> str | None:
        """Text of a member; None without one."""
        found = self._vector(vector)
        return found.get(member) if found is not None else None

    def number(self, vector: str, member: str) -> float | None:
        """Value of a member as a number; None without one."""
        return _number(self.value(vector, member))

    def limits(self, vector: str, member: str) -> tuple[float | None, float | None]:
        """Smallest and largest allowed value of a number; None where the device states none."""
        found = self._vector(vector)
        if found is None:
            return None, None
        found = found.member(member)
        return _number(found.min), _number(found.max)

    def said(self) -> str:
        """Last message of the device since `forget`, in brackets; "" without one."""
        messages = self._client[self.name].messages if self.name in self._client else ()
        return f" ({one_line(messages[0][1])})" if messages else ""

    def forget(self) -> None:
        """Forget the messages of the device until now, and the BLOB of the server."""
        self.server.blob = None
        if self.name in self._client:
            self._client[self.name].messages.clear()

    async def send(self, vector: str, **members: str) -> None:
        """Set members of a vector, which is Busy until the device answers; does nothing if the device has gone."""
        await self._client.send_newVector(self.name, vector, members=members)

    async def enable_blobs(self, vector: str) -> None:
        """Ask the server to send the BLOBs of a vector, besides everything else."""
        await self._client.send_enableBLOB("Also", self.name, vector)

    def _vector(self, vector: str) -> Any:
        found = self._client[self.name].get(vector) if self.name in self._client else None
        return found if found is not None and found.enable else None


def _number(text: str | None) -> float | None:
    from indipyclient import getfloat

    try:
        return getfloat(text)
    except TypeError:
        return None

# SPDX-License-Identifier: Apache-2.0
"""The camera in use, and the Solver for it."""

from collections import deque
from collections.abc import Callable
from typing import Any

from starpos.errors import InstrumentError, StarposError
from starpos.fix.solver import Solver
from starpos.instrument.camera import Camera
from starpos.messages.camera import leaves_size_open, message_to_camera
from starpos.messages.stamp import stamp_to_unix
from starpos.session.driver import Jobs, Outcome, name_in

MAX_CHANGES = 1000


class CameraSolver:
    """Keeps the camera that frames are of, and makes its Solver as a job when it changes.

    make: makes the Solver for a camera with the present parameters and calibration; it may raise a StarposError.
    changed: called when the camera is another one.  say: takes a sentence about why there is no Solver, or what the
    catalogue lacks for it.
    """

    def __init__(
        self,
        make: Callable[[Camera], Solver],
        changed: Callable[[], None],
        jobs: Jobs,
        say: Callable[[str], object],
        topic: str,
    ) -> None:
        self.camera: Camera | None = None
        self.solver: Solver | None = None
        # why there is no solver
        self.trouble = ""
        self._make, self._changed, self._jobs, self._say, self._topic = make, changed, jobs, say, topic
        self._frame_px: tuple[int, int] | None = None
        # the last CameraInfo, if it states no size
        self._of_open_size: Any = None
        # name of its frame; '' before the first CameraInfo
        self.frame_id = ""
        # cameras, or the reason for their lack, that hold from a stamp on which no frame has reached yet
        self._changes: deque[tuple[float | None, Camera | str]] = deque(maxlen=MAX_CHANGES)

    @property
    def preparing(self) -> bool:
        """Whether the triangles of a field are being built."""
        return self._jobs.busy

    @property
    def solver_now(self) -> Solver:
        """The solver; InstrumentError with the reason while it is missing."""
        if self.solver is not None:
            return self.solver
        waiting = f"{self._topic}: no camera calibration has arrived: start the camera"
        if self.preparing:
            waiting = "the triangles of this field are being built"
        raise InstrumentError(self.trouble or waiting)

    def receive(self, message: Any, at_once: bool) -> None:
        """Use a CameraInfo for the frames from its stamp on, or at once; the first one counts at once anyway.

        One that leaves the size open waits for a frame. InstrumentError if it cannot be used; then the camera before is
        no longer the one in use either.
        """
        size = self._frame_px or (1, 1)
        try:
            camera, open_size = message_to_camera(message, size=size), leaves_size_open(message)
        except StarposError as e:
            self._of_open_size = None
            self._queue(str(e), stamp_to_unix(message.header.stamp), at_once)
            raise
        self._of_open_size, self.frame_id = message if open_size else None, name_in(message)
        if self._frame_px is not None or not open_size:
            self._queue(camera, stamp_to_unix(message.header.stamp), at_once)

    def use_known(self, camera: Camera) -> None:
        """Use a camera that is known without a CameraInfo."""
        self._queue(camera, None, at_once=True)

    def note_frame_size(self, width: int, height: int, at_once: bool) -> None:
        """Note the size of a frame, px: a CameraInfo that leaves its size open takes it."""
        if (width, height) != self._frame_px:
            self._frame_px = width, height
            if self._of_open_size is not None:
                self.receive(self._of_open_size, at_once)

    def _queue(self, camera: Camera | str, since_s: float | None, at_once: bool) -> None:
        if camera == (self._changes[-1][1] if self._changes else self.camera):
            return
        if at_once or self.camera is None:
            self._begin(camera)
        else:
            self._changes.append((since_s, camera))

    def advance_to(self, mid_unix_s: float | None) -> None:
        """Take the cameras into use that hold for a frame of that time."""
        while self._changes and not self.preparing:
            since_s, camera = self._changes[0]
            if since_s is not None and mid_unix_s is not None and since_s > mid_unix_s:
                return
            self._changes.popleft()
            self._begin(camera)

    def remake(self) -> None:
        """Make the solver again with the present parameters and calibration."""
        if self.camera is None or self.preparing:
            return
        if self.solver is None:
            self._prepare(self.camera)
        else:
            self.solver = self._make(self.camera)

    def _begin(self, camera: Camera | str) -> None:
        """Use a camera, or none, for the reason given."""
        before, self.solver = self.camera, None
        self.camera, self.trouble = (camera, "") if isinstance(camera, Camera) else (None, camera)
        if before != self.camera:
            self._changed()
        if self.camera is not None and not self.preparing:
            self._prepare(self.camera)

    def _prepare(self, camera: Camera) -> None:
        """Prepare the triangles of this field as a job, because building them takes seconds."""

        def work() -> tuple[Solver, str]:
            solver = self._make(camera)
            return solver, solver.prepare(camera.width, camera.height)

        self._jobs.run(work, lambda made: self._prepared(camera, made))

    def _prepared(self, camera: Camera, made: Outcome) -> None:
        if self.camera is None:
            # A camera_info was refused meanwhile.
            return
        if camera != self.camera:
            # Another camera_info has come meanwhile.
            self._prepare(self.camera)
            return
        (self.solver, thin), self.trouble = made.value or (None, ""), made.trouble
        if self.trouble or thin:
            self._say(self.trouble or thin)
        if self.solver is not None:
            # The parameters may have changed meanwhile.
            self.remake()

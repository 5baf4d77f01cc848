# SPDX-License-Identifier: Apache-2.0
"""The Solver of the camera in use: what its catalogue lacks is said once it is prepared."""

from types import SimpleNamespace

import pytest

from starpos.errors import InstrumentError
from starpos.instrument.camera import Camera
from starpos.session.camera_solver import CameraSolver
from starpos.session.driver import JobsInTurn

CAMERA = Camera.from_focal(1000, 700, 80_000.0)


def info(**changes):
    """A CameraInfo of that camera."""
    f, (cx, cy) = CAMERA.fx, CAMERA.centre_px
    about = {
        "header": SimpleNamespace(frame_id="camera", stamp=SimpleNamespace(sec=1793642400, nanosec=0)),
        "width": CAMERA.width,
        "height": CAMERA.height,
        "k": [f, 0, cx, 0, f, cy, 0, 0, 1.0],
        "d": [],
        "distortion_model": "plumb_bob",
        "binning_x": 0,
        "binning_y": 0,
        "roi": SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0),
    }
    return SimpleNamespace(**{**about, **changes})


class Prepared:
    """A solver whose tables are made at once."""

    def __init__(self, thin=""):
        self.thin = thin

    def prepare(self, width, height):
        if self.thin is None:
            raise InstrumentError("no such field")
        return self.thin


def taken(solver):
    """The CameraSolver that has taken a camera, and what it has said."""
    said, jobs = [], JobsInTurn(print)
    camera_solver = CameraSolver(lambda camera: solver, lambda: None, jobs, said.append, "camera/camera_info")
    camera_solver.receive(info(), at_once=True)
    jobs.work()
    return camera_solver, said


def test_what_a_field_lacks_is_said_and_the_solver_is_there():
    solver = Prepared("a field holds only 3 stars")
    camera_solver, said = taken(solver)
    assert camera_solver.solver is solver and said == [solver.thin]


def test_nothing_is_said_of_a_field_with_enough_stars():
    solver = Prepared()
    camera_solver, said = taken(solver)
    assert camera_solver.solver is solver and said == [] and not camera_solver.trouble


def test_a_field_that_cannot_be_leaves_no_solver():
    camera_solver, said = taken(Prepared(thin=None))
    assert camera_solver.solver is None and said == ["no such field"] == [camera_solver.trouble]


def test_a_camera_of_no_size_has_that_of_the_frames():
    jobs = JobsInTurn(print)
    camera_solver = CameraSolver(lambda camera: Prepared(), lambda: None, jobs, print, "camera/camera_info")
    camera_solver.receive(info(width=0, height=0), at_once=True)
    assert camera_solver.camera is None
    with pytest.raises(InstrumentError, match="not calibrated"):
        camera_solver.receive(info(width=0, height=0, k=[0.0] * 9), at_once=True)
    camera_solver.receive(info(width=0, height=0), at_once=True)
    for size in ((1000, 700), (500, 300)):
        camera_solver.note_frame_size(*size, at_once=True)
        jobs.work()
        assert (camera_solver.camera.width, camera_solver.camera.height) == size
        assert camera_solver.camera.fx == CAMERA.fx and camera_solver.solver is not None
    # it counts for the frames that follow, too
    camera_solver.receive(info(width=0, height=0), at_once=True)
    assert camera_solver.camera.width == 500


BROKEN = [0.0] * 9
CROPPED = [CAMERA.fx, 0, 199.5, 0, CAMERA.fx, 149.5, 0, 0, 1.0]


@pytest.mark.parametrize("matrix", [BROKEN, CROPPED])
def test_after_a_refused_camera_info_no_older_one_stays_in_force(matrix):
    camera_solver, _ = taken(Prepared())
    with pytest.raises(InstrumentError) as refused:
        camera_solver.receive(info(k=matrix), at_once=True)
    assert camera_solver.solver is None and camera_solver.camera is None
    with pytest.raises(InstrumentError, match="camera_info"):
        _ = camera_solver.solver_now
    assert camera_solver.trouble == str(refused.value)


def test_a_good_camera_info_after_a_refused_one_is_used():
    solver, jobs = Prepared(), JobsInTurn(print)
    camera_solver = CameraSolver(lambda camera: solver, lambda: None, jobs, print, "camera/camera_info")
    camera_solver.receive(info(), at_once=True)
    with pytest.raises(InstrumentError):
        camera_solver.receive(info(k=BROKEN), at_once=True)
    # the first one's tables are ready only now
    jobs.work()
    assert camera_solver.solver is None
    camera_solver.receive(info(), at_once=True)
    jobs.work()
    assert camera_solver.solver is solver and not camera_solver.trouble


def test_a_refusal_in_recorded_data_counts_from_its_stamp_on():
    camera_solver, _ = taken(Prepared())
    later = SimpleNamespace(frame_id="camera", stamp=SimpleNamespace(sec=1793642500, nanosec=0))
    with pytest.raises(InstrumentError):
        camera_solver.receive(info(k=BROKEN, header=later), at_once=False)
    camera_solver.advance_to(1793642450.0)
    assert camera_solver.solver is not None
    camera_solver.advance_to(1793642501.0)
    assert camera_solver.solver is None and "not calibrated" in camera_solver.trouble

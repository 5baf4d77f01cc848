# SPDX-License-Identifier: Apache-2.0
"""The Solver of the camera in use: what its catalogue lacks is said once it is prepared."""

from starpos.errors import InstrumentError
from starpos.instrument.camera import Camera
from starpos.session.camera_solver import CameraSolver
from starpos.session.job import JobsInTurn

CAMERA = Camera.from_focal(1000, 700, 80_000.0)


class Prepared:
    """A solver whose tables are made at once."""

    def __init__(self, thin=""):
        self.thin = thin

    def prepare(self, width, height):
        if self.thin is None:
            raise InstrumentError("no such field")
        return self.thin

    def triangles_of(self, width, height, part):
        """Nothing is looked up."""


def taken(solver):
    """The CameraSolver that has taken a camera, and what it has said."""
    said, jobs = [], JobsInTurn(print)
    camera_solver = CameraSolver(lambda camera: solver, lambda: None, jobs, said.append, "camera/camera_info")
    camera_solver.take(CAMERA, None, at_once=True)
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

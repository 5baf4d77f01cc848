# SPDX-License-Identifier: Apache-2.0
"""The solution of a frame with what GNSS has taught before it, and the guard's verdict on the GNSS place at it."""

from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, meridian_turn
from starpos.earth.place import Place
from starpos.earth.vertical import Deflection, Geodetic, Vertical
from starpos.fix.budget import level_rows, local_north
from starpos.fix.fix import Fix
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.fix.terms import ALWAYS, ErrorTerm, total_covariance
from starpos.frames.frame import Stars
from starpos.gnss.filter import LEARNED_ORIGINS, zenith_rows
from starpos.gnss.states import Learned
from starpos.gnss.watch import GnssCheck, GnssStatus, GnssWatch
from starpos.instrument.instrument import Calibration
from starpos.units import ARCSEC

# name of the term of all that was learned
LEARNED_TERM = "learned"
NOTHING_LEARNED = (
    "too little is known of A3: let GNSS teach it, newly turned and leaning by some degrees, or give A3"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Watched:
    """A frame's answer.

    solution: with a place, or with a heading at GNSS's place where too little is known for one.
    ground: the geodetic place, None without a fix.  compared: None without a GNSS place.
    learned: what is known after the frame; None where nothing is.
    """

    solution: Solution
    ground: Geodetic | None = None
    compared: GnssCheck | None = None
    learned: Learned | None = None


def watched(solver: Solver, stars: Stars, rough: Solution, gnss: Place | None, watch: GnssWatch) -> Watched:
    """Solve a frame that is later than all before, and let the watch judge and learn.

    rough: its solution by the solver, whose A3 may be wrong, and its heading at GNSS's place.
    gnss: that place, None without one.
    """
    if rough.fix is None:
        status = GnssStatus.DISAGREES if watch.disagrees else GnssStatus.LEARNING
        compared = None if gnss is None else GnssCheck(status=status, place=gnss)
        return Watched(solution=rough, compared=compared)
    watch.advance(rough.fix)
    up = _up(watch, rough.fix, gnss)
    levelled, check = _levelled(solver, stars, rough, up), None
    if gnss is not None and levelled.fix is not None:
        check = watch.judge(levelled.fix, gnss)
        # what was taken back changes the level, and so does an attitude with another refraction where GNSS gives it
        again = _up(watch, levelled.fix, gnss)
        if again is not None and (up is None or not np.array_equal(again, up)):
            levelled = _levelled(solver, stars, levelled, again)
    fix = levelled.fix
    if fix is None:
        return Watched(solution=levelled)
    if watch.learned is not None and watch.tells_place(fix):
        budgeted = _budgeted(fix, watch.learned)
        ground = _ground(budgeted, watch.learned, watch.vertical)
        answer = Watched(solution=replace(levelled, fix=budgeted), ground=ground)
    else:
        why = f"{stars.place}: {NOTHING_LEARNED}"
        none = replace(levelled, status=Status.POOR_FIT, message=why, fix=None, at_place=rough.at_place)
        answer = Watched(solution=none)
    if gnss is None or check is None:
        return replace(answer, learned=watch.learned)
    watch.learn(fix, gnss, check)
    frames, poses = (0, 0) if watch.learned is None else (watch.learned.frames, watch.learned.poses)
    return replace(answer, compared=replace(check, frames=frames, poses=poses), learned=watch.learned)


def _up(watch: GnssWatch, fix: Fix, gnss: Place | None) -> np.ndarray | None:
    """Up (3,) in C: as learned if that gives a place, else by GNSS; None without either."""
    if watch.tells_place(fix):
        return watch.up_in_camera(fix.tilt)
    if gnss is None:
        return None
    stated, axes = watch.vertical.at(gnss.latitude, gnss.longitude), gnss.axes
    lean = ARCSEC * (stated.eta_arcsec * axes[0] + stated.xi_arcsec * axes[1])
    return fix.camera.rotation.T @ rotation.normalised(axes[2] + lean)


def _levelled(solver: Solver, stars: Stars, answer: Solution, up_in_camera: np.ndarray | None) -> Solution:
    """The solution of a frame whose level is given, so that its refraction is right."""
    assert answer.fix is not None and answer.tilt is not None
    if up_in_camera is None:
        return answer
    used = solver.instrument.calibration.a3
    a3 = rotation.shortest_turn(used @ up_in_camera, answer.tilt.up) @ used
    instrument = replace(solver.instrument, calibration=Calibration().turned_to(a3))
    return replace(solver, instrument=instrument).solve(stars, answer.tilt, known=answer.found)


def _zenith_moved(fix: Fix) -> np.ndarray:
    """Change (6, 2) of the rows of an ErrorTerm for a zenith of the level that lies 1 rad further east, or north."""
    # with east, north, up for L
    level = level_rows(local_north(enu_axes(fix.latitude, fix.longitude)), fix.link_to_enu)
    return np.stack([-level[:, 1], level[:, 0]], 1)


def _zenith_rows(fix: Fix, learned: Learned) -> np.ndarray:
    """Derivatives (2, n) of the zenith, to the east and the north of a fix, by the states."""
    return enu_axes(fix.latitude, fix.longitude)[:2] @ zenith_rows(fix, learned, learned.up(fix.tilt))


def _budgeted(fix: Fix, learned: Learned) -> Fix:
    """The fix with the error of the learned states in place of the errors of A3 and the inclinometer."""
    rows = _zenith_rows(fix, learned)
    root = symmetric_root(rows @ learned.covariance @ rows.T)
    term = ErrorTerm(LEARNED_TERM, _zenith_moved(fix) @ root, shared=ALWAYS)
    kept = (t for t in fix.terms if t.origin not in LEARNED_ORIGINS)
    return replace(fix, terms=(*kept, term))


def _ground(fix: Fix, learned: Learned, vertical: Vertical) -> Geodetic:
    """The geodetic place, whose error knows that A3 and the deflection were learned together."""
    at, covariance = learned.layout, learned.covariance
    deflection = learned.deflection_rad(vertical, fix.latitude, fix.longitude) / ARCSEC
    applied = Deflection(
        xi_arcsec=float(deflection[1]),
        eta_arcsec=float(deflection[0]),
        stddev_arcsec=learned.deflection_stddev_rad / ARCSEC,
    )
    ground = fix.on_ground(applied)
    prime, meridian = curvature_radii_m(ground.latitude)
    moved = -np.array([[prime, 0.0], [0.0, meridian], [meridian_turn(ground.latitude), 0.0]])
    rows = _zenith_moved(fix)[:3] @ _zenith_rows(fix, learned)
    rows[:, at.constant] += moved
    rows[:, at.field] += moved
    others = total_covariance([t for t in fix.terms if t.name != LEARNED_TERM])[:3, :3]
    return replace(ground, covariance=others + rows @ covariance @ rows.T)

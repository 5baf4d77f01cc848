# SPDX-License-Identifier: Apache-2.0
"""A zenith camera's session at a mark, from its frames and tilts: the deflection of the vertical."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FrameError, StarposError
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver, check_explained
from starpos.frames.frame import Frame, Stars
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.night.opening import work_of
from starpos.night.reading import Instruments, Reader
from starpos.night.work import Solving
from starpos.parallel.processes import in_turn
from starpos.sky import catalogue
from starpos.zenith.adjustment import DeflectionSession
from starpos.zenith.doubts import checked_session
from starpos.zenith.sighting import ZenithSighting, sighting


def zenith_seen(given: Solving, mark: Place, item: Frame | Stars) -> ZenithSighting | Solution:
    """The sighting of a frame at a mark, identified by every way there is, with the instruments, tilts and air given.

    A frame's fault is a Solution that gives the reason.
    """
    sight = Solving(given.instruments)(item)
    instrument = sight.instrument or given.instruments.of(item)
    if sight.found is None or instrument is None:
        return sight.solution
    assert given.tilts is not None
    solver = Solver(instrument, catalogue.load_catalogue(), given.atmosphere)
    try:
        check_explained(sight.solution)
        return sighting(solver, sight.stars, sight.found, mark, given.tilts)
    except StarposError as error:
        return Solution.refused(sight.stars, error)


def deflection(
    frames: Sequence[str | Path],
    tilt: str | Path,
    site: tuple[float, float, float],
    instrument: Instrument | str | Path,
    *,
    atmosphere: Atmosphere | None = None,
) -> DeflectionSession:
    """The deflection of the vertical at a mark, from a zenith camera's frames and a tiltmeter's readings.

    Parameters
    ----------
    frames : paths of frames or of lists of stars
    tilt : path of the tiltmeter's CSV
    site : latitude, longitude (deg) and height (m) of the mark on WGS 84
    instrument : an Instrument, or the path of its file (YAML)
    atmosphere : of refraction; None: not measured

    Returns
    -------
    DeflectionSession
        with xi_arcsec, eta_arcsec and covariance_arcsec2 (2, 2)

    Raises
    ------
    FixError
        the sightings do not bear a deflection

    Examples
    --------
    >>> lists = sorted(Path("zenith").glob("stars_*.csv"))
    >>> session = starpos.deflection(lists, "zenith/tilt.csv", (61.2, 24.5, 900.0), "zenith/instrument.yaml")
    >>> round(session.xi_arcsec), round(session.eta_arcsec)
    (30, -12)
    """
    known = instrument_file.read(instrument) if isinstance(instrument, (str, Path)) else instrument
    air = Atmosphere.measured(None, None) if atmosphere is None else atmosphere
    read, paths = Reader(), tuple(map(str, frames))
    first = read.first(paths)
    if first is None:
        raise FrameError(f"none of the {len(paths)} frames can be read: give frames or lists of stars")
    given, _ = work_of(Instruments(known), first, Path(tilt), air)
    assert given.instruments.instrument is not None
    mark = Place.on_ellipsoid(site[0], site[1], height_m=site[2])
    work = partial(read.on, partial(zenith_seen, given, mark))
    answers = in_turn((work, path) for path in paths)
    sightings = [answer for answer in answers if isinstance(answer, ZenithSighting)]
    return checked_session(sightings, given.instruments.instrument, air, mark)

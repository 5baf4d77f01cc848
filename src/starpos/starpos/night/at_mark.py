# SPDX-License-Identifier: Apache-2.0
"""A zenith camera's session at a mark, from its frames and tilts: the deflection of the vertical."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FrameError, StarposError, named
from starpos.fix.checks import unnamed_inclinometer
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver, check_explained
from starpos.frames.frame import Frame, Stars
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.night.opening import work_of
from starpos.night.reading import Each, Instruments, Reader
from starpos.night.work import Solving
from starpos.progress import Say, quiet
from starpos.sky import catalogue
from starpos.zenith.adjustment import DeflectionSession
from starpos.zenith.doubts import checked_session, remarks
from starpos.zenith.sighting import ZenithSighting, sighting

# names of frames, and their sightings or what is wrong with them
Sightings = list[tuple[str, ZenithSighting | Solution | FrameError]]


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


def why_none(name: str, answer: Solution | FrameError) -> str:
    """A sentence on a frame that has no sighting."""
    return named(name, answer if isinstance(answer, FrameError) else answer.message)


def session_of(
    each: Each, given: Solving, mark: Place, say: Say = quiet
) -> tuple[DeflectionSession, Sightings]:
    """The session of the frames through which `each` goes, by the instruments, tilts and air given.

    say: takes what looks wrong.  FixError if the sightings do not bear a deflection.
    """
    instrument = given.instruments.instrument
    assert instrument is not None
    rows: Sightings = list(each(partial(zenith_seen, given, mark)))
    say(unnamed_inclinometer(instrument))
    say(*(why_none(name, answer) for name, answer in rows if not isinstance(answer, ZenithSighting)))
    sightings = [answer for _, answer in rows if isinstance(answer, ZenithSighting)]
    session = checked_session(sightings, instrument, given.atmosphere, mark)
    say(*remarks(session, len(rows), instrument.inclinometer.scale))
    return session, rows


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
    read, paths, air = Reader(), tuple(map(str, frames)), atmosphere or Atmosphere.measured(None, None)
    given, _ = work_of(Instruments(known), read.one_of(paths), Path(tilt), air)
    mark = Place.on_ellipsoid(site[0], site[1], height_m=site[2])
    session, _ = session_of(read.each(paths), given, mark)
    return session

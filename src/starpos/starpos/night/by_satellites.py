# SPDX-License-Identifier: Apache-2.0
"""A place from satellites among the stars of frames, or in tables: trails, orbits, what is known before, headings."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, SatelliteError, StarposError
from starpos.files import read_regular
from starpos.fix.blind import SEARCH_S
from starpos.fix.searching import Sight
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame, Stars
from starpos.gnss.receiver import gnss_place, read_gnss_csv
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.night.reading import Each, Instruments, Reader
from starpos.night.work import Solving
from starpos.progress import Say, quiet
from starpos.satellites import locating
from starpos.satellites.adjustment import KnownBefore
from starpos.satellites.elements import Orbit, chosen, read_orbits
from starpos.satellites.frames import trails_of
from starpos.satellites.locating import SatelliteFix
from starpos.satellites.sightings import read_iod, read_sightings
from starpos.satellites.trails import SatelliteTrail
from starpos.sky import catalogue
from starpos.units import utc_text

# of a height that is stated without an error, and of times
HEIGHT_STDDEV_M, CLOCK_STDDEV_S = 50.0, 0.05
# other files are frames
TABLES = ".csv", ".iod", ".txt"
MOST_JSON_BYTES = 300_000_000


def trails_seen(solving: Solving, item: Frame | Stars) -> tuple[Sight, list[SatelliteTrail], str] | Solution:
    """A frame that is identified by every way there is, its satellites' trails, and a sentence on those left out.

    A frame's fault is a Solution that gives the reason; FrameError for a list of stars.
    """
    if isinstance(item, Stars):
        raise FrameError(f"{item.place}: a list of stars shows no trails: give the frame")
    sight = solving(item)
    known = sight.instrument or solving.instruments.of(item)
    stars = sight.stars if known is None else replace(sight.stars, shutter=known.shutter or item.shutter)
    try:
        found, left_out = trails_of(item, stars, sight.solution, catalogue.load_catalogue())
        return replace(sight, stars=stars, instrument=known), found, left_out
    except StarposError as error:
        return Solution.refused(stars, error)


def sighted(
    paths: Sequence[str],
    look: Callable[[list[str]], tuple[Solving, Each]],
    say: Say = quiet,
    complain: Say = quiet,
) -> tuple[list[SatelliteTrail], dict[str, Sight | None]]:
    """The trails of tables and of frames, numbered on; and the frames' sights by name, None of one that was refused.

    look: gives the work that identifies frames, and what goes through them.  complain: of a frame by its name.
    """
    frames = [path for path in paths if Path(path).suffix.lower() not in TABLES]
    trails = [trail for path in paths if path not in frames for trail in _read(path, say)]
    number = 1 + max((trail.track for trail in trails), default=-1)
    sights: dict[str, Sight | None] = dict.fromkeys(frames)
    if not frames:
        return trails, sights
    work, each = look(frames)
    for path, answer in each(partial(trails_seen, work)):
        if isinstance(answer, FrameError):
            complain(path, answer)
        elif isinstance(answer, Solution):
            complain(path, answer.message)
        else:
            sights[path], found, left_out = answer
            if left_out:
                complain(path, left_out)
            trails += [replace(t, track=number + k, file=path) for k, t in enumerate(found)]
            number += len(found)
    return trails, sights


def _read(path: str, say: Say) -> list[SatelliteTrail]:
    if Path(path).suffix.lower() == ".csv":
        return read_sightings(path)
    trails, about = read_iod(path)
    say(*about)
    return trails


def orbits_at(
    utc_unix_s: float, paths: Sequence[str | Path], newer: bool = False, say: Say = quiet
) -> list[Orbit]:
    """Orbits of files to be used from a time on, one a satellite; newer: also of later epochs."""
    orbits = []
    for path in paths:
        found, about = read_orbits(path)
        orbits += found
        say(*about)
    usable, about = chosen(orbits, utc_unix_s, newer=newer)
    say(*about)
    return usable


def _joined(path: str | Path, utc_unix_s: float, say: Say) -> Place:
    """The place of what `starpos solve --json` printed, or of GNSS."""
    if Path(path).suffix.lower() == ".csv":
        track, faults = read_gnss_csv(path)
        say(*faults)
        if (place := track.at(utc_unix_s)) is None:
            raise SatelliteError(f"{path}: no GNSS place at {utc_text(utc_unix_s)}, of the first trail")
        return place
    try:
        text = read_regular(path, MOST_JSON_BYTES).decode()
        rows = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
        row = next(
            row for row in reversed(rows) if row.get("combined") and row.get("latitude_geodetic") is not None
        )
        covariance = np.array(row["covariance_geodetic"], float)[:2, :2]
        latitude, longitude = float(row["latitude_geodetic"]), float(row["longitude_geodetic"])
    except (OSError, ValueError, KeyError, StopIteration, TypeError, IndexError):
        raise SatelliteError(
            f"{path}: no place in it: give what `starpos solve --json` printed, or a receiver's CSV as solve --gnss"
        ) from None
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        raise SatelliteError(f"{path}: the covariance of its place is impossible")
    return Place.on_ellipsoid(latitude, longitude, covariance=covariance)


def located(
    trails: Sequence[SatelliteTrail],
    sights: Mapping[str, Sight | None],
    elements: Sequence[str | Path],
    *,
    height_m: float | None = None,
    height_stddev_m: float | None = None,
    clock_stddev_s: float = CLOCK_STDDEV_S,
    near: Place | str | Path | None = None,
    newer_elements: bool = False,
    say: Say = quiet,
) -> SatelliteFix | str:
    """The place by trails, and the frames' headings there, or why it is missing; the rest as of `locate`."""
    if not trails:
        return f"none of {len(sights)} frames shows an end of a trail: give more frames"
    begin = float(min(t.utc_unix_s.min() for t in trails))
    orbits = orbits_at(begin, elements, newer_elements, say)
    height = math.nan if height_m is None else height_m
    prior = KnownBefore.at_height(height, HEIGHT_STDDEV_M, clock_stddev_s)
    if height_stddev_m is not None:
        prior = prior._replace(height_stddev_m=height_stddev_m)
    place = _joined(near, begin, say) if isinstance(near, (str, Path)) else near
    try:
        fix = locating.locate(trails, orbits, prior._replace(near=place))
    except SatelliteError as error:
        return str(error)
    return replace(fix, headings=tuple(_headings(sights, fix, say)))


def _headings(
    sights: Mapping[str, Sight | None], fix: SatelliteFix, say: Say
) -> Iterator[tuple[str, float, float]]:
    """Where frames' cameras look from that place, as `SatelliteFix.headings`."""
    for name, sight in sights.items():
        if sight is None or sight.instrument is None or sight.found is None or sight.stars.mid_unix_s is None:
            continue
        place = gnss_place(sight.stars.mid_unix_s, fix.latitude, fix.longitude, fix.covariance[:2, :2])
        solver = Solver(sight.instrument, catalogue.load_catalogue(), Atmosphere.measured(None, None))
        try:
            link = solver.attitude_at(sight.stars, sight.found, place.deflected(Deflection())).ellipsoid
        except StarposError as e:
            say(f"{name}: no heading: {e}")
            continue
        yield name, link.heading, float(np.sqrt(link.angles_covariance[0, 0]))


def locate(
    sightings: Sequence[str | Path],
    elements: Sequence[str | Path],
    *,
    instrument: Instrument | str | Path | None = None,
    **stated: Any,
) -> SatelliteFix:
    """The place from which satellites were seen among the stars, without a level.

    Parameters
    ----------
    sightings : paths of frames with trails, of tables of sightings (CSV), of reports in the IOD format (.iod, .txt)
    elements : paths of orbits: TLE, 3LE, OMM, OEM or SP3, or folders of them
    instrument : of the frames, or the path of its file (YAML); None: the focal length is sought
    **stated : what else is known: height_m above the ellipsoid and height_stddev_m (50), clock_stddev_s of the times
        (0.05); near, a Place with its covariance, or the path of what `starpos solve --json` printed or of a receiver's
        CSV; newer_elements=True to use elements whose epoch is after the sightings

    Returns
    -------
    SatelliteFix
        latitude, longitude in rad on WGS 84, height_m, their covariance (3, 3) in m2, `named` satellites, `headings`

    Raises
    ------
    SatelliteError
        a table or the elements cannot be used, or the trails do not give a place

    Examples
    --------
    >>> fix = starpos.locate(["sightings.csv"], ["active.tle"], height_m=900)
    >>> fix.text
    'place 47.00... 8.00... (WGS 84), ... m; +- ... m east, ... satellites, chi-square ... of ...'
    """
    known = instrument_file.read(instrument) if isinstance(instrument, (str, Path)) else instrument
    identify, read = Solving(Instruments(known, by_header=known is None), search_s=SEARCH_S), Reader()
    trails, sights = sighted([*map(str, sightings)], lambda frames: (identify, read.each(frames)))
    fix = located(trails, sights, elements, **stated)
    if isinstance(fix, str):
        raise SatelliteError(fix)
    return fix

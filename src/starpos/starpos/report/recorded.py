# SPDX-License-Identifier: Apache-2.0
"""Makes a Night of a bag: solved again if the bag has stars and tilts, else with the recorded solutions."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from starpos.errors import InstrumentError, TiltError
from starpos.fix.budget import ErrorTerm
from starpos.instrument.inclinometer import Tilt
from starpos.report.bag import Recorded, star_lists
from starpos.report.folder import StarList, StarLists
from starpos.report.measures import offset_m
from starpos.report.night import Night, ReportedPlace
from starpos.report.solutions import star_list_of
from starpos.report.working import Workshop, why_none, worked
from starpos.rotation import full_turn, half_turns


def night(recorded: Recorded, shop: Workshop) -> Night:
    """The night of a bag; raises StarposError if nothing in it can be used."""
    r = recorded
    if r.star_count and (r.tilts or not r.solutions):
        try:
            solved = worked(_exposures(r), shop)
            return replace(solved, remarks=(*r.remarks, *solved.remarks, *_against_recorded(solved, r)))
        except InstrumentError:
            if not r.solutions:
                raise
    return _as_recorded(r, shop)


def _exposures(r: Recorded) -> StarLists:
    def read_stars() -> Iterator[StarList]:
        return map(star_list_of, star_lists(r))

    def no_tilt(mid_unix_s: float, exposure_s: float, spread_s: float) -> Tilt:
        raise TiltError(f"{r.path}: no usable tilt in it: record the topic tilt too")

    tilt: Callable[[float, float, float], Tilt] = r.tilts.average if r.tilts else no_tilt
    origin = f"solved from stars and tilt of the bag {r.path.name}, namespace {r.namespace}"
    return StarLists(
        name=r.name, origin=origin, count=r.star_count, read=read_stars, tilt=tilt, truth=r.truth
    )


def _against_recorded(solved: Night, r: Recorded) -> tuple[str, ...]:
    """A remark if the recorded solutions differ from the new ones."""
    if solved.combined is None or not any(s.place for s in r.solutions):
        return ()
    said = _bound([s.place for s in r.solutions if s.place])
    apart = np.hypot(*offset_m(said, solved.combined.latitude, solved.combined.longitude))
    if apart < np.hypot(*solved.combined.sigma[:2]):
        return ()
    return (
        f"the solver's own solutions in the bag lie {apart:.0f} m from these: it had another A3, calibration or air than "
        "these options give",
    )


def _as_recorded(r: Recorded, shop: Workshop) -> Night:
    places = [s.place for s in r.solutions if s.place]
    remark = (
        "the error of the mean is that of one frame, an upper bound: a recorded solution does not tell how its errors go "
        "with those of others"
    )
    return Night(
        name=r.name,
        origin=f"as the solver recorded it in the bag {r.path.name}, namespace {r.namespace}",
        shots=r.solutions,
        combined=_bound(places) if places else None,
        why_not="" if places else why_none(r.solutions),
        vertical=r.deflection or shop.vertical,
        atmosphere=shop.atmosphere,
        truth=r.truth,
        remarks=(*r.remarks, remark) if len(places) > 1 else r.remarks,
    )


def _bound(places: list[ReportedPlace]) -> ReportedPlace:
    """The plain mean of places, with the mean of their covariances: an upper bound, whatever their correlation is."""
    seen = np.array([[p.latitude, p.longitude, p.heading] for p in places])
    away = half_turns(seen - seen[0])
    mean = seen[0] + away.mean(0)
    still = np.ptp(away[:, 2]) < 10 * np.median([p.sigma[2] for p in places]) or len(places) == 1
    names = [t.name for t in places[0].terms]
    terms = [
        ErrorTerm(t.name, np.sqrt(np.mean([p.terms[k].factor ** 2 for p in places], axis=0)), shared=t.shared)
        for k, t in enumerate(places[0].terms)
        if all([u.name for u in p.terms] == names for p in places)
    ]
    return ReportedPlace(
        utc_unix_s=float(np.mean([p.utc_unix_s for p in places])),
        latitude=float(mean[0]),
        longitude=float(half_turns(mean[1])),
        heading=full_turn(mean[2]) if still else float("nan"),
        covariance=np.mean([p.covariance for p in places], axis=0),
        terms=tuple(terms),
    )

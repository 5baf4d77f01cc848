# SPDX-License-Identifier: Apache-2.0
"""Makes a Night of a bag: solved again if the bag has stars and tilts, else with the recorded solutions."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Vertical
from starpos.errors import InstrumentError
from starpos.fix.budget import ErrorTerm
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilts import NoTilts, Tilts
from starpos.night.bag import Recorded, each_frame
from starpos.night.night import Night, ReportedPlace, offset_m, why_none
from starpos.night.reading import Instruments
from starpos.night.remarks import Kind, Remark
from starpos.night.solving import Exposures, solved_night
from starpos.night.work import Solving
from starpos.progress import Progress, quiet
from starpos.rotation import full_turn, half_turns


@dataclass(frozen=True)
class OfBag:
    """The instrument of a bag's frames, with the bag's camera for their size.

    any_size: whether frames of other sizes use the instrument unchanged.
    """

    instrument: Instrument
    cameras: Mapping[tuple[int, int], Camera]
    any_size: bool

    @property
    def hinted(self) -> bool:
        """Whether only headers give the focal length: a bag has none."""
        return False

    def of(self, frame: Frame | Stars) -> Instrument | None:
        """The instrument of a frame."""
        camera = self.cameras.get((frame.width, frame.height))
        if camera is None:
            return self.instrument if self.any_size else None
        return replace(self.instrument, camera=camera, focal_px=camera.fx)


def night(
    recorded: Recorded,
    instruments: Instruments,
    atmosphere: Atmosphere,
    vertical: Vertical,
    turn_stddev_deg: float | None = None,
    progress: Progress = quiet,
) -> Night:
    """The night of a bag, by options as `solved_night` has them; raises StarposError if nothing in it can be used."""
    r = recorded
    if r.star_count and (r.tilts or not r.solutions):
        try:
            solved = solved_night(exposures(r, instruments, atmosphere, vertical), turn_stddev_deg, progress)
            return replace(solved, remarks=(*solved.remarks, *_against_recorded(solved, r)))
        except InstrumentError:
            if not r.solutions:
                raise
    return _as_recorded(r, atmosphere, vertical)


def exposures(r: Recorded, instruments: Instruments, atmosphere: Atmosphere, vertical: Vertical) -> Exposures:
    """The stars of a bag, to be solved."""
    tilts: Tilts = r.tilts or NoTilts(f"{r.path}: no usable tilt in it: record the topic tilt too")
    return Exposures(
        name=r.name,
        origin=f"solved from stars and tilt of the bag {r.path.name}, namespace {r.namespace}",
        count=r.star_count,
        each=lambda: each_frame(r),
        work=Solving(instruments, atmosphere, tilts),
        vertical=vertical,
        truth=r.truth,
        remarks=r.remarks,
    )


def _against_recorded(solved: Night, r: Recorded) -> tuple[Remark, ...]:
    """A remark if the recorded solutions differ from the new ones."""
    if solved.combined is None or not any(s.place for s in r.solutions):
        return ()
    said = _bound([s.place for s in r.solutions if s.place])
    apart = np.hypot(*offset_m(said, solved.combined.latitude, solved.combined.longitude))
    if apart < np.hypot(*solved.combined.sigma[:2]):
        return ()
    sentence = (
        f"the solver's own solutions in the bag lie {apart:.0f} m from these: it had another A3, calibration or air than "
        "these options give"
    )
    return (Remark(Kind.RECORDED, sentence),)


def _as_recorded(r: Recorded, atmosphere: Atmosphere, vertical: Vertical) -> Night:
    places = [s.place for s in r.solutions if s.place]
    bound = Remark(
        Kind.RECORDED,
        "the error stated for the mean is the error of one frame, an upper bound: recorded solutions do not "
        "state how their errors correlate",
    )
    return Night(
        name=r.name,
        origin=f"as the solver recorded it in the bag {r.path.name}, namespace {r.namespace}",
        shots=r.solutions,
        combined=_bound(places) if places else None,
        why_not="" if places else why_none(r.solutions),
        vertical=r.deflection or vertical,
        atmosphere=atmosphere,
        truth=r.truth,
        remarks=(*r.remarks, bound) if len(places) > 1 else r.remarks,
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

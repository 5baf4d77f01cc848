# SPDX-License-Identifier: Apache-2.0
"""A night in a rosbag2: one instrument's messages, solved again if there are stars and tilts, else as recorded."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection, Vertical, geodetic
from starpos.errors import FrameError, InstrumentError, StarposError, TiltError
from starpos.fix.fix import PlaceFix
from starpos.fix.solution import FieldPointing, Status
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.frames.frame import Frame, Stars
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import TiltLog, Tilts, TiltsByTime
from starpos.messages.camera import message_to_camera
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.stars import message_to_stars
from starpos.messages.tilt import UNUSABLE, message_to_tilt
from starpos.night.night import NO_TILT, Night, Shot, Truth, offset_m, why_none
from starpos.night.opening import truth_in
from starpos.night.reading import Instruments
from starpos.night.remarks import Kind, Remark
from starpos.night.solving import ONE_BY_ONE, Exposures, How, Worked, solved_night
from starpos.night.work import Solving
from starpos.progress import Progress, quiet
from starpos.recording.bag import BagReader
from starpos.recording.drivers import IMAGES, DriverMessages, Drivers, named_image
from starpos.recording.topics import (
    CAMERA_INFO,
    CAPTURE,
    IMU,
    INPUTS,
    SOLUTION,
    STARS,
    TILT,
    Chosen,
    instrument_in,
)
from starpos.rotation import full_turn, half_turns
from starpos.units import ARCSEC, utc_text

SUFFIXES = (".mcap", ".db3")
# of ROS 1, which is refused with a sentence
ROS1_SUFFIX = ".bag"
TOPICS = INPUTS | {"solver/solution": SOLUTION}
# types of messages that are a frame each
WITH_STARS = (STARS, *IMAGES)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """One instrument's part of a bag.

    drivers: how a robot's own messages are used.  cameras: by (width, height) of their frames in px.
    star_count: star lists, or images that stars are detected in.  solutions: as the solver published them.
    deflection: as the solver applied it, None if no solution states it.
    """

    path: Path
    namespace: str
    drivers: Drivers
    cameras: dict[tuple[int, int], Camera]
    tilts: TiltLog | None
    star_count: int
    solutions: tuple[Shot, ...]
    deflection: Deflection | None
    truth: Truth | None
    remarks: tuple[Remark, ...]

    @property
    def name(self) -> str:
        """Name for headings: the bag's own, and the namespace if there is one."""
        return self.path.name + (f" {self.namespace}" if self.namespace != "/" else "")


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a folder with metadata.yaml or a bag's files, or a file with a bag's suffix."""
    if path.is_file():
        return path.suffix.lower() in (*SUFFIXES, ROS1_SUFFIX)
    return (path / "metadata.yaml").is_file() or any(next(path.glob(f"*{s}"), None) for s in SUFFIXES)


def read(
    path: Path, namespace: str | None, tilt_noise_rad: float, drivers: Drivers, progress: Progress
) -> Recorded:
    """Read everything of one instrument, or of a robot's own drivers, except the stars.

    namespace: the instrument's; None where there is only one.  tilt_noise_rad: sigma of readings that state none.
    Raises BagError if the bag cannot be read, FrameError if the instrument is not in it.
    """
    with BagReader(path, typed=True) as bag:
        chosen = _instrument(bag, path, namespace, drivers)
        reading = _Reading(tilt_noise_rad, DriverMessages(drivers))
        wanted = [c for c in chosen.connections if c.msgtype not in WITH_STARS]
        total = sum(c.msgcount for c in wanted) or 1
        for done, (connection, log_ns, message) in enumerate(bag.decoded(wanted), 1):
            reading.read_message(connection.msgtype, message, log_ns * 1e-9)
            if done % 500 == 0 or done == total:
                progress(path.name[:20], done / total)
        return Recorded(
            path=path,
            namespace=chosen.namespace,
            drivers=drivers,
            cameras=reading.cameras,
            tilts=reading.tilt_log(),
            star_count=sum(c.msgcount for c in chosen.connections if c.msgtype in WITH_STARS),
            solutions=tuple(reading.solutions),
            deflection=reading.deflection,
            truth=truth_in(path) if path.is_dir() else None,
            remarks=reading.remarks(path, chosen.made),
        )


def each_frame(r: Recorded) -> Iterator[tuple[str, Stars | FrameError]]:
    """A name for each frame, one at a time, and its stars, or why it has none."""
    messages = DriverMessages(r.drivers)
    with BagReader(r.path, typed=True) as bag:
        chosen = _instrument(bag, r.path, r.namespace, r.drivers)
        wanted = [c for c in chosen.connections if c.msgtype in (*WITH_STARS, CAPTURE)]
        for connection, _, message in bag.decoded(wanted):
            if connection.msgtype == STARS:
                yield named_stars(message)
            elif connection.msgtype == CAPTURE:
                messages.receive_capture(message)
            else:
                yield named_image(connection.msgtype, message, messages)


def _instrument(bag: BagReader, path: Path, namespace: str | None, drivers: Drivers) -> Chosen:
    """The instrument, or a robot's own drivers; raises FrameError if it is not there or one of several."""
    return instrument_in(bag, path, namespace, TOPICS, (STARS, SOLUTION), drivers.remaps)


class _Reading:
    """Collects the messages of one instrument."""

    def __init__(self, tilt_noise_rad: float, messages: DriverMessages):
        self.cameras: dict[tuple[int, int], Camera] = {}
        self.solutions: list[Shot] = []
        self.deflection: Deflection | None = None
        self._unknown_stddev_rad, self._messages = tilt_noise_rad, messages
        self._tilts: list[Tilt] = []
        self._unusable = 0
        self._why_no_camera = ""

    def read_message(self, kind: str, message: Any, log_s: float) -> None:
        """Read a message of a type; an impossible tilt or camera only leads to a remark."""
        if kind == IMU:
            kind, message = TILT, self._messages.tilt_of(message, log_s)
            if message is None:
                return
        if kind == TILT:
            tilt: Tilt | None
            try:
                tilt = message_to_tilt(message, self._unknown_stddev_rad)
            except TiltError:
                tilt = None
            if tilt is None or message.flags & UNUSABLE:
                self._unusable += 1
            else:
                self._tilts.append(tilt)
        elif kind == SOLUTION:
            self.solutions.append(shot_of(message, self.cameras))
            if self.deflection is None and message.status == 0:
                self.deflection = deflection_of(message)
        elif kind == CAMERA_INFO:
            try:
                camera = message_to_camera(message, "its camera_info")
                self.cameras.setdefault((camera.width, camera.height), camera)
            except InstrumentError as error:
                self._why_no_camera = str(error)

    def tilt_log(self) -> TiltLog | None:
        """The usable tilts; None without any."""
        in_time = sorted(self._tilts, key=lambda tilt: tilt.utc_unix_s)
        return TiltLog.of_readings(in_time) if in_time else None

    def remarks(self, path: Path, made: str) -> tuple[Remark, ...]:
        """Remarks on left-out messages, and on how a robot's own messages were used."""
        said = [Remark(Kind.RECORDED, f"{path.name}: {made}")] if made else []
        said += [Remark(Kind.TILTS, sentence) for sentence in self._messages.remarks()]
        if self._unusable:
            sentence = f"{self._unusable} tilts of the bag were left out: flagged, out of range or broken"
            said.append(Remark(Kind.TILTS, sentence))
        if self._why_no_camera and not self.cameras:
            said.append(Remark(Kind.RECORDED, f"{path.name}: {self._why_no_camera}"))
        return tuple(said)


@at_once
@dataclass(frozen=True, kw_only=True)
class RecordedPlace(PlaceFix):
    """A place as messages have it; stated (3, 3): their covariance, of which their terms hold only the variances."""

    stated: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) of east m, north m, heading rad."""
        return self.stated


# by the number in Solution.status
STATUS = (Status.OK, Status.TOO_FEW_STARS, Status.NOT_IDENTIFIED, Status.NO_TILT, Status.TILT_OUT_OF_RANGE,
          Status.TIME_OUTSIDE_TABLES, Status.BAD_INPUT, Status.POOR_FIT)  # fmt: skip


def named_stars(m: Any) -> tuple[str, Stars | FrameError]:
    """A name for a StarArray, and its stars, or the error."""
    name = _name("stars", stamp_to_unix(m.header.stamp))
    try:
        return name, message_to_stars(m, name)
    except FrameError as error:
        return name, error


def _name(what: str, utc_unix_s: float | None) -> str:
    return f"{what} " + ("of unknown time" if utc_unix_s is None else utc_text(utc_unix_s))


def shot_of(m: Any, cameras: dict[tuple[int, int], Camera]) -> Shot:
    """The frame of a Solution message, whose geodetic heading becomes astronomic.  cameras: by size of frame."""
    status = STATUS[m.status] if m.status < len(STATUS) else Status.BAD_INPUT
    at = stamp_to_unix(m.header.stamp)
    utc = float("nan") if at is None else at
    place = pointing = None
    unit = np.array([1.0, 1.0, np.radians(1.0)])
    covariance = np.asarray(m.covariance, float).reshape(3, 3) * np.outer(unit, unit)
    angles = np.radians([m.latitude, m.longitude, m.heading])
    sane = np.isfinite(angles).all() and abs(m.latitude) <= 90 and np.abs([m.xi, m.eta]).max() < 3600
    sane &= bool(np.isfinite(covariance).all() and (np.diag(covariance) >= 0).all())
    if status is Status.OK and sane:
        applied = Deflection(m.xi, m.eta, 0.0)
        heading = angles[2] - geodetic(angles[0], angles[1], 0.0, covariance, applied).azimuth_turn
        terms = tuple(
            ErrorTerm(
                t.name,
                np.vstack([np.diag([t.east, t.north, np.radians(t.heading)]), np.zeros((3, 3))]),
                shared=ALWAYS if t.common else None,
            )
            for t in m.budget
            if t.name != "deflection" and np.isfinite([t.east, t.north, t.heading]).all()
        )
        place = RecordedPlace(
            utc_unix_s=utc,
            latitude=float(angles[0]),
            longitude=float(angles[1]),
            heading=full_turn(heading),
            stated=covariance,
            terms=terms,
        )
    elif status is Status.OK:
        status = Status.BAD_INPUT
    looking = np.radians([m.right_ascension, m.declination, m.roll])
    if np.isfinite([*looking, m.focal_px]).all() and m.focal_px > 0:
        ra, dec, roll = looking.tolist()
        pointing = FieldPointing(
            ra=ra,
            dec=dec,
            roll=roll,
            focal_px=m.focal_px,
            residual_arcsec=m.residual,
            log_odds=m.log_odds,
            mirrored=bool(m.mirrored),
        )
    return Shot(
        name=_name("solution", at),
        status=status,
        message=m.status_text,
        utc_unix_s=utc,
        place=place,
        pointing=pointing,
        size=next(iter(cameras)) if len(cameras) == 1 else None,
        stars_detected=int(m.stars_detected),
        stars_matched=int(m.stars_matched),
        residual_arcsec=_finite(m.residual),
        tilt=(_finite(m.tilt.x), _finite(m.tilt.y)) if m.tilt_samples else NO_TILT,
        identify_s=_finite(m.identify_seconds),
        fix_s=_finite(m.fix_seconds),
        # older bags do not have it
        warnings=tuple(getattr(m, "warnings", ())),
    )


def _finite(value: float) -> float:
    """The value, or NaN if it is impossible."""
    return float(value) if abs(value) < 1e9 else float("nan")


def deflection_of(m: Any) -> Deflection | None:
    """The deflection that the solver applied; its sigma follows from the excess of the geodetic covariance."""
    prime, meridian = curvature_radii_m(np.radians(m.latitude))
    # east and north together, because the axes turn close to a pole
    wider = sum(m.covariance_geodetic[k] - m.covariance[k] for k in (0, 4))
    try:
        return Deflection(m.xi, m.eta, float(np.sqrt(max(wider, 0.0)) / np.hypot(prime, meridian) / ARCSEC))
    except StarposError:
        return None


def night(
    recorded: Recorded,
    instruments: Instruments,
    atmosphere: Atmosphere,
    vertical: Vertical,
    how: How = ONE_BY_ONE,
    progress: Progress = quiet,
) -> Night:
    """The night of a bag, solved as `solved_night` does; raises StarposError if nothing in it can be used."""
    r = recorded
    if r.star_count and (r.tilts or not r.solutions):
        try:
            solved = solved_night(exposures(r, instruments, atmosphere, vertical), how, progress)
            return replace(solved, remarks=(*solved.remarks, *_against_recorded(solved, r)))
        except InstrumentError:
            if not r.solutions:
                raise
    return _as_recorded(r, atmosphere, vertical)


def exposures(r: Recorded, instruments: Instruments, atmosphere: Atmosphere, vertical: Vertical) -> Exposures:
    """The stars of a bag, to be solved."""
    tilts: Tilts = r.tilts or TiltsByTime(why=f"{r.path}: no usable tilt in it: record the topic tilt too")

    def each(work: Callable[[Frame | Stars], Any]) -> Worked:
        for name, item in each_frame(r):
            yield name, item if isinstance(item, FrameError) else work(item)

    return Exposures(
        name=r.name,
        origin=f"solved from stars and tilt of the bag {r.path.name}, namespace {r.namespace}",
        count=r.star_count,
        each=each,
        work=Solving(instruments, atmosphere=atmosphere, tilts=tilts),
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


def _bound(places: list[PlaceFix]) -> RecordedPlace:
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
    return RecordedPlace(
        utc_unix_s=float(np.mean([p.utc_unix_s for p in places])),
        latitude=float(mean[0]),
        longitude=float(half_turns(mean[1])),
        heading=full_turn(mean[2]) if still else float("nan"),
        stated=np.mean([p.covariance for p in places], axis=0),
        terms=tuple(terms),
    )

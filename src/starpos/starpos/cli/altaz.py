# SPDX-License-Identifier: Apache-2.0
"""`starpos altaz`: azimuth and altitude of pixels at a known place, pixels of directions, and the grid drawn."""

import argparse
import itertools
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from starpos import rotation
from starpos.cli import console, inputs, options, overwriting
from starpos.cli.commands import DATA
from starpos.earth.orientation import earth_state
from starpos.errors import FrameError, InstrumentError
from starpos.files import rows_of, save
from starpos.fix.directions import horizontal, towards
from starpos.frames.frame import Frame
from starpos.night import horizon
from starpos.tables import TableForm
from starpos.units import utc_text

POINTS = TableForm(what="table of pixels", error=FrameError, needed=("x", "y"))
# an identified star at this share of a point's distance from the axis, or more, shows the lens there
REACH = 0.95


def run(args: argparse.Namespace) -> int:
    for name, values in (("X Y", args.pixels), ("--back AZ ALT", args.back)):
        if len(values) % 2:
            raise InstrumentError(f"{name}: {len(values)} numbers are no pairs: give two for each point")
    overwriting.check(args, overlay=overwriting.picture)
    ground = None if args.horizon is None else horizon.read(args.horizon)
    args.frames, pixels = [args.frame], np.reshape(args.pixels, (-1, 2))
    if args.points is not None:
        table = POINTS.read(args.points)
        pixels = np.vstack([pixels, np.stack([table.columns["x"], table.columns["y"]], -1)])
    seen = next(inputs.seen_at(args, options.camera_place_of(args)), None)
    if seen is None:
        return console.NOTHING
    back = np.radians(np.reshape(args.back, (-1, 2)))
    backs = _pixels(seen, back)
    for (az, alt), xy in zip(np.degrees(back).tolist(), backs.tolist(), strict=True):
        if not np.isfinite(xy).all():
            console.complain(f"azimuth {az:g}, altitude {alt:g} deg is not on the frame")
    points = np.vstack([pixels, backs[np.isfinite(backs).all(1)]])
    _put(args, seen, points)
    if args.overlay is not None:
        _draw(args.overlay, seen, points, ground)
    return 0


def _pixels(seen: inputs.FrameAtPlace, directions: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of azimuths and altitudes (N, 2) in rad; NaN for those that are not on the frame."""
    xy = seen.camera.project(towards(*directions.T) @ seen.at_place.optics.rotation)
    with np.errstate(invalid="ignore"):
        on = ((xy > -0.5) & (xy < np.array([seen.camera.width, seen.camera.height]) - 0.5)).all(1)
    return np.where(np.asarray(on)[:, None], xy, np.nan)


def _shown(seen: inputs.FrameAtPlace, rays: np.ndarray) -> np.ndarray:
    """Whether identified stars lie as far off the axis as rays (N, 3) in C."""
    stars, found, used = seen.sight.stars, seen.sight.found, seen.at_place.used
    assert found is not None
    row = found.star[used]
    least = seen.camera.directions(stars.x[row], stars.y[row])[:, 2].min()
    return REACH * np.arccos(np.clip(rays[:, 2], -1, 1)) <= np.arccos(np.clip(least, -1, 1))


def _put(args: argparse.Namespace, seen: inputs.FrameAtPlace, points: np.ndarray) -> None:
    """Print the azimuth and altitude of pixels (N, 2)."""
    output, found = console.Output(args, "pixels"), seen.at_place
    rays = seen.camera.directions(*points.T)
    sigma = np.hypot(args.stddev_px, found.jitter_px) / seen.camera.fx
    at = horizontal(seen.at_place.optics, rays, sigma)
    airless = options.atmosphere_of(args).refraction().unbend(rays @ seen.at_place.optics.rotation.T)
    errors = np.degrees(np.sqrt(np.diagonal(at.covariance, axis1=1, axis2=2))) * 3600
    errors[~_shown(seen, rays)] = np.nan
    if np.isnan(errors).any():
        console.complain(
            f"{int(np.isnan(errors[:, 0]).sum())} points lie further out than any identified star, where the lens is not "
            "known: calibrate it with starpos calibrate --camera --site"
        )
    columns = (
        points[:, 0],
        points[:, 1],
        *np.degrees([at.azimuth, at.altitude, np.arcsin(airless[:, 2])]),
        *errors.T,
    )
    for row in np.transpose(columns).tolist():
        x, y, azimuth, altitude, without, across, up = row
        values = dict(zip(output.columns, (args.frame, utc_text(found.utc_unix_s), *row), strict=True))
        output.put(
            values,
            f"{x:.2f} {y:.2f}: {azimuth:.4f} {altitude:.4f} ({without:.4f}) "
            + ("+- unknown" if np.isnan(across) else f"+- {across:.0f} {up:.0f} arcsec"),
        )


# the grid: circles of altitude, azimuths, and the step along each, deg
ALTITUDES, AZIMUTHS, ALONG = (0, 15, 30, 45, 60, 75), range(0, 360, 30), 0.5
# a label's least distance from the frame's edge; the lowest altitude at which an azimuth's stands, deg; how far an
# altitude's stands from the line of the azimuth, deg
LABEL_PX, LOWEST, OFF_THE_LINES = 20, 5, 3
NAMES = {0: "N", 90: "E", 180: "S", 270: "W"}
# bytes of a PNG up to the end of its first chunk
PNG_HEADER = 33
# blue, green, red
GRID, FIGURES, LABELS = (120, 120, 40), (150, 90, 150), (0, 220, 255)


def _figures(seen: inputs.FrameAtPlace) -> Iterator[np.ndarray]:
    """Azimuths and altitudes (N, 2) in deg along the lines of the constellations, above the horizon."""
    at = seen.at_place
    state, to_local = earth_state(at.utc_unix_s), at.place.plumb_axes
    for lines in rows_of(DATA / "figures.yaml").values():
        for each in lines:
            stars = rotation.unit_vector(*np.radians(np.reshape(each, (-1, 2))).T)
            v = state.to_itrs(stars) @ to_local.T
            # a line is straight in the sky, and bent by the lens
            share = np.linspace(0, 1, 12)[:, None]
            for begin, end in itertools.pairwise(v):
                between = rotation.normalised(begin * (1 - share) + end * share)
                azimuth, altitude = np.arctan2(between[:, 0], between[:, 1]), np.arcsin(between[:, 2])
                if altitude.min() > 0:
                    yield np.degrees(np.stack([azimuth, altitude], -1))


def _shade(picture: np.ndarray, seen: inputs.FrameAtPlace, n: int, ground: np.ndarray) -> None:
    """Darken the part of a picture (h, w, 3) below a horizon (N, 2) in deg."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    xy = (np.stack([x.ravel(), y.ravel()], -1) + 0.5) * n - 0.5
    v = seen.camera.directions(*xy.T) @ seen.at_place.optics.rotation.T
    edge = np.interp(np.degrees(np.arctan2(v[:, 0], v[:, 1])), ground[:, 0], ground[:, 1], period=360)
    below = (np.degrees(np.arcsin(np.clip(v[:, 2], -1, 1))) < edge).reshape(picture.shape[:2])
    picture[below] = picture[below] // 3


def _draw(path: str, seen: inputs.FrameAtPlace, points: np.ndarray, ground: np.ndarray | None) -> None:
    """Draw the frame with stars, the grid, constellations and the points, the ground (N, 2) in deg darkened."""
    import cv2

    from starpos.frames.annotate import Identified, annotate, shrink

    frame, stars, solution = seen.item, seen.sight.stars, seen.sight.solution
    if not isinstance(frame, Frame):
        raise InstrumentError(
            f"{path}: a list of stars has no picture to draw on: give a frame for --overlay"
        )
    star, magnitudes = (np.zeros(0) if v is None else v for v in (solution.star, solution.magnitudes))
    named = Identified(star=star.astype(int).tolist(), names=solution.names, magnitudes=magnitudes.tolist())
    picture = annotate(frame, stars, named)
    n = shrink(frame)

    def line(directions: np.ndarray) -> np.ndarray:
        """Points (N, 2) of the picture where azimuths and altitudes (N, 2) in deg are."""
        return (_pixels(seen, np.radians(directions)) + 0.5) / n - 0.5

    if ground is not None:
        _shade(picture[: seen.camera.height // n], seen, n, ground)
    round_, up = np.arange(0, 360 + ALONG, ALONG), np.arange(0, 90, ALONG)
    grid = [(np.stack([round_, np.full_like(round_, a)], -1), GRID) for a in ALTITUDES]
    grid += [(np.stack([np.full_like(up, a), up], -1), GRID) for a in AZIMUTHS]
    grid += [(each, FIGURES) for each in _figures(seen)]
    for directions, colour in grid:
        for begin, end in itertools.pairwise(line(directions)):
            if np.isfinite([begin, end]).all():
                cv2.line(picture, tuple(map(round, begin)), tuple(map(round, end)), colour, 1, cv2.LINE_AA)
    # azimuths where they enter the frame from below, altitudes along the first azimuth that shows them
    rising = ([(azimuth, h) for h in range(LOWEST, 90)] for azimuth in AZIMUTHS)
    labels = [(NAMES.get(azimuth, str(azimuth)), way) for azimuth, way in zip(AZIMUTHS, rising, strict=True)]
    labels += [(f"{h} deg", [(azimuth + OFF_THE_LINES, h) for azimuth in AZIMUTHS]) for h in ALTITUDES]
    room = np.array([LABEL_PX, LABEL_PX]), np.array(picture.shape[1::-1]) - [2 * LABEL_PX, 2 * LABEL_PX]
    for text, way in labels:
        xy = line(np.array(way, float))
        inside = np.flatnonzero(((xy > room[0]) & (xy < room[1])).all(1))
        if inside.size:
            at = tuple(map(round, xy[inside[0]]))
            cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, LABELS, 1, cv2.LINE_AA)
    for x, y in (points + 0.5) / n - 0.5:
        cv2.drawMarker(picture, (round(x), round(y)), (60, 60, 255), cv2.MARKER_CROSS, 15)
    png = cv2.imencode(".png", picture)[1].tobytes()
    # after the header: who made it, so that the next call may replace it
    chunk = b"tEXtSoftware\0starpos"
    made_by = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    save(path, png[:PNG_HEADER] + made_by + png[PNG_HEADER:], "the picture")

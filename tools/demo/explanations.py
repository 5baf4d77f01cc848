# SPDX-License-Identifier: Apache-2.0
"""Draw the figures of docs/how-to/calibrate.md (turning on the spot) and docs/how-to/gnss.md (the guard).

    python tools/demo/explanations.py [--out docs/images]

The first one runs the command line on a simulated turn, the second one the guard on a simulated drive.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.vertical import Deflection
from starpos.gnss.watch import GnssStatus, GnssWatch
from starpos.instrument import sensors
from starpos.report.style import BLUE, GREEN, GREY, ORANGE, RED, mark_simulated, new_figure, plain, png_of
from starpos.units import HOUR_S
from starpos_testing.gnss_drives import GnssDrive

PLACE_DEG = (35.7046, 51.4106)
TURN = (
    "-n",
    "12",
    "--turn",
    "30",
    "--stars-only",
    "--altitude",
    "84",
    "--misalignment",
    "0.03",
    "-0.02",
    "20",
)
# A3 is assumed without the small angles that it has
ASSUMED = ("--misalignment", "0", "0", "20", "--inclinometer", "sca100t_calibrated", "--json")
# The receiver's place is dragged away from this moment on, at this speed.
DRAGGED_FROM_S, DRAG_M_S = 2.0 * HOUR_S, 1.0
SEED = 9
STATUS = {
    GnssStatus.LEARNING: GREY,
    GnssStatus.AGREES: GREEN,
    GnssStatus.DOUBTFUL: ORANGE,
    GnssStatus.DISAGREES: RED,
}


def solved(folder: Path, *options: str) -> list[dict]:
    """The objects that `starpos solve` prints."""
    command = ["starpos", "solve", str(folder), *ASSUMED, *options]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def east_north_km(fixes: list[dict]) -> np.ndarray:
    """Offsets (N, 2) of fixes from the simulated place."""
    latitude, longitude = np.radians(PLACE_DEG)
    places = np.radians([(fix["longitude"], fix["latitude"]) for fix in fixes]) - (longitude, latitude)
    return places * curvature_radii_m(latitude) * (np.cos(latitude), 1.0) / 1000


def turning() -> bytes:
    """Fixes with a wrong A3 lie on a circle; the turn finds the place at its centre."""
    with tempfile.TemporaryDirectory() as scratch:
        night = Path(scratch) / "turn"
        subprocess.run(["starpos", "simulate", str(night), *TURN], check=True, capture_output=True)
        frames = east_north_km(solved(night, "--misalignment-stddev", "130")[:12])
        [found] = east_north_km(solved(night, "--turn-stddev", "2", "--self-calibrate")[-1:])
    figure = new_figure(6.2)
    axes = figure.subplots()
    plain(axes)
    radius = np.hypot(*frames.T).mean()
    angle = np.linspace(0, 2 * np.pi, 200)
    axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=GREY, lw=0.8)
    axes.plot(*frames.T, "o", color=BLUE, label="one frame each, A3 wrong by 130 arcsec")
    for k, (east, north) in enumerate(frames):
        axes.annotate(f"{30 * k}", (east, north), (6, 6), textcoords="offset points", color=BLUE, fontsize=8)
    axes.plot(*found, "D", color=ORANGE, ms=8, label="all frames, A3 found by turning")
    axes.plot(0, 0, "+", color="black", ms=18, mew=1.5, label="true place")
    axes.set(xlabel="east, km", ylabel="north, km", title="A turn on the spot; numbers: deg turned")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False)
    mark_simulated(figure)
    return png_of(figure)


def guard() -> bytes:
    """Distance of GNSS from the stars' place while its place is dragged away slowly, by what the guard says."""
    drive = GnssDrive(errors=sensors.SCA100T_CALIBRATED, stops=100)
    watch = GnssWatch(drive.instrument, Deflection(stddev_arcsec=drive.deflection_arcsec))
    rows, begin = [], 0.0

    def dragged(t: float) -> np.ndarray:
        return np.array([DRAG_M_S * max(t - DRAGGED_FROM_S, 0.0), 0.0])

    for moment in drive.moments(np.random.default_rng(SEED), dragged):
        begin = begin or moment.gnss.utc_unix_s
        watch.advance(moment.sighting)
        check = watch.judge(moment.sighting, moment.gnss)
        watch.learn(moment.sighting, moment.gnss, check)
        if check.distance_m is not None:
            t = moment.gnss.utc_unix_s - begin
            rows.append((check.status, t / HOUR_S, check.distance_m, check.sigma_m, dragged(t)[0]))
    figure = new_figure(3.6)
    axes = figure.subplots()
    plain(axes)
    for status, colour in STATUS.items():
        if of_it := [row[1:] for row in rows if row[0] == status]:
            hours, distance, sigma, _ = np.array(of_it).T
            axes.errorbar(
                hours, distance, sigma, fmt="o", ms=3, color=colour, elinewidth=0.7, alpha=0.8, label=status
            )
    hours, off = np.array([(row[1], row[4]) for row in rows]).T
    axes.plot(hours, off, color="black", lw=1.2, ls="--", label="how far it is dragged")
    axes.set(
        xlabel="h after the first frame", ylabel="GNSS from the stars' place, m", ylim=(0, 2500), xlim=(0, 3)
    )
    axes.set_title("GNSS is dragged away by 1 m/s from 2 h on")
    axes.legend(fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    mark_simulated(figure)
    return png_of(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    (options.out / "turning.png").write_bytes(turning())
    (options.out / "gnss_guard.png").write_bytes(guard())


if __name__ == "__main__":
    main()

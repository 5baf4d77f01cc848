# SPDX-License-Identifier: Apache-2.0
"""The commands of `starpos`: a summary, examples and next steps for each."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """A command for --help; `text` begins with a small letter and has no full stop."""

    text: str
    examples: tuple[str, ...]
    next_step: str

    @property
    def epilog(self) -> str:
        """The end of its --help."""
        examples = "".join(f"  {example}\n" for example in self.examples)
        return f"examples:\n{examples}\nnext: {self.next_step}"


COMMANDS = {
    "solve": Command(
        "position and heading of frames with their tilts",
        (
            "starpos simulate night && starpos solve night --misalignment 0 0 0 --misalignment-stddev 5 "
            "--inclinometer sca100t_calibrated",
            "starpos solve *.fits --tilt tilt.csv --focal-mm 600 --pixel-um 6.4 --self-calibrate --save instrument.yaml",
            "starpos solve *.fits --tilt tilt.csv --instrument instrument.yaml --near 35.7 51.4 --csv > places.csv",
        ),
        "starpos report draws the same night; starpos calibrate and --self-calibrate find A3",
    ),
    "navigate": Command(
        "position, heading and velocity of a voyage: frames and an IMU, while driving, sailing, flying",
        (
            "starpos navigate *.csv --imu imu.csv --focal-mm 16 --pixel-um 3.45",
            "starpos navigate *.fits --imu imu.csv --velocity wheels.csv --instrument instrument.yaml --json",
        ),
        "starpos solve, for an instrument that stands still",
    ),
    "detect": Command(
        "the stars of frames",
        (
            "starpos detect frame.fits",
            "starpos detect *.fits --csv > stars.csv",
        ),
        "starpos identify names them",
    ),
    "identify": Command(
        "where frames look, lost in space",
        (
            "starpos identify photo.jpg",
            "starpos identify *.fits --focal-mm 600 --pixel-um 6.4 --jobs auto --csv > where.csv",
        ),
        "starpos solve computes the position from frames with their tilts and times",
    ),
    "replay": Command(
        "solve recorded nights (rosbag2) with the solver's own code: the same fixes as in the running graph",
        (
            "starpos replay recorded_night",
            "starpos replay nights/* --params-file robot.yaml --jobs auto --json",
        ),
        "starpos report draws the same bags",
    ),
    "calibrate": Command(
        "A3 at a known place, or the camera, from identified stars",
        (
            "starpos calibrate *.fits --tilt tilt.csv --focal-mm 600 --pixel-um 6.4 --site 35.70 51.41 --output a3.yaml",
            "starpos calibrate *.fits --focal-mm 600 --pixel-um 6.4 --camera camera.yaml",
        ),
        "starpos solve --instrument with the file that was written",
    ),
    "deflection": Command(
        "deflection of the vertical at a known site, from a zenith camera's frames and tilts",
        (
            "starpos deflection *.fits --tilt tilt.csv --site 47.3 8.5 560 --instrument zenith.yaml --pressure-hpa 950 "
            "--temperature-c 12",
            "starpos deflection --plan 0.1 --site 47.3 8.5 560 --instrument zenith.yaml",
        ),
        "starpos stations and starpos report read what --json prints; docs/how-to/deflection.md has the whole way",
    ),
    "stations": Command(
        "many sessions of starpos deflection: repeats, differences from a geoid grid, levelling, GeoJSON",
        (
            "starpos deflection *.fits --tilt tilt.csv --site 47.3 8.5 560 --station P1 --instrument z.yaml --json > "
            "p1.json",
            "starpos stations p1.json p2.json --geoid egm96_15.gtx --level P1 P2",
            "starpos stations *.json --geojson > stations.geojson",
        ),
        "starpos report p1.json makes the station's page",
    ),
    "report": Command(
        "nights on one page: stability, scatter, residuals, sky, error budget",
        (
            "starpos report night --misalignment 0 0 0 --misalignment-stddev 5 --inclinometer sca100t_calibrated "
            "-o my-report",
        ),
        "open the index.html whose path it prints",
    ),
    "simulate": Command(
        "write a night of frames and tilts from a place you choose",
        (
            "starpos simulate night",
            "starpos simulate turned -n 8 --turn 45 --stars-only --misalignment 1 -2 100 --latitude 47.3 --longitude 8.5",
        ),
        "starpos solve FOLDER, starpos report FOLDER; truth.json has the true values",
    ),
    "catalogue": Command(
        "build the star catalogue, or describe it and its triangles",
        (
            "starpos catalogue info",
            "starpos catalogue deepen --fetch",
        ),
        "starpos identify and starpos solve take the catalogue by themselves",
    ),
    "montecarlo": Command(
        "identify random fields, solve random nights, and count successes: the paper's tables",
        ("starpos montecarlo --fields 100", "starpos montecarlo nights --help"),
        "docs/the_paper.md compares the tables with the paper's",
    ),
    "first-night": Command(
        "focus, exposure, level, clock, the level's signs, then A3 by turning: step by step, live, until it is saved",
        (
            "starpos first-night NIGHT --focal-mm 600 --pixel-um 6.4 --save instrument.yaml",
            "starpos first-night NIGHT --save instrument.yaml --field night.zip",
        ),
        "starpos solve --instrument with the file that was written",
    ),
    "doctor": Command(
        "which parts that starpos needs this machine has, which are missing, and what to type",
        (
            "starpos doctor",
            "starpos doctor --live --json",
        ),
        "starpos simulate night, and starpos solve night",
    ),
}

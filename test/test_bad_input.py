# SPDX-License-Identifier: Apache-2.0
"""Whatever comes in: a status and one sentence, no fix that the numbers do not support, and the node goes on."""

import array
import math
from copy import deepcopy

import pytest
from sensor_msgs.msg import NavSatFix, NavSatStatus

from starpos_interfaces.msg import Solution
from starpos_testing.graph.shots import FULL_FOCAL_PX, SOLVER, photograph, shoot

NAN = math.nan
HALF_MINUTE_S = 30


def is_no_fix(fix) -> bool:
    numbers = (fix.latitude, fix.longitude, fix.altitude)
    return (
        fix.status.status == NavSatStatus.STATUS_NO_FIX
        and all(map(math.isnan, numbers))
        and fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN
    )


def check_refused(graph, stamp, status, words):
    """The answer to a bad input, and that nothing else came of it; then a good shot is a good fix again."""
    solution, fix, _ = graph.result(stamp)
    assert (solution.status, is_no_fix(fix)) == (status, True), solution.status_text
    assert words in solution.status_text
    assert "\n" not in solution.status_text and len(solution.status_text) < 300
    assert math.isnan(solution.latitude) and math.isnan(solution.heading)
    check_good(graph)
    # heading/imu comes in order: one for the bad input would have come before the good one's
    assert stamp not in graph.imus


def check_good(graph):
    shot = shoot()
    solution, _, _ = graph.answer(shot)
    assert solution.status == Solution.OK, solution.status_text
    assert abs(shot.error_m(solution)).max() < 60


# Before the fixture `solver`: there may be one at a time.
def test_without_intrinsics(graph, run):
    process = run("starpos_solver", "solver", *SOLVER)
    graph.wait_for_solver()
    shot = shoot()
    graph.stars.publish(shot.stars)
    solution, fix, _ = graph.result(shot.stamp)
    assert solution.status == Solution.NO_CAMERA and "camera_info" in solution.status_text
    assert is_no_fix(fix)
    broken, shot = deepcopy(shot.info), shoot()
    broken.k = [0.0] * 9
    graph.info.publish(broken)
    graph.wait(lambda: "not calibrated" in process.output, "for its word on the intrinsics")
    graph.stars.publish(shot.stars)
    check_refused(graph, shot.stamp, Solution.NO_CAMERA, "not calibrated")


def test_a_missing_catalogue_ends_the_node_with_one_line(graph, run, tmp_path, monkeypatch):
    none = str(tmp_path / "none.npz")
    monkeypatch.setenv("STARPOS_CATALOGUE", none)
    process = run("starpos_solver", "solver", *SOLVER)
    assert process.wait() == 1
    (line,) = process.output.splitlines()
    assert f"{none}: no catalogue there: run `starpos catalogue --help`" in line


def with_star(index=0, **values):
    def change(shot):
        for name, value in values.items():
            setattr(shot.stars.stars[index], name, value)

    return change


def with_stars(change):
    return lambda shot: change(shot.stars)


def with_tilts(**values):
    def change(shot):
        for tilt in shot.tilts:
            for name, value in values.items():
                setattr(tilt, name, value)

    return change


def later(messages, seconds):
    for m in messages:
        m.header.stamp.sec += seconds


def swap(shot):
    stars = list(shot.stars.stars)
    shot.stars.stars = [stars[-1], *stars[1:-1], stars[0]]


def into_2037(shot):
    # 2037-01-01
    seconds = 2114380800 - shot.stars.header.stamp.sec
    shot.stars.header.stamp.nanosec = 0
    later([shot.stars, *shot.tilts], seconds)


def other_size(shot):
    shot.info.height = 3745


def other_focal(shot):
    # Beyond 3 %, but no other catalogue of triangles.
    shot.info.k[0] = shot.info.k[4] = FULL_FOCAL_PX * 1.042


BAD = Solution.BAD_INPUT
CASES = {
    "no stamp": (with_stars(lambda s: setattr(s.header.stamp, "sec", 0)
                            or setattr(s.header.stamp, "nanosec", 0)), BAD,
                 "stars: no time of exposure: its header stamp is missing"),
    "beyond the tables": (into_2037, Solution.TIME_OUTSIDE_TABLES,
                          "2037-01-01T00:00:00.000Z lies outside the IERS tables (1973 to 20"),
    "no stars": (with_stars(lambda s: setattr(s, "stars", [])), Solution.TOO_FEW_STARS, "0 stars"),
    "three stars": (with_stars(lambda s: setattr(s, "stars", s.stars[:3])), Solution.TOO_FEW_STARS, "3 stars"),
    "NaN in a star": (with_star(x=NAN), BAD, "NaN"),
    "infinite flux": (with_star(flux=math.inf), BAD, "infinity"),
    "NaN covariance": (with_star(covariance=[NAN] * 4), BAD, "NaN"),
    "impossible covariance": (with_star(covariance=[1.0, 2.0, 2.0, 1.0]), BAD, "positive definite"),
    "negative covariance": (with_star(covariance=[-1.0, 0.0, 0.0, -1.0]), BAD, "positive definite"),
    "unsorted stars": (swap, BAD, "brightest first"),
    "no size": (with_stars(lambda s: setattr(s, "width", 0)), BAD, "width"),
    "NaN exposure": (with_stars(lambda s: setattr(s, "exposure", NAN)), BAD, "exposure"),
    "an exposure beyond any": (with_stars(lambda s: setattr(s, "exposure", 1e300)), BAD, "exposure"),
    "NaN error of the stamp": (with_stars(lambda s: setattr(s, "stamp_stddev", NAN)), BAD, "stamp_stddev"),
    "negative error of the stamp": (with_stars(lambda s: setattr(s, "stamp_stddev", -1e-3)), BAD, "stamp_stddev"),
    "an error of the stamp beyond numbers": (with_stars(lambda s: setattr(s, "stamp_stddev", 1e300)), BAD,
                                             "stamp_stddev"),
    "another frame size": (with_stars(lambda s: setattr(s, "width", 5000)), BAD, "5000 x 3744"),
    "no tilt at all": (lambda shot: shot.tilts.clear(), Solution.NO_TILT, "tilt"),
    "tilts of another minute": (lambda shot: later(shot.tilts, HALF_MINUTE_S), Solution.NO_TILT, "tilt"),
    "NaN tilts": (with_tilts(x=NAN), Solution.NO_TILT, "tilt"),
    "tilts without a stamp": (lambda shot: [setattr(t.header.stamp, "sec", 0) or
                              setattr(t.header.stamp, "nanosec", 0) for t in shot.tilts], Solution.NO_TILT, "tilt"),
    "impossible tilt covariance": (with_tilts(covariance=[1.0, 2.0, 2.0, 1.0]), Solution.NO_TILT, "tilt"),
    "tilts that cannot hold together": (with_tilts(x=1.0, y=1.0), Solution.NO_TILT, "tilt"),
    "tilt flagged out of range": (with_tilts(flags=1), Solution.TILT_OUT_OF_RANGE, "beyond its range"),
    "tilt flagged as stuck": (with_tilts(flags=2), Solution.NO_TILT, "same value"),
    "tilts of a moving instrument": (lambda shot: [setattr(t, "x", 0.01 * k) for k, t in enumerate(shot.tilts)],
                                     Solution.NO_TILT, "not at rest"),
    "intrinsics of another size": (other_size, BAD, "5616 x 3745"),
    "another focal length": (other_focal, Solution.NOT_IDENTIFIED, "focal length"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_bad_stars_tilts_and_intrinsics(graph, solver, name):
    change, status, words = CASES[name]
    shot = shoot()
    change(shot)
    graph.send(shot)
    check_refused(graph, shot.stamp, status, words)


def test_a_tilt_beyond_the_range_of_the_sensors_model_is_refused(graph, solver):
    assert graph.set("solver", inclinometer__model="sca100t") == (True, "")
    shot = shoot()
    with_tilts(y=math.radians(31))(shot)
    graph.send(shot)
    check_refused(graph, shot.stamp, Solution.TILT_OUT_OF_RANGE, "beyond +-30 deg")
    assert graph.set("solver", inclinometer__model="") == (True, "")


@pytest.mark.parametrize(
    ("change", "status"),
    [
        # a camera_info that states no size says nothing of the camera
        (lambda m: setattr(m, "width", 0), Solution.OK),
        (lambda m: setattr(m, "k", [0.0] * 9), Solution.NO_CAMERA),
        (lambda m: setattr(m, "d", [NAN] * 5), Solution.NO_CAMERA),
        (lambda m: setattr(m, "distortion_model", "equidistant"), Solution.NO_CAMERA),
    ],
)
def test_intrinsics_that_are_refused_leave_no_older_ones_in_force(graph, solver, change, status):
    check_good(graph)
    shot = shoot()
    broken = deepcopy(shot.info)
    change(broken)
    shot.info = broken
    graph.send(shot)
    assert graph.result(shot.stamp)[0].status == status
    check_good(graph)


@pytest.fixture(scope="module")
def detector(graph, solver, tmp_path_factory):
    process = graph.start(tmp_path_factory.mktemp("detector") / "log", "starpos_camera", "detector")
    graph.wait_for_detector(photograph)
    return process


def truncate(image):
    image.data = image.data[:-100]


def unstamp(image):
    image.header.stamp.sec = image.header.stamp.nanosec = 0


def empty(image):
    image.width = image.height = image.step = 0
    image.data = array.array("B")


def flood(byte):
    def change(image):
        image.data = array.array("B", bytes([byte])) * len(image.data)

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (truncate, "truncated"),
        (lambda image: setattr(image, "encoding", "32FC1"), "32FC1"),
        (unstamp, "no time stamp"),
        (empty, "empty"),
        (lambda image: setattr(image, "step", 10), "step"),
    ],
)
def test_images_that_are_none_are_named_and_the_next_is_solved(graph, solver, detector, change, words):
    _, image, _ = photograph()
    stamp = (image.header.stamp.sec, image.header.stamp.nanosec)
    change(image)
    graph.image.publish(image)
    graph.state("detector: Stars", words)
    check_image(graph)
    assert stamp not in graph.solutions and (0, 0) not in graph.imus


@pytest.mark.parametrize("byte", [0, 255])
def test_images_without_stars(graph, solver, detector, byte):
    shot, image, capture = photograph()
    flood(byte)(image)
    graph.send(shot, image, capture)
    check_refused(graph, shot.stamp, Solution.TOO_FEW_STARS, "0 stars")
    check_image(graph)


def check_image(graph):
    shot, image, capture = photograph()
    graph.send(shot, image, capture)
    solution, _, _ = graph.result(shot.stamp)
    assert solution.status == Solution.OK, solution.status_text
    assert abs(shot.error_m(solution)).max() < 300

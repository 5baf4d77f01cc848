# SPDX-License-Identifier: Apache-2.0
"""The simulated instrument, against hand-made numbers where the rest of the package cannot vouch for it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from starpos.earth.orientation import earth_state
from starpos.errors import FrameError, TimeError
from starpos.frames.reading import read_frame
from starpos.instrument.inclinometer import level_of, up_of
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.simulation.scene import Exposed, Optics, TiltErrors, expose, read_tilt, render, write_night
from starpos.sky.site import Site, camera_to_enu
from starpos.units import unix_of
from starpos_testing.skies.scenes import EXPOSURE, FOCAL_PX, SIZE, START, stars_of, wide_scene


def test_a_camera_points_where_it_is_told():
    """Azimuth from north over east, altitude; x level and to the right for one who looks along z; roll about z."""
    east = camera_to_enu(90.0, 30.0, 0.0)
    np.testing.assert_allclose(east[:, 2], [np.cos(np.pi / 6), 0, 0.5], atol=1e-15)
    # South is on the right.
    np.testing.assert_allclose(east[:, 0], [0, -1, 0], atol=1e-15)
    # Y down.
    assert east[2, 1] < 0
    # Roll lifts the right side.
    np.testing.assert_allclose(camera_to_enu(0.0, 0.0, 90.0)[:, 0], [0, 0, 1], atol=1e-15)
    for roll in (0.0, 33.0, -120.0):
        c = camera_to_enu(200.0, 66.0, roll)
        np.testing.assert_allclose(c @ c.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(c) == pytest.approx(1)


def test_tilt_is_what_turns_the_frame_level(rng):
    """A2 A3 takes the vertical as C sees it to z: the inclinometer reads what the equation needs."""
    for _ in range(20):
        scene = wide_scene(
            pointing_deg=(float(rng.uniform(0, 360)), float(rng.uniform(66, 90)), float(rng.uniform(0, 360))),
            misalignment_deg=tuple(rng.uniform(-3, 3, 3).tolist()),
        )
        up = level_of(up_of(scene.tilt)) @ scene.instrument.calibration.a3 @ scene.attitude[2]
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-14)


def test_overhead_misses_no_star(catalogue, rng):
    """Every catalogue star whose refracted direction lies in the cone, by brute force over the sky's bright stars."""
    state = earth_state(START)
    every = np.flatnonzero(catalogue.vmag() < 6)
    for _ in range(5):
        site = Site(float(rng.uniform(-80, 80)), float(rng.uniform(-180, 180)))
        toward = camera_to_enu(rng.uniform(0, 360), rng.uniform(30, 90), 0.0)[:, 2]
        seen = site.observed(catalogue, every, state)
        inside = every[(seen @ toward > np.cos(0.1)) & (seen[:, 2] > 0.3)]
        found = site.overhead(catalogue, state, toward, 0.1, 6.0)
        assert set(inside) <= set(found)


def test_the_sky_turns_15_arcsec_a_second(catalogue, rng):
    """Trails: 15.04 arcsec/s times the cosine of the declination, westward, round the pole."""
    scene = wide_scene(latitude_deg=0.0, pointing_deg=(0.0, 90.0, 0.0))
    stars = expose(scene, catalogue, START, 10.0, rng)
    trail = np.hypot(*(stars.end - stars.start).T) * scene.camera.scale_arcsec
    # Declination below 2.5 deg, plate scale true.
    near = np.hypot(*(stars.middle - scene.camera.centre_px).T) < 200
    assert trail[near] == pytest.approx(150.4, rel=0.003)


def test_brightness_is_pogsons(catalogue, rng):
    scene = wide_scene()
    stars = expose(scene, catalogue, START, 2.0, rng)
    expected = 2.0 * scene.optics.zero_point_e_s * 10 ** (-0.4 * catalogue.vmag(stars.catalogue))
    assert stars.electrons == pytest.approx(expected)


def test_seeing_moves_each_star_for_the_whole_exposure(catalogue):
    calm, rough = (replace(wide_scene(), optics=Optics(limit_mag=7.5, seeing_arcsec=s)) for s in (0.0, 44.5))
    a, b = (expose(s, catalogue, START, EXPOSURE, np.random.default_rng(1)) for s in (calm, rough))
    known = {k: n for n, k in enumerate(a.catalogue.tolist())}
    pairs = [(known[k], n) for n, k in enumerate(b.catalogue.tolist()) if k in known]
    i, j = np.array(pairs).T
    moved = b.middle[j] - a.middle[i]
    np.testing.assert_allclose(b.end[j] - a.end[i], moved, atol=1e-9)
    assert np.std(moved) == pytest.approx(1.0, rel=0.15)


def one_star(scene, electrons, at=(60.3, 40.7), trail=(3.0, 4.0)):
    middle = np.array([at])
    return Exposed(
        middle - np.array(trail) / 2,
        middle,
        middle + np.array(trail) / 2,
        np.array([electrons]),
        np.array([0]),
    )


@pytest.fixture
def dark():
    """A small camera without sky, noise or bias."""
    scene = wide_scene(size=(120, 80))
    return replace(
        scene, optics=Optics(sky_mag_arcsec2=60.0, read_noise_e=0.0, bias_dn=100.0, full_well_dn=65535.0)
    )


def test_a_rendered_star_has_its_light_its_place_and_its_trail(dark, rng):
    total, x, y = 0.0, 0.0, 0.0
    for _ in range(20):
        pixels = render(dark, one_star(dark, 2e5), START, EXPOSURE, rng).pixels.astype(float) - 100
        total += pixels.sum() / 20
        row, column = np.mgrid[:80, :120]
        x += (pixels * column).sum() / pixels.sum() / 20
        y += (pixels * row).sum() / pixels.sum() / 20
    assert total == pytest.approx(2e5, rel=1e-3)
    assert (x, y) == pytest.approx((60.3, 40.7), abs=0.01)
    spread = (pixels * (column - x) ** 2).sum() / pixels.sum(), (pixels * (row - y) ** 2).sum() / pixels.sum()
    # The image's own variance, and a pixel's.
    own = (2.4 / 2.3548) ** 2 + 1 / 12
    assert spread == pytest.approx((own + 9 / 12, own + 16 / 12), rel=0.02)


def test_a_star_on_the_edge_loses_what_falls_off(dark, rng):
    half = render(dark, one_star(dark, 2e5, at=(-0.5, 40.0), trail=(0, 0)), START, EXPOSURE, rng)
    assert half.pixels.astype(float).sum() - 100 * half.pixels.size == pytest.approx(1e5, rel=0.01)
    gone = render(dark, one_star(dark, 1e6, at=(-50.0, 40.0)), START, EXPOSURE, rng)
    assert gone.pixels.max() <= 101


def test_noise_is_photons_and_read_noise_and_light_saturates(rng):
    scene = replace(wide_scene(size=(200, 150)), optics=Optics(sky_mag_arcsec2=18.0, gain_e_dn=2.0))
    nothing = Exposed(*np.zeros((3, 0, 2)), np.zeros(0), np.zeros(0, int))
    pixels = render(scene, nothing, START, EXPOSURE, rng).pixels.astype(float)
    sky = 3e7 * EXPOSURE * 10 ** (-0.4 * 18.0) * scene.camera.scale_arcsec**2
    assert pixels.mean() == pytest.approx(512 + sky / 2, rel=1e-3)
    assert pixels.std() == pytest.approx(np.hypot(np.sqrt(sky), 6) / 2, rel=0.02)
    bright = render(scene, one_star(scene, 1e9), START, EXPOSURE, rng).pixels
    assert bright.max() == 16383


def test_a_frame_knows_its_middle(dark, rng):
    frame = render(dark, one_star(dark, 1e4), START, 3.0, rng)
    assert (frame.mid_unix_s, frame.exposure_s, frame.focal_px) == (START + 1.5, 3.0, FOCAL_PX)


def test_tilt_errors(rng):
    errors = TiltErrors(noise=1e-4, zero=(2e-3, -1e-3))
    scene = replace(wide_scene(), tilt_errors=errors)
    readings = np.array([read_tilt(scene, rng) for _ in range(3000)]) - scene.tilt
    assert readings.mean(0) == pytest.approx([2e-3, -1e-3], abs=1e-5)
    assert readings.std(0) == pytest.approx([1e-4, 1e-4], rel=0.06)
    exact = replace(scene, tilt_errors=TiltErrors(0.0, quantum=0.0))
    assert read_tilt(exact, rng) == pytest.approx(scene.tilt, abs=1e-15)


def test_listed_stars_are_sorted_and_err_as_they_say(catalogue, rng):
    scene = wide_scene()
    scene = replace(scene, optics=replace(scene.optics, seeing_arcsec=0.0))
    stars = stars_of(scene, catalogue, rng)
    true = expose(scene, catalogue, START, EXPOSURE, rng).middle
    assert np.all(np.diff(stars.flux) <= 0)
    assert (stars.width, stars.height) == SIZE
    xy = np.stack([stars.x, stars.y], 1)
    error = xy - true[cKDTree(true).query(xy)[1]]
    assert np.std(error / np.sqrt(stars.covariance[:, 0, 0])[:, None]) == pytest.approx(1, rel=0.15)


def test_a_night_on_disk_reads_back(tmp_path, catalogue, rng):
    scene = wide_scene(size=(160, 120), tilt_noise_deg=0.0)
    done = []
    write_night(tmp_path, scene, catalogue, "2026-11-02T18:00:00", 2, 5.0, 1.0, 30.0, False, rng,
                lambda what, d: done.append(d))  # fmt: skip
    truth = json.loads((tmp_path / "truth.json").read_text())
    first, second = (read_frame(tmp_path / f"frame_000{k}.fits") for k in range(2))
    assert first.mid_unix_s == truth["frames"][0]["mid_unix_s"] == START + 0.5
    assert second.mid_unix_s == START + 5.5
    assert (first.exposure_s, first.focal_px) == (1.0, pytest.approx(FOCAL_PX))
    assert first.pixels.dtype == np.uint16
    assert (truth["frames"][1]["heading_deg"] - truth["frames"][0]["heading_deg"]) % 360 == pytest.approx(30)
    tilt = read_tilt_csv(tmp_path / "tilt.csv").average(first.mid_unix_s, 1.0)
    assert tilt.samples == 10
    assert (tilt.theta_x, tilt.theta_y) == pytest.approx(scene.tilt, abs=2e-9)
    assert done == [0.5, 1.0]


def test_star_lists_on_disk_read_back(tmp_path, catalogue):
    scene = wide_scene()
    write_night(
        tmp_path,
        scene,
        catalogue,
        "2026-11-02T18:00:00Z",
        1,
        5.0,
        EXPOSURE,
        0.0,
        True,
        np.random.default_rng(3),
    )
    back = read_frame(tmp_path / "stars_0000.csv")
    made = stars_of(scene, catalogue, np.random.default_rng(3))
    np.testing.assert_allclose(back.x, made.x, atol=1e-5)
    np.testing.assert_allclose(back.covariance, made.covariance, atol=1e-6)
    assert back.mid_unix_s == made.mid_unix_s


def test_times_of_a_night():
    assert (
        unix_of("2026-11-02T18:00:00")
        == unix_of("2026-11-02T18:00:00Z")
        == unix_of("2026-11-02T19:00:00+01:00")
        == START
    )
    with pytest.raises(TimeError, match="write it like"):
        unix_of("tonight")


def test_a_night_that_cannot_be_written(tmp_path, catalogue, rng):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FrameError, match="cannot be written"):
        write_night(
            tmp_path / "file", wide_scene(), catalogue, "2026-11-02", 1, 5.0, EXPOSURE, 0.0, True, rng
        )

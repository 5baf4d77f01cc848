# SPDX-License-Identifier: Apache-2.0
"""`starpos deflection`, on lists of the stars above a place whose plumb line differs from the ellipsoid's normal."""

import json
import re

import numpy as np
import pytest
from cli_calls import objects

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.errors import InstrumentError
from starpos.frames.reading import read_frame
from starpos.instrument.camera import Camera
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.session.driver import Level
from starpos.session.replay import Replay
from starpos.session.settings import Settings
from starpos.sky.site import Site
from starpos.units import ARCSEC, utc_text

LATITUDE, LONGITUDE, HEIGHT_M = 61.2, 24.5, 900.0
# large, so that refraction towards the plumb line, not the ellipsoid's normal, is 7 mas of it
XI, ETA = 30.0, -12.0
BEGIN = 1.75e9
CAMERA = Camera.from_focal(1000, 700, 4636.0)
INSTRUMENT = """starpos_instrument: 1
camera: {focal_mm: 29.6704, pixel_um: 6.4}
tilt_noise_deg: 1.0e-5
tilt_quantum_deg: 1.0e-7
tilt_drift_arcsec_per_sqrt_hour: 0.01
tilt_temperature_arcsec_per_c: 0
tilt_scale: 1.0e-4
clock_stddev_s: 1.0e-4
shutter: {readout_s: 0, readout_stddev_s: 0}
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory, catalogue):
    """Four faces of two star lists each, their tilts and the instrument's file."""
    folder = tmp_path_factory.mktemp("zenith")
    rng = np.random.default_rng(5)
    cosine = np.cos(np.radians(LATITUDE))
    air = Atmosphere(pressure_pa=90_000.0, temperature_c=5.0, humidity=0.3)
    # far from the poles: Phi = phi + xi, Lambda = lambda + eta / cos(phi)
    site = Site(LATITUDE + XI / 3600, LONGITUDE + ETA / 3600 / cosine, air)
    a3 = rotation.about_axis(2, np.radians(95.0)) @ rotation.from_vector([0.003, -0.004, 0.0])
    rows = ["utc_unix_s,theta_x_deg,theta_y_deg"]
    for k in range(8):
        level = rotation.from_vector([*rng.normal(0, 20, 2) * ARCSEC, 0.0])
        sensor = level @ rotation.about_axis(2, np.radians(90.0 * (k // 2) + 3))
        at = BEGIN + 40.0 * k
        # readings in units of 1e-7 deg, with a little noise
        theta = np.degrees(np.arcsin(sensor[:2, 2])) + rng.normal(0, 3e-6, (5, 2))
        rows += [f"{at - 0.2 + 0.1 * j:.3f},{x:.7f},{y:.7f}" for j, (x, y) in enumerate(theta)]
        _list(folder / f"stars_{k}.csv", catalogue, site, at, a3.T @ sensor)
    (folder / "tilt.csv").write_text("\n".join(rows) + "\n")
    (folder / "instrument.yaml").write_text(INSTRUMENT)
    return folder


def _list(path, catalogue, site, at, axes):
    """Write the stars that a camera with these axes (rows, in east, north, up) sees."""
    state = earth_state(at)
    index = site.overhead(catalogue, state, axes[2], CAMERA.half_diagonal_rad, 7.5)
    xy = CAMERA.project(site.observed(catalogue, index, state) @ axes.T)
    on = ((xy > 2) & (xy < [997, 697])).all(1)
    flux = 10 ** (-0.4 * (catalogue.vmag(index) - 14))
    head = {"DATE-OBS": utc_text(at - 0.25).rstrip("Z"), "EXPTIME": 0.5, "NAXIS1": 1000, "NAXIS2": 700}
    stars = np.column_stack([xy, flux, np.full(len(flux), 0.01)])[on]
    text = "\n".join(",".join(f"{v:.5f}" for v in star) for star in stars)
    path.write_text(f"# {json.dumps(head)}\nx,y,flux,sigma\n{text}\n")


def arguments(folder, latitude=LATITUDE, frames="stars_*.csv"):
    site = (latitude, LONGITUDE, HEIGHT_M)
    air = ("--pressure-hpa", 900, "--temperature-c", 5, "--humidity", 0.3)
    paths = sorted(folder.glob(frames))
    return ("deflection", *paths, "--tilt", folder / "tilt.csv", "--site", *site, "--instrument",
            folder / "instrument.yaml", *air)  # fmt: skip


def test_the_deflection_of_four_faces(run, session):
    status, out, err = run(*arguments(session), "--json")
    *frames, whole = objects(out)
    assert status == 0 and whole["combined"] and whole["faces"] == 4 and whole["frames"] == len(frames) == 8
    found, sigma = [whole["xi_arcsec"], whole["eta_arcsec"]], whole["sigma_xi_arcsec"]
    assert found == pytest.approx([XI, ETA], abs=0.004) and sigma < 0.2
    assert any("high mountains" in line for line in err)
    # 0.171 arcsec sin(2 phi) a kilometre (Heiskanen and Moritz 1967, section 5-6)
    fallen = whole["reduced"]["mark_arcsec"][0] - whole["reduced"]["geoid_arcsec"][0]
    assert fallen == pytest.approx(0.171 * np.sin(2 * np.radians(LATITUDE)) * 0.9, rel=0.01)
    assert sum(v[0] ** 2 for v in whole["errors"].values()) == pytest.approx(sigma**2, rel=1e-6)


def test_each_face_and_star_has_its_residuals(run, session):
    _, out, _ = run(*arguments(session), "--json", "--station", "Pillar 1")
    whole = objects(out)[-1]
    assert whole["station"] == "Pillar 1" and whole["site"]["height_m"] == HEIGHT_M
    assert [face["frames"] for face in whole["by_face"]] == [2] * 4
    assert all(face["chi2"] < 20 for face in whole["by_face"])
    lever = [np.hypot(*star["leverage_arcsec"]) for star in whole["by_star"]]
    assert lever == sorted(lever, reverse=True) and lever[0] > 0
    assert whole["stars"] >= len(lever) and all(1 <= star["frames"] <= 8 for star in whole["by_star"])
    assert whole["by_star"][0]["star"].startswith(("HIP ", "TYC "))


@pytest.fixture(scope="module")
def recorded(session, tmp_path_factory):
    """Record the same session in a bag."""
    pytest.importorskip("rosbags")
    from starpos_testing.skies.bags import NightBag

    path = tmp_path_factory.mktemp("recorded") / "bag"
    with NightBag(path) as bag:
        bag.camera(CAMERA.fx, CAMERA.width, CAMERA.height)
        for name in sorted(session.glob("stars_*.csv")):
            bag.stars(read_frame(name))
        bag.tilts(read_tilt_csv(session / "tilt.csv"))
    return path


def test_a_bag_gives_what_its_files_give(run, session, recorded):
    _, out, _ = run(*arguments(session), "--json")
    options = arguments(session)[11:]
    status, of_bag, err = run("deflection", recorded, *options, "--json")
    files, bag = objects(out)[-1], objects(of_bag)[-1]
    assert status == 0 and bag["frames"] == 8
    # messages have the times of tilts in microseconds
    for key in ("xi_arcsec", "eta_arcsec", "sigma_xi_arcsec", "sigma_eta_arcsec"):
        assert bag[key] == pytest.approx(files[key], abs=2e-3)
    status, _, err = run("deflection", recorded, *options, "--tilt", session / "tilt.csv")
    assert status == 2 and "has its own tilts" in err[-1]


def played(recorded, session, wanted):
    """Play the frames to the solver's session, which has the node's service and light say what it says."""
    values = {
        "deflection.wanted": wanted,
        "site.latitude": LATITUDE,
        "site.longitude": LONGITUDE,
        "site.geodetic": "true",
        "altitude": HEIGHT_M,
        "calibration_url": session / "instrument.yaml",
        "refraction.pressure": 90000.0,
        "refraction.temperature": 5.0,
        "refraction.humidity": 0.3,
    }
    replay = Replay(Settings.of(None, [f"{k}:={v}" for k, v in values.items()]), Silent(), Silent())
    assert len(list(replay.play(recorded))) >= 8
    return replay.session.deflection


class Silent:
    """Hears and logs nothing."""

    def __getattr__(self, name):
        return lambda *said: None


def test_live_the_session_says_when_enough_is_enough(run, session, recorded):
    live = played(recorded, session, 1.0)
    told = live.report()
    whole = objects(run("deflection", recorded, *arguments(session)[11:], "--json")[1])[-1]
    assert told.level == Level.OK and told.message.startswith("enough; xi ")
    assert told.values["xi arcsec"] == pytest.approx(whole["xi_arcsec"], abs=2e-3)
    assert told.values["sigma eta arcsec"] == pytest.approx(whole["sigma_eta_arcsec"], rel=0.02)
    assert told.values["frames"] == 8 and told.values["enough"]
    live.forget()
    assert live.report().message.startswith("0 frames so far")


def test_live_a_session_that_lacks_something_says_what(session, recorded):
    told = played(recorded, session, 0.005).report()
    assert told.level == Level.WARN and not told.values["enough"]
    assert re.match(
        r"not enough: (about \d+ min more|more frames do not help, [a-z0-9 ]+ alone leaves)", told.message
    )
    with pytest.raises(InstrumentError, match=r"set site\.latitude"):
        Settings.of(None, ["deflection.wanted:=0.1"])


def test_a_plan_needs_no_frames(run, session):
    site = ("--site", LATITUDE, LONGITUDE, HEIGHT_M, "--instrument", session / "instrument.yaml")
    status, out, _ = run(
        "deflection", "--plan", 0.5, *site, "--size", 1000, 700, "--limit-mag", 7.5, "--json"
    )
    (plan,) = objects(out)
    assert (
        status == 0 and plan["faces"] == 4 and max(plan["sigma_xi_arcsec"], plan["sigma_eta_arcsec"]) <= 0.5
    )
    status, out, _ = run("deflection", "--plan", 0.5, *site, "--size", 1000, 700, "--limit-mag", 7.5)
    assert status == 0 and "4 faces" in out and "largest errors" in out
    status, _, err = run("deflection", *site)
    assert status == 2 and "--plan SIGMA" in err[0]


def test_its_lines_for_people_and_its_table(run, session):
    status, out, _ = run(*arguments(session))
    assert status == 0 and "arcsec at the mark, of 8 frames in 4 faces" in out and "at the geoid" in out
    status, out, _ = run(*arguments(session), "--csv")
    head, *rows = out.splitlines()
    assert status == 0 and head.startswith("file,combined,status") and len(rows) == 9


def test_one_face_and_a_site_far_away_have_no_deflection(run, session):
    status, _, err = run(*arguments(session, frames="stars_[01].csv"), "--json")
    assert status == 1 and any("at least 3" in line for line in err)
    status, _, err = run(*arguments(session, latitude=LATITUDE + 0.1))
    assert status == 1 and any("no place of the Earth" in line and "km off" in line for line in err)


def test_a_site_that_is_none_is_a_bad_call(run, session):
    status, _, err = run(*arguments(session, latitude=95))
    assert status == 2 and "--site" in err[0]

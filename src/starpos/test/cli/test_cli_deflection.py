# SPDX-License-Identifier: Apache-2.0
"""`starpos deflection`, on lists of the stars above a place whose plumb line differs from the ellipsoid's normal."""

import re

import numpy as np
import pytest
from cli_calls import objects

from starpos.errors import InstrumentError
from starpos.frames.reading import read_frame
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.session.driver import Level
from starpos.session.replay import Replay
from starpos.session.settings import Settings
from starpos_testing.skies.folders import (
    ETA,
    HEIGHT_M,
    LATITUDE,
    LONGITUDE,
    XI,
    ZENITH_CAMERA,
    write_zenith_session,
)


@pytest.fixture(scope="module")
def session(tmp_path_factory, catalogue):
    """Four faces of two star lists each, their tilts and the instrument's file."""
    folder = tmp_path_factory.mktemp("zenith")
    write_zenith_session(folder, catalogue)
    return folder


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


def test_each_face_has_its_residuals(run, session):
    _, out, _ = run(*arguments(session), "--json", "--station", "Pillar 1")
    whole = objects(out)[-1]
    assert whole["station"] == "Pillar 1" and whole["site"]["height_m"] == HEIGHT_M
    assert [face["frames"] for face in whole["by_face"]] == [2] * 4
    assert all(face["chi2"] < 20 for face in whole["by_face"])
    assert whole["stars"] > 8


@pytest.fixture(scope="module")
def recorded(session, tmp_path_factory):
    """Record the same session in a bag."""
    pytest.importorskip("rosbags")
    from starpos_testing.skies.bags import NightBag

    path = tmp_path_factory.mktemp("recorded") / "bag"
    with NightBag(path) as bag:
        bag.camera(ZENITH_CAMERA.fx, ZENITH_CAMERA.width, ZENITH_CAMERA.height)
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
    replay = Replay(Settings.of(None, [f"{k}:={v}" for k, v in values.items()]), Silent())
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

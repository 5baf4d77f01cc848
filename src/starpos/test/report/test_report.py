# SPDX-License-Identifier: Apache-2.0
"""`starpos report` on folders: the numbers of `starpos solve`, a page that needs nothing else, failures that say why."""

import io
import json
import re
import shutil
import sys
from contextlib import redirect_stdout

import numpy as np
import pytest

from starpos import open_night
from starpos.cli import main
from starpos.earth.refraction import Atmosphere
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos.night import opening
from starpos.report import measures
from starpos.report.night_figures import draw_budget, draw_scatter
from starpos.report.page import nights_picture
from starpos_testing.skies.reports import AIR, KNOWN, PLACE, Page, assert_drawn, run, simulate, solved

pytest.importorskip("matplotlib")
KNOWN_A3 = Calibration.of((0.0, 0.0, 0.0), (5.0,) * 3)


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """Twelve frames of a camera that stands still."""
    return simulate(tmp_path_factory.mktemp("still") / "a still night", "--cadence", 30, frames=12)


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """Four frames at several headings, A3 off by half a degree."""
    misaligned = ("--turn", 80, "--misalignment", 0.5, -0.3, 0.2)
    return simulate(tmp_path_factory.mktemp("turned") / "turned", *misaligned, frames=4)


def settings_of_matplotlib():
    import matplotlib

    # A look at that one sets it.
    return {k: v for k, v in matplotlib.rcParams.items() if k != "backend"}


@pytest.fixture(scope="module")
def touched():
    """Changes in matplotlib by the report of `drawn`, by name."""
    return {}


@pytest.fixture(scope="module")
def drawn(still, touched, tmp_path_factory):
    """The folder of the still night's report."""
    out = tmp_path_factory.mktemp("drawn") / "out"
    before, pyplot = settings_of_matplotlib(), sys.modules.pop("matplotlib.pyplot", None)
    with redirect_stdout(io.StringIO()):
        assert main(["report", *map(str, (still, "-o", out, *KNOWN, *AIR))]) == 0
    touched["pyplot"] = "matplotlib.pyplot" in sys.modules
    touched["settings"] = settings_of_matplotlib() != before
    if pyplot:
        sys.modules["matplotlib.pyplot"] = pyplot
    return out


def report(capsys, night, out, *more):
    nights = night if isinstance(night, list) else [night]
    status, said, errors = run(capsys, "report", *nights, "-o", out, *KNOWN, *AIR, *more)
    return status, (Page(out / "index.html") if said else None), errors


def worked(folder, calibration=KNOWN_A3):
    instrument = Instrument(29.67e3 / 6.4, calibration=calibration, inclinometer=SCA100T_CALIBRATED)
    air = Atmosphere(pressure_pa=100000.0, temperature_c=5.0, humidity=0.3)
    return open_night(folder, instrument=instrument, atmosphere=air).solve()


def numbers_after(page, text):
    found = re.search(re.escape(text) + r"(.{0,160})", page.text, re.S)
    return [float(n) for n in re.findall(r"[+-]?\d+\.?\d*", found.group(1))]


@pytest.mark.usefixtures("unpainted")
def test_the_page_says_what_solve_says(still, tmp_path, capsys):
    status, page, errors = report(capsys, still, tmp_path / "out")
    want = solved(capsys, still, *KNOWN, *AIR)
    assert (status, errors) == (0, [])
    place = f"{want['latitude']:+.6f}°, {want['longitude']:+.6f}° ± {want['sigma_north_m']:.0f} m N"
    assert place in page.text
    turn = np.sqrt(want["covariance_geodetic"][2][2])
    assert f"heading {want['heading']:.4f} ± {turn:.4f}°" in page.text
    ground = f"{want['latitude_geodetic']:+.6f}°, {want['longitude_geodetic']:+.6f}°"
    assert ground in page.text
    assert "12: 12 with a fix" in page.text and "stars_0011.csv" in page.text
    east = (want["longitude"] - PLACE["longitude"]) * 111320 * np.cos(np.radians(PLACE["latitude"]))
    north = (want["latitude"] - PLACE["latitude"]) * 111195
    assert numbers_after(page, "Error against the truth")[0] == pytest.approx(np.hypot(east, north), rel=0.02)


def test_the_page_needs_nothing_else(drawn):
    page = Page(drawn / "index.html")
    assert page.references and all(
        r.startswith(("data:image/png;base64,", "#", "geo:")) for r in page.references
    )
    assert not page.tags & {"script", "link", "iframe", "object", "form"}
    assert not re.search(r"https?:|url\(|@import", page.source)


def test_the_place_on_maps_comes_first_and_a_simulated_night_is_called_that(drawn, still, tmp_path):
    page = Page(drawn / "index.html")
    assert page.text.index("(WGS 84, as on maps)") < page.text.index("By the plumb line (astronomic)")
    (link,) = [r for r in page.references if r.startswith("geo:")]
    assert abs(float(link[4:].split(",")[0]) - PLACE["latitude"]) < 0.1
    assert "Simulated: no camera took these frames." in page.text
    assert page.text.count("Simulated. ") == len(page.pictures) == 8
    truth = json.loads((still / "truth.json").read_text())
    assert opening.truth_in(still).simulated
    (tmp_path / "truth.json").write_text(
        json.dumps({k: v for k, v in truth.items() if k != "simulated_files"})
    )
    assert not opening.truth_in(tmp_path).simulated


def test_pictures_are_drawn_and_lie_beside_the_page(drawn):
    page = Page(drawn / "index.html")
    names = {p.stem for p in drawn.glob("*.png")}
    assert names == {"map", "stability", "frames", "scatter", "budget", "residuals", "sky", "health"}
    files = {(drawn / f"{n}.png").read_bytes() for n in names}
    assert files == set(page.pictures.values())
    for png in files:
        assert_drawn(png)


def test_one_tilt_for_all_takes_the_inclinometers_noise_away(still, catalogue):
    night = worked(still)
    tilts = np.array([s.tilt for _, s in night.fixed])
    own, steady = measures.stability(night).arcsec, measures.steadiness(night, night.steady).arcsec
    # what the tilts did to latitude and longitude is what was taken away, and it is all there is between the two
    design = np.column_stack([tilts - tilts.mean(0), np.ones(len(tilts))])
    for axis in range(2):
        rest = own[:, axis] - steady[:, axis]
        told = design @ np.linalg.lstsq(design, rest, rcond=None)[0]
        assert np.abs(rest - told).max() < 0.02 * np.abs(rest).max()
    assert np.abs(own).max() > 3.0


@pytest.mark.usefixtures("unpainted")
@pytest.mark.parametrize("sigma_deg, unit", [(0.001, "m"), (10.0, "km")])
def test_a_scatter_of_many_kilometres_is_told_in_them(sigma_deg, unit, still, catalogue):
    from matplotlib.figure import Figure

    calibration = Calibration.of((0.0, 0.0, 0.0), (3600 * sigma_deg,) * 3)
    night = worked(still, calibration)
    figure = Figure()
    draw_scatter(figure, night)
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == (f"east, {unit}", f"north, {unit}")


def test_the_budget_has_the_sources_that_only_the_average_has(still):
    from matplotlib.figure import Figure

    night, figure = worked(still, KNOWN_A3), Figure()
    assert "tilt drift" not in {t.name for t in night.places[0].terms if t.covariance.any()}
    draw_budget(figure, night)
    assert "tilt drift" in {label.get_text() for label in figure.axes[0].get_yticklabels()}


@pytest.mark.usefixtures("unpainted")
def test_a_turned_night_has_no_mean_heading_but_that_of_the_truth(turned, tmp_path, capsys):
    misalignment = ("--misalignment", 0.5, -0.3, 0.2)
    status, page, _ = report(capsys, turned, tmp_path / "out", *misalignment)
    assert status == 0
    assert "Stability: one tilt" not in page.text
    assert "last heading" in page.text


@pytest.mark.usefixtures("unpainted")
def test_self_calibration_is_said(turned, tmp_path, capsys):
    status, page, errors = report(capsys, turned, tmp_path / "out", "--self-calibrate")
    want = solved(capsys, turned, *KNOWN, *AIR, "--self-calibrate")
    assert status == 0
    assert "calibrated: the plumb line in the camera is known to" in page.text
    assert any("calibrated: " in line for line in errors)
    assert f"{want['latitude']:+.6f}°, {want['longitude']:+.6f}°" in page.text


def test_the_errors_of_several_nights_are_drawn(still, catalogue):
    night = worked(still)
    assert_drawn(nights_picture([(1, night), (2, night)]).png)


@pytest.mark.usefixtures("unpainted")
def test_several_nights_are_held_against_their_truths(still, tmp_path, capsys):
    other = simulate(tmp_path / "other", "--seed", 5, place={"latitude": -33.9, "longitude": 18.4}, frames=2)
    status, page, errors = report(capsys, [still, other], tmp_path / "out")
    assert (status, errors) == (0, [])
    assert "2 nights" in page.text and "Error of the nights" in page.pictures
    assert {"night1-scatter.png", "night2-scatter.png", "nights.png"} <= {
        p.name for p in (tmp_path / "out").iterdir()
    }
    for night in (still, other):
        want = solved(capsys, night, *KNOWN, *AIR)
        assert f"{want['latitude']:+.6f}°, {want['longitude']:+.6f}°" in page.text


@pytest.mark.usefixtures("unpainted")
def test_names_from_files_are_text_only(still, tmp_path, capsys):
    evil = tmp_path / '<img src=x onerror="alert(1)"> & <b>'
    shutil.copytree(still, evil)
    (evil / "stars_0000.csv").rename(evil / "stars_<i>&quot;.csv")
    (evil / "a<u>.csv").write_text("no stars <em>at all</em>\n")
    status, page, _ = report(capsys, evil, tmp_path / "out")
    assert status == 0
    assert not page.tags & {"b", "i", "u", "em"}
    assert '<img src=x onerror="alert(1)"> & <b>' in page.text and "stars_<i>&quot;.csv" in page.text
    assert all(r.startswith(("data:image/png", "geo:")) for r in page.references)


def test_without_tilts_the_page_says_so_and_there_is_no_fix(still, tmp_path, capsys):
    night = tmp_path / "night"
    shutil.copytree(still, night)
    (night / "tilt.csv").unlink()
    status, page, errors = report(capsys, night, tmp_path / "out")
    assert status == 1
    assert "No position: none of its 12 frames gave a fix" in page.text
    assert "12 no tilt" in page.text and "tilt.csv: there is no such file" in page.text
    assert len(errors) == 1 and "tilt.csv" in errors[0]
    assert list(page.pictures) == ["Frame by frame"]
    assert_drawn(page.pictures["Frame by frame"])


@pytest.mark.usefixtures("unpainted")
def test_one_frame_is_a_night(still, tmp_path, capsys):
    night = tmp_path / "night"
    night.mkdir()
    for name in ("stars_0003.csv", "tilt.csv"):
        shutil.copy(still / name, night)
    status, page, errors = report(capsys, night, tmp_path / "out")
    assert (status, errors) == (0, [])
    assert "Error against the truth" not in page.text
    assert {"Scatter of the fixes", "Error budget", "Residuals over the frame"} <= set(page.pictures)


@pytest.mark.usefixtures("unpainted")
def test_frames_that_fail_are_counted_with_their_reason(still, tmp_path, capsys):
    night = tmp_path / "night"
    shutil.copytree(still, night)
    head = (night / "stars_0002.csv").read_text().splitlines()[:2]
    (night / "stars_0002.csv").write_text("\n".join(head) + "\n")
    (night / "stars_0005.csv").write_text("nothing\n")
    (night / "stars_0007.csv").write_text(
        (night / "stars_0007.csv").read_text().replace('"DATE-OBS"', '"DATE-NONE"')
    )
    status, page, _ = report(capsys, night, tmp_path / "out")
    assert status == 0
    assert "12: 9 with a fix, 2 bad input, 1 too few stars" in page.text
    assert "Frame by frame" in page.pictures


@pytest.mark.parametrize("kind", ["nothing", "empty", "file", "truth"])
def test_what_is_no_night_is_refused_in_one_line(kind, still, tmp_path, capsys):
    night = tmp_path / "night"
    if kind == "empty":
        night.mkdir()
    elif kind == "file":
        night.write_text("no night")
    elif kind == "truth":
        shutil.copytree(still, night)
        (night / "truth.json").write_text(json.dumps({"latitude_deg": "north", "longitude_deg": None}))
    status, page, errors = report(capsys, night, tmp_path / "out")
    assert (status, page, len(errors)) == (2, None, 1)
    assert str(night) in errors[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("unpainted")
def test_a_file_of_somebody_else_is_not_overwritten(still, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "index.html").write_text("<h1>mine</h1>")
    status, _, errors = report(capsys, still, out)
    assert (status, len(errors)) == (2, 1)
    assert [p.name for p in out.iterdir()] == ["index.html"]
    assert (out / "index.html").read_text() == "<h1>mine</h1>"


@pytest.mark.usefixtures("unpainted")
def test_its_own_report_is_overwritten_whole(drawn, turned, tmp_path, capsys):
    out = shutil.copytree(drawn, tmp_path / "out")
    first = (out / "scatter.png").read_bytes()
    status, page, _ = report(capsys, turned, out, "--misalignment", 0.5, -0.3, 0.2)
    assert status == 0 and "turned" in page.text
    assert (out / "scatter.png").read_bytes() != first
    assert not [p for p in out.iterdir() if p.name.startswith(".")]


@pytest.mark.usefixtures("unpainted")
def test_where_nothing_can_be_written_one_line_says_so(still, tmp_path, capsys):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, no folder")
    status, _, errors = run(capsys, "report", still, "-o", blocked / "out", *KNOWN, *AIR)
    assert (status, len(errors)) == (2, 1)
    assert "cannot be written" in errors[0]


def test_without_matplotlib_the_pip_line_is_said(still, tmp_path, capsys, monkeypatch):
    from starpos.cli import report as command

    monkeypatch.setattr(command, "find_spec", lambda name: None)
    status, _, errors = report(capsys, still, tmp_path / "out")
    assert (status, len(errors)) == (2, 1)
    assert "pip install matplotlib rosbags" in errors[0]


@pytest.mark.usefixtures("drawn")
def test_a_report_leaves_matplotlib_as_it_was(touched):
    assert touched == {"pyplot": False, "settings": False}

# SPDX-License-Identifier: Apache-2.0
"""The commands of the README, of the tutorials and of the how-tos, typed one after another, do what their pages say.

Some seconds of CPU: two nights of ten frames, which are the first that a newcomer sees, and smaller ones.
"""

import doctest
import json
import re

import pytest
import yaml
from test_documented_commands import shown, words
from test_documents import ROOT

from starpos_testing.command_line import run

# frames are written as lists of their stars, which is quick and gives the same answers to some metres
LISTS = ("--stars-only", "--focal-mm", "600", "--pixel-um", "6.4")
# photos that are identified with no option, a painted report and the demo have tests of their own
ELSEWHERE = re.compile("starpos (?:identify photo|report|doctor|demo)")


def typed(page, folder, monkeypatch, capsys) -> dict[str, str]:
    """What each command of a page prints, typed in an empty folder."""
    monkeypatch.chdir(folder)
    said = {}
    for line in shown(ROOT / page):
        if not line.startswith("starpos ") or ELSEWHERE.match(line):
            continue
        _, command, *rest = expanded(words(line), folder)
        lists = {"simulate": LISTS[:1], "solve": LISTS[1:]}.get(command, ())
        more = [] if {*lists, "--instrument"} & set(rest) else lists
        status, out, errors = run(capsys, command, *rest, *more)
        assert status == 0, (line, errors)
        said[line] = out
    return said


def expanded(line: list[str], folder) -> list[str]:
    """The words of a line, as a shell makes them where there are lists instead of frames."""
    found = ([str(f) for f in sorted(folder.glob(w.replace("*.fits", "stars_*.csv")))] for w in line)
    return [
        name for word, names in zip(line, found, strict=True) for name in (names if "*" in word else [word])
    ]


def test_the_readmes_commands_make_a_night_and_its_place(tmp_path, monkeypatch, capsys):
    *_, solved = typed("README.md", tmp_path, monkeypatch, capsys).values()
    assert "night: 10 frames together: +35.70" in solved


def test_the_disks_commands_print_what_the_page_says(tmp_path, monkeypatch, capsys):
    said = typed("docs/tutorials/disk.md", tmp_path, monkeypatch, capsys)
    page = (ROOT / "docs" / "tutorials" / "disk.md").read_text()
    [turned] = re.findall(r"^    (turn: 12 frames together: .*)$", page, re.MULTILINE)
    assert any(turned in out.splitlines() for out in said.values())
    assert (tmp_path / "instrument.yaml").is_file()
    # of frames instead of lists the last digits are others
    [night] = re.findall(r"^    (night: 10 frames together: .*)$", page, re.MULTILINE)
    assert any(numbers(line) == pytest.approx(numbers(night), rel=0.05) for line in lines(said))


def test_a3_is_found_by_the_commands_that_say_how(tmp_path, monkeypatch, capsys):
    mounted = ("--misalignment", "0.9", "-0.5", "20", *LISTS[:1])
    for folder, more in {
        "known": ("-n", "2"),
        "night": ("-n", "2"),
        "turn": ("-n", "4", "--turn", "90"),
    }.items():
        assert run(capsys, "simulate", tmp_path / folder, *more, *mounted)[0] == 0
    said = typed("docs/how-to/calibrate.md", tmp_path, monkeypatch, capsys)
    [night] = [out for line, out in said.items() if line.startswith("starpos solve night")]
    [where] = [line for line in night.splitlines() if "2 frames together" in line]
    assert numbers(where)[1:3] == pytest.approx([35.7046, 51.4106], abs=0.005)
    assert {f.name for f in tmp_path.glob("*.yaml")} == {"instrument.yaml", "pillar.yaml"}


def test_the_camera_is_calibrated_by_the_command_that_says_how(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    assert run(capsys, "simulate", tmp_path / "night", "-n", "6", "--turn", "60", *LISTS[:1])[0] == 0
    typed("docs/how-to/calibrate_camera.md", tmp_path, monkeypatch, capsys)
    camera = yaml.safe_load((tmp_path / "camera.yaml").read_text())
    assert camera["camera_matrix"]["data"][0] == pytest.approx(600 / 0.0064, rel=1e-4)
    assert (tmp_path / "camera.png").read_bytes().startswith(b"\x89PNG")


def test_the_hobbyists_commands_print_the_places_of_the_page(tmp_path, monkeypatch, capsys):
    said = typed("docs/tutorials/hobby.md", tmp_path, monkeypatch, capsys)
    page = (ROOT / "docs" / "tutorials" / "hobby.md").read_text()
    printed = [line for out in said.values() for line in out.splitlines() if " frames together: " in line]
    expected = re.findall(r"^    (\d+ frames together: .*)$", page, re.MULTILINE)
    assert len(printed) == len(expected) == 2
    for told, line in zip(expected, printed, strict=True):
        assert numbers(line) == pytest.approx(numbers(told), rel=0.05)


def test_another_solvers_pointings_make_a_place_by_the_command_that_says_how(tmp_path, monkeypatch, capsys):
    assert run(capsys, "simulate", tmp_path / "night", "-n", "3", *LISTS[:1])[0] == 0
    frames = json.loads((tmp_path / "night" / "truth.json").read_text())["frames"]
    _, out, _ = run(capsys, "identify", "--json", *sorted((tmp_path / "night").glob("stars_*")), *LISTS[1:])
    pointings = [json.loads(line) for line in out.splitlines()]
    page = (ROOT / "docs" / "how-to" / "pointings.md").read_text()
    [head] = re.findall(r"^    (utc_unix_s,ra_deg,.*)$", page, re.MULTILINE)
    rows = [
        f"{frame['mid_unix_s']},{p['ra']},{p['dec']},{p['roll']},1.5,20"
        for frame, p in zip(frames, pointings, strict=True)
    ]
    (tmp_path / "table.csv").write_text("\n".join([head, *rows]) + "\n")
    known = "camera: {focal_mm: 600, pixel_um: 6.4}\nmisalignment_deg: [0, 0, 0]"
    known += "\ncalibration_stddev_arcsec: [5, 5, 20]\ninclinometer: {model: sca100t_calibrated}"
    known = f"starpos_instrument: 1\n{known}\n"
    (tmp_path / "instrument.yaml").write_text(known)
    [solved] = typed("docs/how-to/pointings.md", tmp_path, monkeypatch, capsys).values()
    [night] = [line for line in solved.splitlines() if "3 frames together" in line]
    assert numbers(night)[1:3] == pytest.approx([35.7046, 51.4106], abs=0.005)


def test_an_archives_nights_have_a_place_each_by_the_command_that_says_how(tmp_path, monkeypatch, capsys):
    (tmp_path / "archive").mkdir()
    for night, latitude in (("first", 35.0), ("second", -20.0)):
        where = ("--latitude", latitude, "--misalignment", "0", "0", "0")
        assert run(capsys, "simulate", tmp_path / "archive" / night, "-n", "2", *where, *LISTS[:1])[0] == 0
    said = typed("docs/how-to/many_nights.md", tmp_path, monkeypatch, capsys)
    [solved] = [out for line, out in said.items() if line.startswith("starpos solve archive/*")]
    places = [numbers(told)[0] for told in re.findall("2 frames together: (.*)", solved)]
    assert places == pytest.approx([35.0, -20.0], abs=0.1)


def test_the_surveyors_commands_print_the_heading_that_the_page_says(tmp_path, monkeypatch, capsys):
    said = typed("docs/tutorials/azimuth.md", tmp_path, monkeypatch, capsys)
    page = (ROOT / "docs" / "tutorials" / "azimuth.md").read_text()
    [shown_line] = re.findall(r"^    3 frames together: (.*)$", page, re.MULTILINE)
    *_, told = [line for out in said.values() for line in out.splitlines() if "frames together: " in line]
    assert (
        doctest.testfile(str(ROOT / "docs" / "tutorials" / "azimuth.md"), module_relative=False).failed == 0
    )
    # of lists instead of frames the last digits are others
    assert numbers(told)[1:] == pytest.approx(numbers(shown_line), abs=0.002)


def lines(said: dict[str, str]) -> list[str]:
    return [line for out in said.values() for line in out.splitlines() if line.startswith("night: ")]


def numbers(line: str) -> list[float]:
    return [float(n) for n in re.findall(r"[-+]?\d+(?:\.\d+)?", line)]


def test_the_methods_commands_give_the_numbers_it_begins_with(tmp_path, monkeypatch, capsys):
    said = typed("docs/tutorials/method.md", tmp_path, monkeypatch, capsys)
    page = (ROOT / "docs" / "tutorials" / "method.md").read_text()
    [pointing] = [json.loads(out) for out in said.values() if out.startswith("{")]
    told = f"{pointing['ra']:.6f}, {pointing['dec']:.6f}, {pointing['roll']:.6f}"
    assert f"ra, dec, top = {told}" in page
    assert f"{pointing['stars_matched']} of {pointing['stars_detected']} stars" in page
    _, reading, *_ = (tmp_path / "one" / "tilt.csv").read_text().splitlines()
    assert all(f"radians({angle})" in page for angle in reading.split(",")[1:3])


def test_the_error_budgets_page_explains_every_term_of_a_fix(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(capsys, "simulate", "night", "-n", "2", "--stars-only")[0] == 0
    night = [
        *sorted(map(str, (tmp_path / "night").glob("stars_*"))),
        "--focal-mm",
        "600",
        "--pixel-um",
        "6.4",
        "--json",
    ]
    known = ("--misalignment", "0", "0", "0", "--misalignment-stddev", "5", "--tilt", "night/tilt.csv")
    _, fixed, _ = run(capsys, "solve", *night, *known)
    _, faced, _ = run(capsys, "solve", *night, "--site", "35.7046", "51.4106")
    page = (ROOT / "docs" / "error_budget.md").read_text()
    explained, more = (
        re.findall(r"^\| `([^`]+)` \|", t, re.MULTILINE) for t in page.split("Some inputs add terms", 1)
    )
    assert list(json.loads(fixed.splitlines()[-1])["budget"]) == explained
    assert set(json.loads(faced.splitlines()[-1])["budget"]) <= {*explained, *more}
    sources = "".join(f.read_text() for f in (ROOT / "src" / "starpos" / "starpos").rglob("*.py"))
    named = set(re.findall(r'(?:ErrorTerm|mount_term)\(\s*"([^"]+)"', sources))
    assert {"mount", "pointing", "turn"} < named and named <= {*explained, *more}

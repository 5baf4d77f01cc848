# SPDX-License-Identifier: Apache-2.0
"""The package's one door: its public names, each imported when it is first asked for."""

import ast
import doctest
import inspect
import re
import subprocess
import sys
from enum import Enum
from pathlib import Path

import numpy as np
import pytest

import starpos
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos_testing.skies import sightings
from starpos_testing.skies.folders import write_drive, write_zenith_session
from starpos_testing.voyages import made

SOURCE = Path(starpos.__file__)
README = SOURCE.resolve().parents[1] / "README.md"


def said(program: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("name", starpos.__all__)
def test_a_public_name_is_there_and_documented(name):
    assert getattr(starpos, name).__doc__
    assert name in dir(starpos)


def test_what_is_no_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = starpos.nothing


def test_type_checkers_are_told_the_same():
    """The door reads the stub by its lines; this reads it as Python."""
    body = ast.parse(SOURCE.with_suffix(".pyi").read_text()).body
    told = [a.name for n in body if isinstance(n, ast.ImportFrom) for a in n.names]
    told += [n.targets[0].id for n in body if isinstance(n, ast.Assign)]
    assert sorted(told) == sorted(starpos.__all__) and len(told) > 45


def test_the_door_itself_imports_nothing_heavy():
    heavy = "[m for m in ('numpy', 'scipy', 'astropy', 'erfa', 'cv2', 'yaml') if m in sys.modules]"
    assert said(f"import sys, starpos; print({heavy})") == "[]"
    assert said(f"import sys, starpos; starpos.StarposError; print({heavy})") == "[]"


def simulated(folder, *options):
    """A night with smaller frames than `starpos simulate night` writes."""
    from starpos.cli import main

    wide = ["--focal-mm", "29.67", "--pixel-um", "6.4", "--size", "1000", "700"]
    assert main(["simulate", str(folder), *wide, *options]) == 0
    return folder


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """The night that the examples work on."""
    return simulated(tmp_path_factory.mktemp("door") / "night")


def test_the_readmes_examples_solve_a_night(night, monkeypatch, capsys):
    monkeypatch.chdir(night.parent)
    examples = "\n".join(re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL))
    exec(examples.replace("600e3 / 6.4", "29.67e3 / 6.4"), {})
    said = capsys.readouterr().out
    assert said.startswith("<night: 5 of 5 frames fixed; +35.70") and said.count("\n<frame_") == 5
    assert "<Fix: +35.70" in said


def test_the_doors_own_example_is_what_comes_of_it(night, monkeypatch):
    monkeypatch.chdir(night.parent)
    told = doctest.DocTestParser().get_doctest(starpos.__doc__, {}, "starpos", str(SOURCE), 0)
    lines = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(told, out=lines.append)
    assert told.examples and runner.failures == 0, "".join(lines)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory, catalogue):
    """A folder with all files that the examples of the public names read."""
    from starpos.cli import main

    folder = tmp_path_factory.mktemp("workplace")
    simulated(folder / "night", "--stars-only", "-n", "5")
    simulated(folder / "turn", "--stars-only", "-n", "8", "--turn", "45")
    known = starpos.Calibration.of((0, 0, 0), (5, 5, 5))
    instrument = starpos.Instrument(4635.9375, calibration=known, inclinometer=SCA100T_CALIBRATED)
    starpos.write_instrument(folder / "instrument.yaml", instrument)
    told = ["--field", str(folder / "night.zip"), "--instrument", str(folder / "instrument.yaml")]
    assert main(["report", str(folder / "night"), *told]) == 0
    for name in ("drive", "zenith"):
        (folder / name).mkdir()
    write_drive(folder / "drive", catalogue, made("rover", 40, 2, cadence_s=4.0))
    write_zenith_session(folder / "zenith", catalogue)
    satellites, elements = sightings.drawn(900, 7)
    (folder / "active.tle").write_text(elements)
    trails, _ = sightings.table(satellites, (47.0, 8.0, 900.0), np.random.default_rng(5), count=8)
    (folder / "sightings.csv").write_text(trails)
    chicago = "sun,2024-05-05T15:55:18,55.13364\nsun,2024-05-05T23:01:19,19.47194\nvega,2024-05-06T04:04:13,30.27325\n"
    (folder / "sights.csv").write_text(f"body,utc,altitude_deg\n{chicago}")
    rows = "".join(f"{1.8e9 + k},35.7046,51.4106,2.0,2.0\n" for k in range(3))
    (folder / "gnss.csv").write_text("utc_unix_s,latitude,longitude,sigma_east_m,sigma_north_m\n" + rows)
    return folder


@pytest.mark.parametrize("name", starpos.__all__)
def test_the_example_of_a_public_name_is_what_comes_of_it(name, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    thing = getattr(starpos, name)
    text = inspect.getdoc(thing)
    titles = re.findall(r"^(\w+)\n-+$", text, re.MULTILINE)
    if not inspect.isclass(thing):
        assert {"Parameters", "Returns"} <= set(titles)
    elif not issubclass(thing, Exception | Enum):
        assert {"Attributes", "Parameters"} & set(titles)
    names = {"starpos": starpos, "np": np, "Path": Path}
    example = doctest.DocTestParser().get_doctest(text, names, name, None, 0)
    lines = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    runner.run(example, out=lines.append)
    assert "\nExamples\n--------\n" in text and example.examples
    assert runner.failures == 0, "".join(lines)


def test_what_a_night_is_made_of_has_public_names(night):
    """Only these are in the reference of the library."""
    opened = starpos.open_night(night, calibration=starpos.Calibration.of((0, 0, 0), (5, 5, 5)))
    answer = opened.solve()
    for value in (opened, answer, answer.wgs84, answer.combined, answer.shots[0]):
        assert type(value).__name__ in starpos.__all__


def test_a_night_in_a_notebook_is_a_short_table_in_degrees(tmp_path):
    simulated(tmp_path, "-n", "2", "--stars-only")
    answer = starpos.open_night(tmp_path, instrument=starpos.Instrument(4635.9375)).solve()
    assert answer.wgs84.sigma_north_m > 1e6 and " km N " in repr(answer) and len(repr(answer)) < 200
    html = answer._repr_html_()
    assert html.count("<tr>") == 3 and "stars_0001.csv" in html and "the misalignment of camera" in html
    assert "nan" not in html


def test_what_a_user_prints_is_a_line(tmp_path):
    simulated(tmp_path, "-n", "2", "--stars-only")
    solver = starpos.Solver(starpos.Instrument(4635.9375), starpos.load_catalogue())
    tilts = starpos.read_tilt_csv(tmp_path / "tilt.csv")
    stars = [starpos.read_frame(path) for path in sorted(tmp_path.glob("stars_*.csv"))]
    solutions = [solver.solve(one, tilts) for one in stars]
    for value in (solutions[0], solutions[0].fix, starpos.average([s.fix for s in solutions])):
        assert "+35.70" in repr(value) and "heading 235." in repr(value) and len(repr(value)) < 150
    night = starpos.open_night(tmp_path, instrument=solver.instrument).solve()
    for value in (stars[0], tilts, solver.catalogue, night.shots[0], night.combined):
        assert "\n" not in repr(value) and len(repr(value)) < 200
    lost = solver.solve(stars[0])
    assert repr(lost).startswith("<Solution no tilt: ") and len(repr(lost)) < 150


def test_a_night_that_cannot_be_opened_is_said_in_a_sentence(night, tmp_path):
    with pytest.raises(starpos.StarposError, match="there is no such folder"):
        starpos.open_night(tmp_path / "none")
    with pytest.raises(starpos.StarposError, match="no frames in it"):
        starpos.open_night(tmp_path)
    with pytest.raises(starpos.StarposError, match=r"none\.yaml"):
        starpos.open_night(night, instrument=tmp_path / "none.yaml")

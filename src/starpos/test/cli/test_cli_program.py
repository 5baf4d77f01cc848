# SPDX-License-Identifier: Apache-2.0
"""The program around its commands: help, start-up, what it says where a file or its reader is missing."""

import argparse
import os
import shlex
import subprocess
import sys

import pytest
from cli_calls import WIDE

from starpos import cli
from starpos.cli import COMMANDS, console, inputs, parser_for, run_of
from starpos.cli.commands import command_of
from starpos.fix import blind
from starpos.frames import exif
from starpos.frames.exposure import MAX_READOUT_S, UNKNOWN_SHUTTER
from starpos.instrument import instrument, sensors
from starpos.instrument.camera import EQUIDISTANT, PLUMB_BOB
from starpos.navigation import vessel
from starpos.night import under_way
from starpos.night.remarks import NEAR_KM
from starpos.recording import topics
from starpos_testing.command_line import run
from starpos_testing.lacking import require
from starpos_testing.patience import WAIT_S


def test_catalogue_info(capsys):
    status, out, _ = run(capsys, "catalogue", "info")
    assert status == 0
    assert "stars of Tycho-2" in out
    assert "Hog et al. 2000" in out


def test_help_and_version(capsys):
    status, out, errors = run(capsys, "--help")
    assert (status, errors) == (0, [])
    assert all(name in out for name in COMMANDS)
    for name in COMMANDS:
        status, out, _ = run(capsys, name, "--help")
        assert status == 0
        assert f"starpos {name}" in out
    assert run(capsys, "--version")[:2] == (0, "starpos 0.4.0\n")


@pytest.mark.parametrize(
    ("words", "slow"),
    [
        (["--help"], ["astropy", "cv2", "scipy", "numpy", "argcomplete"]),
        (["solve", "--help"], ["astropy", "cv2", "matplotlib"]),
    ],
)
def test_help_imports_nothing_slow(words, slow):
    program = (
        f"import sys\nfrom starpos.cli import main\ntry: main({words})\nexcept SystemExit: pass\n"
        f"print([m for m in {slow} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=WAIT_S
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_missing_package_is_a_line_that_names_the_doctor(capsys, monkeypatch):
    def lacking(name):
        raise ModuleNotFoundError(f"No module named 'erfa' in {name}", name="erfa")

    monkeypatch.setattr(cli, "import_module", lacking)
    status, out, errors = run(capsys, "solve", "x.fits")
    assert (status, out) == (2, "")
    assert errors == ["starpos: the module erfa is not here: starpos doctor says what is missing"]


def test_python_m_starpos(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "starpos", "detect", str(tmp_path / "none.fits")],
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "none.fits" in done.stderr


def starpos(*args, **environment):
    """A whole process: its exit status and its lines of standard error without progress."""
    done = subprocess.run(
        [sys.executable, "-m", "starpos", *map(str, args)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done.returncode, done.stderr.splitlines()


def test_a_cache_that_cannot_be_written_is_one_line_for_all_frames(lists, tmp_path):
    rows = (lists / "stars_0001.csv").read_text()
    # This one has another size, so that two catalogues of triangles are wanted.
    other = tmp_path / "other.csv"
    other.write_text(rows.replace('"NAXIS1": 1000', '"NAXIS1": 1010'))
    assert other.read_text() != rows
    (tmp_path / "file").touch()
    frames = (lists / "stars_0000.csv", other, lists / "stars_0002.csv")
    status, errors = starpos("identify", *frames, *WIDE, XDG_CACHE_HOME=str(tmp_path / "file"))
    assert (status, len(errors)) == (0, 1), errors
    assert errors[0].startswith("starpos identify: ")
    assert "XDG_CACHE_HOME" in errors[0]


@pytest.mark.parametrize("command", ["solve", "identify"])
def test_a_missing_catalogue_is_one_line(command, lists, tmp_path):
    tilt = ("--tilt", lists / "tilt.csv") if command == "solve" else ()
    none = str(tmp_path / "none.npz")
    status, errors = starpos(command, lists / "stars_0000.csv", *tilt, *WIDE, STARPOS_CATALOGUE=none)
    assert (status, len(errors)) == (2, 1), errors
    assert errors[0].startswith(f"starpos {command}: {none}: no catalogue there")


def test_a_reader_that_goes_away_is_no_error(lists):
    """`starpos ... | head` ends quietly."""
    command = [sys.executable, "-m", "starpos", "catalogue", "info"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    _, errors = process.communicate(timeout=WAIT_S)
    assert errors == b""


def _program(words, output=subprocess.PIPE, **variables):
    return subprocess.run(
        [sys.executable, "-m", "starpos", *map(str, words)],
        stdout=output,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=os.environ | variables,
        timeout=WAIT_S,
        check=False,
    )


def test_a_full_disk_is_a_line(lists):
    with open("/dev/full", "w") as full:
        done = _program(["identify", *WIDE, *lists.glob("stars_*.csv")], output=full)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "cannot be written" in done.stderr


@pytest.mark.parametrize("form", ["", "--csv"])
def test_letters_that_a_terminal_lacks_are_escaped(lists, tmp_path, form):
    named = tmp_path / "\u043d\u043e\u0447\u044c.csv"
    named.write_bytes(next(lists.glob("stars_*.csv")).read_bytes())
    done = _program(["identify", *WIDE, *([form] if form else []), named], PYTHONIOENCODING="cp1252")
    assert done.returncode == 0 and "\\u043d" in done.stdout, done.stderr


def test_warnings_that_the_environment_makes_errors_are_lines(tmp_path):
    done = _program(["doctor"], PYTHONWARNINGS="error")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_of_frames_whose_lines_wait_is_shown_on_a_terminal_alone(capsys, monkeypatch, terminal):
    monkeypatch.setattr(console, "BAR_AFTER_S", -1.0)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    assert list(inputs.watched("ab", 2, lines=False)) == ["a", "b"]
    assert ("frame 2 of 2" in capsys.readouterr().err) is terminal


EXAMPLES = [(name, example) for name in COMMANDS for example in command_of(name).examples]


@pytest.mark.parametrize(("name", "example"), EXAMPLES)
def test_every_example_in_help_is_a_call_that_is_understood(name, example, capsys):
    for call in example.partition(" > ")[0].split(" && "):
        program, *words = shlex.split(call)
        # of --help the parser itself makes the end
        if program and "--help" not in words:
            assert program == "starpos" and words[0] in COMMANDS
            assert callable(run_of(parser_for(words).parse_args(words)))
    _, out, _ = run(capsys, name, "--help")
    assert f"  {example}\n" in out and command_of(name).next_step in out


def option(command, name):
    """The argparse action of an option."""
    [choice] = (action for action in parser_for([command])._actions if isinstance(action.choices, dict))
    return next(a for a in choice.choices[command]._actions if name in a.option_strings)


@pytest.mark.parametrize(
    ("command", "name", "attribute", "expected"),
    [
        ("navigate", "--mount-stddev", "default", under_way.MOUNT_STDDEV_DEG),
        ("navigate", "--mount-stddev", "help", f"({under_way.MOUNT_STDDEV_DEG:g})"),
        ("navigate", "--vehicle", "choices", tuple(vessel.LAWS)),
        ("identify", "--search-time", "default", blind.SEARCH_S),
        ("identify", "--search-time", "help", f"({blind.SEARCH_S:g} s)"),
        ("solve", "--near-km", "help", f"({NEAR_KM:g};"),
        ("solve", "--clock-stddev", "help", f"else {instrument.UNKNOWN_CLOCK_S:g};"),
        (
            "solve",
            "--exif-clock-stddev",
            "help",
            f"({exif.UNTENDED_STDDEV_S:g}, a telephone's {exif.NETWORK_STDDEV_S:g};",
        ),
        ("solve", "--inclinometer", "help", ", ".join(sensors.presets())),
        ("solve", "--lens", "choices", (PLUMB_BOB, EQUIDISTANT)),
        (
            "solve",
            "--readout",
            "help",
            f"not known, {UNKNOWN_SHUTTER.readout_s:g} {UNKNOWN_SHUTTER.readout_stddev_s:g})",
        ),
        ("calibrate", "--sag", "help", f"({instrument.SAG_ARCSEC_PER_SQRT_HOUR:g}, 300 m"),
        ("replay", "--remap", "help", ", ".join(topics.DRIVER_INPUTS)),
    ],
)
def test_rows_of_options_state_the_numbers_that_the_code_uses(command, name, attribute, expected):
    stated = getattr(option(command, name), attribute)
    assert expected in stated if attribute == "help" else stated == expected


@pytest.mark.parametrize(
    ("command", "name", "most"),
    [
        ("navigate", "--mount-stddev", under_way.MAX_MOUNT_DEG),
        ("calibrate", "--sag", instrument.MAX_SAG_ARCSEC),
        ("solve", "--readout", MAX_READOUT_S),
        ("simulate", "--readout", MAX_READOUT_S),
        ("solve", "--exif-utc-offset", exif.ZONES_H),
    ],
)
def test_rows_of_options_state_the_bounds_that_the_code_has(command, name, most):
    read = option(command, name).type
    assert read(str(most)) == most
    with pytest.raises(argparse.ArgumentTypeError, match="must lie between"):
        read(str(most * 1.001))


@pytest.mark.parametrize(
    ("line", "completed"), [("starpos so", "solve "), ("starpos solve --lens e", "equidistant ")]
)
def test_the_tab_key_completes_commands_and_options(line, completed, tmp_path):
    require("argcomplete")
    told = tmp_path / "told"
    asked = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n"}
    subprocess.run(
        [sys.executable, "-m", "starpos"],
        env={**os.environ, **asked, "_ARGCOMPLETE_STDOUT_FILENAME": str(told)},
        timeout=WAIT_S,
        check=False,
    )
    assert completed in told.read_text().split("\n")

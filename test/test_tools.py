# SPDX-License-Identifier: Apache-2.0
"""How tools/ treat invalid arguments, and tests that did not run."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from starpos.fix.solution import Status

TOOLS = Path(__file__).parent.parent / "tools"

OUTCOMES = {
    "": 0,
    '<skipped message="not on this machine"/>': 1,
    '<failure message="wrong"/>': 1,
    '<error message="broken"/>': 1,
}

SIGNALLED = """
import os, signal, threading
rest = threading.Event()
thread = threading.Thread(target=rest.wait, daemon=True)
thread.start()  # before the signals are asked for, as numpy's are
from indi_sky import signals
told = signals()
for number in (signal.SIGIO, signal.SIGTERM):
    signal.pthread_kill(thread.ident, number)
    print(os.read(told, 1)[0], end=" " if number == signal.SIGIO else "\\n")
"""


def run(tool, *arguments, cwd=None):
    """The exit status and all that it says."""
    command = [sys.executable, str(TOOLS / tool), *arguments]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=cwd, check=False
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize("tool", ["demo/demo.py", "demo/emulated_instrument.py"])
@pytest.mark.parametrize("frames", ["0", "-3"])
def test_a_run_of_no_frames_is_refused(tmp_path, tool, frames):
    status, said = run(tool, "--frames", frames, cwd=tmp_path)
    assert status == 2 and said.endswith(f"error: --frames {frames} is not 1 or more\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["foo:=1"], "foo:=1 is no NAME:=VALUE of a parameter of the node camera: see its README."),
        (
            ["foo", "--frames", "5"],
            "foo is no NAME:=VALUE of a parameter of the node camera: see its README.",
        ),
        (["exposure"], "exposure is no NAME:=VALUE of a parameter of the node camera: see its README."),
        (["indi.binning:=0"], "parameter indi.binning must be a whole number from 1 to 16 px; 0 was given."),
        (["exposure:=[1"], "exposure:=[1: the value is no YAML."),
        (["--frames", "0"], "0 frames are no soak: give 1 or more."),
    ],
)
def test_a_soak_with_words_that_are_none_ends_in_a_sentence(words, sentence):
    assert run("soaks/soak.py", "camera", "indi", *words) == (2, sentence + "\n")


@pytest.mark.parametrize(("outcome", "bad"), OUTCOMES.items(), ids=["passed", "skipped", "failed", "broken"])
def test_a_fault_whose_test_did_not_run_is_not_passed(tmp_path, monkeypatch, outcome, bad):
    monkeypatch.syspath_prepend(str(TOOLS / "faults"))
    from faults import rows_of

    report = tmp_path / "report.xml"
    report.write_text(
        f"""<testsuites><testsuite><testcase classname="test.test_a" name="test_b"><properties>
<property name="fault" value="cable"/><property name="result" value="back after 1 s"/></properties>{outcome}
</testcase></testsuite></testsuites>"""
    )
    rows, failed = rows_of(report)
    assert failed == bad and len(rows) == 1 and (rows[0][1] == "back after 1 s") == (not bad)


def test_every_package_is_tested_and_what_is_left_out_with_ubuntus_versions_is_there():
    """A path to --ignore that is not there pytest passes by in silence."""
    spec = importlib.util.spec_from_file_location("tools_test", TOOLS / "test.py")
    tests = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tests)
    carrying = {str(f.parent.relative_to(tests.ROOT)) for f in tests.ROOT.glob("**/starpos*/test/test_*.py")}
    assert set(tests.folders().values()) == carrying
    assert all((tests.ROOT / path).is_file() for path in tests.NEWEST_ONLY)


def test_no_profile_is_none_and_no_empty_path_to_one(monkeypatch):
    """Fast DDS prints an error for an empty path."""
    monkeypatch.syspath_prepend(str(TOOLS / "benchmarks"))
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "/home/robot/mine.xml")
    import latency

    latency.choose("")
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ
    latency.choose("quick.xml")
    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] == "quick.xml"


def test_a_signal_that_another_thread_of_the_sky_gets_does_not_end_it():
    numbers = subprocess.run(
        [sys.executable, "-c", SIGNALLED], cwd=TOOLS / "demo", capture_output=True, text=True, check=False
    )
    assert (numbers.returncode, numbers.stdout) == (0, "29 15\n"), numbers.stderr


@pytest.fixture
def instrument_run(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS / "demo"))
    import instrument_run

    return instrument_run


def watched(*statuses):
    """What a watcher has heard: a solution a status, by the name of its constant."""
    number = {status.name: k for k, status in enumerate(Status)}
    solutions = [SimpleNamespace(status=number[name], **number) for name in statuses]
    good = [s for s in solutions if s.status == s.OK]
    return SimpleNamespace(solutions=dict(enumerate(solutions)), good=lambda: good)


SUMMARY = dict.fromkeys(
    ("north_m", "east_m", "sigma_north_m", "sigma_east_m", "heading_error_arcsec"), 0.0
) | {"frames": 2, "sigmas_off": 0.4}


def test_a_demo_whose_tilts_stop_says_so_and_not_that_the_truth_is_outside(instrument_run, capsys):
    lost = watched("NO_TILT", "OK", "OK", "NO_TILT", "NO_TILT", "NOT_IDENTIFIED")
    assert not instrument_run.say_errors(lost, SUMMARY)
    said = capsys.readouterr().out
    assert "the truth lies within 4 sigma: 0.4 sigma off" in said and "OUTSIDE" not in said
    assert "3 of 6 frames gave no fix: no tilt (2), not identified (1)" in said
    assert instrument_run.say_errors(watched("NO_TILT", "OK"), SUMMARY)
    assert not instrument_run.say_errors(watched("OK"), SUMMARY | {"sigmas_off": 4.1})
    assert "OUTSIDE 4 sigma: 4.1" in capsys.readouterr().out


def test_a_demo_names_the_node_that_was_killed_and_what_lacked(instrument_run):
    trouble_of = instrument_run.trouble_of
    assert trouble_of(watched("OK"), {"solver": 0, "camera": 0}, None) is None
    assert trouble_of(watched("OK"), {"solver": -9, "camera": 1, "detector": "killed"}, None) == (
        "solver was ended by SIGKILL; camera ended with status 1; "
        "detector did not end when it was asked to, and was killed"
    )
    assert trouble_of(watched("NO_TILT"), {"solver": 0}, None) == "none of 1 frames gave a fix: no tilt (1)"


def test_a_demo_that_stays_says_which_node_ended(instrument_run, capsys):
    import demo

    watcher = SimpleNamespace(watch=lambda *_, **__: "solver was ended by SIGKILL; it said last: nothing")
    assert demo.look(watcher, None, "").startswith("solver was ended by SIGKILL")


def test_all_that_the_emulated_instrument_lacks_is_told_at_once(instrument_run, monkeypatch):
    import emulated_instrument

    lacking = SimpleNamespace(stdout="gcc-avr chromium indi-bin\n")
    monkeypatch.setattr(emulated_instrument.subprocess, "run", lambda *_, **__: lacking)
    assert emulated_instrument.lacking() == "sudo apt-get install gcc-avr indi-bin"

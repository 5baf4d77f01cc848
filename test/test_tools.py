# SPDX-License-Identifier: Apache-2.0
"""What tools/ make of arguments that are none, and of tests that did not run."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

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
        (["foo", "5"], "foo is no NAME:=VALUE of a parameter of the node camera: see its README."),
        (["exposure"], "exposure is no NAME:=VALUE of a parameter of the node camera: see its README."),
        (["indi.binning:=0"], "parameter indi.binning must be a whole number from 1 to 16 px; 0 was given."),
        (["exposure:=[1"], "exposure:=[1: the value is no YAML."),
        (["0"], "0 frames are no soak: give 1 or more."),
    ],
)
def test_a_soak_with_words_that_are_none_ends_in_a_sentence(words, sentence):
    assert run("soaks/soak_camera.py", "indi", *words) == (2, sentence + "\n")


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

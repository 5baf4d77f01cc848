# SPDX-License-Identifier: Apache-2.0
"""The node as a process of its own, with the emulated device behind a real port."""

import math
import signal
import statistics
import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import DescribeParameters

from starpos.messages import tilt
from starpos.parameters.table import parameters_of
from starpos_inclinometer.node import InclinometerNode
from starpos_interfaces.msg import Tilt
from starpos_testing.emulator import Mcu
from starpos_testing.nodes import Listener, Process, refusal, take_domain


@pytest.fixture(scope="module", autouse=True)
def domain():
    take_domain()


class Ears(Listener):
    """A listener with the tilts and the states of the link, oldest first."""

    def __init__(self):
        super().__init__()
        self.tilts = self.hear(Tilt, "tilt", 100)
        self._reports = self.hear(DiagnosticArray, "/diagnostics")

    @property
    def links(self):
        return [s for report in self._reports for s in report.status if s.name == "inclinometer: Link"]


@pytest.fixture
def listener():
    listener = Ears()
    yield listener
    listener.close()


@pytest.fixture
def start():
    processes = []

    def start(*parameters):
        processes.append(Process("starpos_inclinometer.main", "inclinometer", parameters))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()


def test_publishes_the_tilt_with_its_time_and_changes_rate(bench, start, listener):
    true = (math.radians(3.0), math.radians(-1.0))
    times = []

    def when(now):
        times.append(time.time())
        return true

    bench.plug(Mcu(when, seed=1))
    node = start(f"port:={bench.path}", "noise_stddev:=0.006", "rate:=20")
    # the first second after the start, and after the change of rate, is not dated
    listener.wait(lambda: len(listener.tilts) >= 80 and not any(t.flags for t in listener.tilts[-40:]))
    first = listener.tilts[0]
    assert first.header.frame_id == "starpos_inclinometer_frame"
    mean = [sum(getattr(t, axis) for t in listener.tilts) / len(listener.tilts) for axis in "xy"]
    assert mean == pytest.approx(true, abs=4 * math.radians(0.0035) / math.sqrt(len(listener.tilts)))
    assert list(first.covariance) == pytest.approx(
        [math.radians(0.006) ** 2, 0, 0, math.radians(0.006) ** 2], rel=1e-3
    )
    assert first.temperature == pytest.approx(20, abs=0.5)
    assert {t.flags & ~Tilt.TIME_UNKNOWN for t in listener.tilts} == {0}
    stamps = [t.header.stamp.sec + t.header.stamp.nanosec * 1e-9 for t in listener.tilts[-40:]]
    assert stamps == sorted(stamps)
    # The emulator asks for the tilt when the line is due: 24 ms of conversion and 11 ms of line later.
    # On a busy machine one line or another is late.
    late = [min((stamp - t + 0.035 for t in times), key=abs) for stamp in stamps]
    assert abs(statistics.median(late)) < 0.02
    assert [b.sequence - a.sequence for a, b in zip(listener.tilts, listener.tilts[1:], strict=False)] == [
        1
    ] * (len(listener.tilts) - 1)
    listener.wait(lambda: listener.links)
    listener.wait(lambda: listener.links[-1].level == b"\x00")
    assert listener.links[-1].hardware_id == bench.path

    assert listener.set("inclinometer", rate=50).successful
    listener.wait(
        lambda: any(v.key == "rate (Hz)" and float(v.value) > 40 for v in listener.links[-1].values)
    )
    refusal = listener.set("inclinometer", rate=51)
    assert not refusal.successful and "50" in refusal.reason
    assert not listener.set("inclinometer", baud=9600).successful
    request = DescribeParameters.Request(names=["rate", "divider", "noise_stddev"])
    rate, divider, noise = listener.call(
        DescribeParameters, "/inclinometer/describe_parameters", request
    ).descriptors
    assert (rate.integer_range[0].from_value, rate.integer_range[0].to_value) == (1, 50)
    assert noise.description.endswith("[deg]") and "nan" in noise.additional_constraints
    assert divider.floating_point_range
    assert node.end(signal.SIGINT, signal.SIGINT)[0] == 0


def test_missing_port_keeps_the_node_alive_with_one_sentence_until_it_comes(bench, start, listener):
    node = start(f"port:={bench.path}")
    listener.wait(lambda: len(listener.links) >= 3)
    assert listener.links[-1].level == b"\x02" and "is not there" in listener.links[-1].message
    bench.plug()
    listener.wait(lambda: len(listener.tilts) >= 3)
    bench.unplug()
    # a second later all tilts of before have come
    listener.wait(lambda: [link.level for link in listener.links[-2:]] == [b"\x02"] * 2)
    bench.plug(Mcu(seed=2))
    n = len(listener.tilts)
    listener.wait(lambda: len(listener.tilts) >= n + 3)
    assert listener.tilts[n].flags & Tilt.GAP
    status, out = node.end(signal.SIGTERM)
    assert status == 0
    assert 2 <= out.count("is not there") + out.count("went away") <= 3
    assert len(out.splitlines()) <= 5 and "Traceback" not in out


def test_frozen_converter_and_steep_tilt_are_flagged_and_reported(bench, start, listener):
    mcu = Mcu(lambda now: (0.55, 0.0), seed=1)
    bench.plug(mcu)
    node = start(f"port:={bench.path}", "rate:=50")
    listener.wait(lambda: listener.links and "beyond" in listener.links[-1].message)
    assert listener.links[-1].level == b"\x01"
    listener.wait(lambda: listener.tilts and listener.tilts[-1].flags & Tilt.OUT_OF_RANGE)
    mcu.frozen = True
    listener.wait(lambda: "stuck" in listener.links[-1].message)
    assert listener.links[-1].level == b"\x02"
    listener.wait(lambda: listener.tilts[-1].flags & Tilt.STUCK)
    assert node.end(signal.SIGINT)[0] == 0


@pytest.mark.parametrize(
    ("parameter", "sentence"),
    [
        ("rate:=0", "rate must be a whole number from 1 to 50 Hz; 0 was given"),
        ("noise_stddev:=0.0", "noise_stddev must be a number from 1e-06 to 10 deg, or nan for unset"),
        ("cross_axis:=[1.0, 1.0, 1.0, 1.0]", "cross_axis must be two different axes"),
        ("source:=gnss", "source must be one of serial, imu, ascii"),
        ("offset_volts:=[2.5]", "offset_volts must be 2 values"),
        ("port:=7", "port must be a text"),
        ("frame_id:=''", "frame_id must be a frame's name, not empty"),
        ("port:=''", "port must name the serial port, such as /dev/serial/by-id/...; it is empty"),
    ],
)
def test_a_bad_parameter_is_refused(parameter, sentence):
    assert sentence in refusal(InclinometerNode, parameter)


def test_readme_names_every_parameter():
    readme = (Path(__file__).parent.parent / "README.md").read_text()
    assert [p.name for p in parameters_of("inclinometer") if f"| `{p.name}` |" not in readme] == []


def test_flags_are_those_of_the_message():
    for name in ("OUT_OF_RANGE", "STUCK", "SATURATED", "GAP", "TIME_UNKNOWN"):
        assert getattr(tilt, name) == getattr(Tilt, name)

# SPDX-License-Identifier: Apache-2.0
"""The node itself: how it starts, what it refuses, what hostile topics do to it, how it ends."""

import json
import signal
import socket
import sys
import urllib.request
from contextlib import closing
from importlib import import_module

import pytest
import said
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image, NavSatFix

from starpos.errors import StarposError
from starpos_testing.lacking import require
from starpos_testing.nodes import Listener, Process, refusal, take_domain
from starpos_testing.patience import WAIT_S

OK, WARN = 0, 1


@pytest.fixture
def listener():
    take_domain()
    listener = Listener()
    yield listener
    listener.close()


@pytest.fixture
def start():
    require("tornado")
    processes = []

    def start(*parameters, executable="dashboard", module="starpos_dashboard.main", namespace="/"):
        processes.append(Process(module, executable, parameters, namespace))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()


def address_of(listener, page="dashboard: Page") -> tuple[str, int]:
    listener.wait_for_state(page, OK, "shown at http://")
    host, _, port = listener.states[page].message.rpartition("/")[2].rpartition(":")
    return host, int(port)


def test_a_port_in_use_is_one_line_and_status_1(start):
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        status, output = start(f"port:={port}").end()
    assert status == 1
    (line,) = output.splitlines()
    assert f"127.0.0.1:{port}" in line and "set the parameter port" in line


@pytest.fixture
def made():
    """The class of the node, which stands on tornado."""
    require("tornado")
    from starpos_dashboard.node import DashboardNode

    return DashboardNode


@pytest.mark.parametrize("parameter", ["port:=70000", "clients:=0", "rate:=0.1", "image_side:=1"])
def test_a_parameter_out_of_range_is_refused(made, parameter):
    assert "must be" in refusal(made, parameter)


@pytest.mark.parametrize("address", ["''", "' '", "'127.0.0.1 '"])
def test_no_address_is_not_every_address(made, address):
    said = refusal(made, "port:=0", f"address:={address}")
    assert "parameter address must be an address of this machine" in said


def test_without_tornado_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "tornado.http1connection", None)
    monkeypatch.delitem(sys.modules, "starpos_dashboard.server", raising=False)
    with pytest.raises(StarposError, match="sudo apt install python3-tornado"):
        import_module("starpos_dashboard.server")


def test_an_address_others_reach_is_a_warning_and_loopback_is_none(start, listener):
    open_to_all = start("port:=0", "address:='0.0.0.0'")
    address_of(listener)
    status, output = open_to_all.end(signal.SIGTERM)
    assert status == 0 and "[WARN]" in output and "without a password" in output
    own = start("port:=0")
    listener.wait_for_state("dashboard: Page", OK, "http://127.0.0.1:")
    status, output = own.end(signal.SIGTERM)
    assert status == 0 and "[WARN]" not in output and len(output.splitlines()) == 1


@pytest.mark.parametrize("signals", [(signal.SIGINT, signal.SIGINT), (signal.SIGTERM,)])
def test_it_ends_at_once_with_pages_open_and_hung(start, listener, signals):
    process = start("port:=0")
    address = address_of(listener)
    with (
        closing(socket.create_connection(address)) as hung,
        closing(socket.create_connection(address)) as mute,
    ):
        hung.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        mute.sendall(b"GET /")
        listener.wait(lambda: {"pages", "1"} <= set(words(listener)))
        status, output = process.end(*signals)
    assert status == 0 and "Traceback" not in output, output


def words(listener) -> list[str]:
    state = listener.states.get("dashboard: Page")
    return [word for v in state.values[:1] for word in (v.key, v.value)] if state else []


def test_the_solver_of_another_instrument_on_the_graph_is_not_its_own(start, listener):
    start("port:=0", "lights:=solver", namespace="/a")
    host, port = address_of(listener, "/a/dashboard: Page")

    def names_shown(url=f"http://{host}:{port}/events"):
        with urllib.request.urlopen(url, timeout=WAIT_S) as page:
            state = next(line for line in page if b'"lights"' in line)
        return {light["name"] for light in json.loads(state.removeprefix(b"data: "))["lights"]}

    start(executable="solver", module="starpos_solver.main", namespace="/b")
    listener.wait(lambda: "/b/solver: Solution" in listener.states)
    assert listener.set("a/dashboard", lights="/b/solver").successful
    # It hears the other one.
    listener.wait(lambda: "/b/solver: Solution" in names_shown())
    assert listener.set("a/dashboard", lights="solver").successful
    listener.wait_for_state("/b/solver: Solution", WARN)
    # It has fallen silent.
    assert names_shown() == {"solver"}
    start(executable="solver", module="starpos_solver.main", namespace="/a")
    listener.wait(lambda: "solver: Solution" in names_shown())


def test_hostile_messages_are_taken_in_its_stride(start, listener):
    process = start("port:=0", "lights:=''")
    host, port = address_of(listener)
    node = listener.node
    fix = node.create_publisher(NavSatFix, "fix", 10)
    image = node.create_publisher(Image, "detector/image_annotated", 10)
    diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    broken = said.image(64, 40)
    broken.width = 2**31
    flood = said.diagnostics(*((f"\x1b[2J\u202en{k}: T", 200, "<script>" * 500) for k in range(500)))
    with urllib.request.urlopen(f"http://{host}:{port}/events", timeout=WAIT_S) as page:
        listener.wait(lambda: image.get_subscription_count() == 1)
        seen = []

        def told():
            fix.publish(said.fix(float("inf"), float("nan")))
            image.publish(broken)
            diagnostics.publish(flood)
            seen.append(page.readline())
            return any(b"too large to be shown" in line and b"n255: T" in line for line in seen)

        listener.wait(told)
    state = next(line for line in reversed(seen) if b'"lights"' in line)
    assert (
        len(state) < 100_000 and b"NaN" not in state and b"Infinity" not in state and b"\\u202e" not in state
    )
    listener.wait_for_state("dashboard: Page", OK)
    status, output = process.end(signal.SIGINT)
    assert status == 0 and "Traceback" not in output, output

# SPDX-License-Identifier: Apache-2.0
"""The security policy against the running graph: each process may do what it does, and nothing else."""

import time
import urllib.request
from importlib.metadata import entry_points
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image

from starpos_testing.patience import WAIT_S
from starpos_testing.skies import orbits

NIGHT = Path(__file__).parent / "data" / "night"
POLICY = Path(__file__).parents[1] / "src" / "starpos_bringup" / "sros2" / "policies.xml"
SKY = ("source:=simulated", "focal_mm:=14.8", "simulated.width:=640", "simulated.height:=427", "cadence:=0.5")
RULES = {("topics", "publish"), ("topics", "subscribe"), ("services", "reply"), ("services", "request")}


def full_name(name: str, namespace: str, node: str) -> str:
    """The name as sros2's template writes it."""
    if name.startswith("/"):
        return name
    base = namespace if namespace.endswith("/") else f"{namespace}/"
    return f"{base}{node}{name[1:]}" if name.startswith("~") else base + name


def only(element, tag: str, *attributes: str):
    """The element, if it is that and has these attributes: sros2 ignores or refuses what else a file may hold."""
    assert element.tag == tag and sorted(element.attrib) == sorted(attributes), element
    return element


def allowed() -> dict[str, set]:
    """(node, publish | subscribe | reply | request, name) by enclave."""
    # sros2 stumbles over comments in there
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    policy = only(ElementTree.parse(POLICY, parser).getroot(), "policy", "version")
    assert policy.attrib["version"] == "0.2.0"
    (enclaves,) = policy
    found = {}
    for enclave in only(enclaves, "enclaves"):
        path = only(enclave, "enclave", "path").attrib["path"]
        assert path not in found, path
        found[path] = set()
        (profiles,) = enclave
        for profile in only(profiles, "profiles"):
            namespace, node = (only(profile, "profile", "ns", "node").attrib[k] for k in ("ns", "node"))
            for rules in profile:
                ((action, verdict),) = rules.attrib.items()
                assert verdict == "ALLOW" and (rules.tag, action) in RULES
                for rule in rules:
                    name = only(rule, rules.tag[:-1]).text
                    # To DDS these mean a text of any length.
                    assert "*" not in name and "?" not in name
                    found[path].add(
                        (full_name(node, namespace, ""), action, full_name(name, namespace, node))
                    )
    return found


def done(graph) -> dict[str, set]:
    """Topics and services of the running nodes that have an enclave."""
    found, ask = {}, graph.node
    for node, namespace, enclave in ask.get_node_names_and_namespaces_with_enclaves():
        if enclave == "/":
            continue
        name, here = full_name(node, namespace, ""), found.setdefault(enclave, set())
        for action, names in (
            ("publish", ask.get_publisher_names_and_types_by_node),
            ("subscribe", ask.get_subscriber_names_and_types_by_node),
            ("reply", ask.get_service_names_and_types_by_node),
            ("request", ask.get_client_names_and_types_by_node),
        ):
            here |= {(name, action, what) for what, _ in names(node, namespace)}
    return found


@pytest.fixture
def secured(graph, run):
    """Start an executable in its enclave, on simulated time."""
    clock = graph.node.create_publisher(Clock, "/clock", 10)

    def tick():
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time.time_ns(), 10**9)
        clock.publish(message)

    timer = graph.node.create_timer(0.1, tick)

    def secured(package, name, *parameters, arguments=()):
        enclave = ("--ros-args", "--enclave", f"/starpos/{name}")
        return run(package, name, *parameters, arguments=(*arguments, *enclave))

    yield secured
    graph.node.destroy_timer(timer)
    graph.node.destroy_publisher(clock)


def hold(graph, *enclaves: str, without: frozenset = frozenset()):
    """Wait until each has done all that it may, except `without`, at any time; it has done nothing that it may not."""
    policy, seen = {e: may - without for e, may in allowed().items()}, {e: set() for e in enclaves}

    def complete():
        for enclave, what in done(graph).items():
            seen[enclave] |= what
        return all(policy[e] <= seen[e] for e in enclaves)

    come = graph.comes(complete, WAIT_S)
    unused = {e: sorted(policy[e] - seen[e]) for e in enclaves if policy[e] - seen[e]}
    assert come and not unused, f"the policy allows what nobody does: {unused}"
    forbidden = {e: sorted(seen[e] - policy[e]) for e in enclaves if seen[e] - policy[e]}
    assert not forbidden, f"the policy forbids what is done: {forbidden}"


@pytest.mark.usefixtures("tf2")
def test_the_policy_holds_for_the_nodes_apart(graph, secured, tmp_path):
    sim = "use_sim_time:=true"
    (tmp_path / "active.tle").write_text(orbits.drawn(3, 1, time.time() - 3600)[1])
    elements = f"satellites.elements:={tmp_path / 'active.tle'}"
    secured("starpos_solver", "solver", sim, "gyro:=true", elements)
    secured("starpos_solver", "navigator", sim, "publish_tf:=true")
    secured("starpos_camera", "camera", sim, *SKY)
    secured("starpos_camera", "detector", sim, "trails:=true", "day_exposure:=true")
    secured("starpos_inclinometer", "inclinometer", sim, "source:=imu")
    secured("starpos_bringup", "record", arguments=(str(tmp_path / "bag"), "--images"))
    secured("starpos_bringup", "folder", arguments=(str(tmp_path / "night"),))
    dashboard = secured("starpos_dashboard", "dashboard", sim, "port:=0")
    graph.wait(lambda: "http://" in dashboard.output)
    address = "http://" + dashboard.output.split("http://")[1].split()[0]
    with urllib.request.urlopen(f"{address}/events?frame", timeout=WAIT_S):
        names = ("solver", "navigator", "camera", "detector", "inclinometer", "record", "folder", "dashboard")
        hold(graph, *(f"/starpos/{name}" for name in names))


def test_the_policy_holds_for_camera_and_detector_in_one_process(graph, secured):
    graph.hear(Image, "detector/image_annotated")
    all_of_it = "trails:=true", "day_exposure:=true"
    secured("starpos_camera", "camera_detector", "use_sim_time:=true", *all_of_it, *SKY)
    hold(graph, "/starpos/camera_detector")


def test_the_policy_holds_for_a_replay(graph, secured):
    secured("starpos_bringup", "replay", arguments=(str(NIGHT), "--rate", "0", "--wait", "30"))
    # The kept night has no GNSS, no trails, and no node makes anything of it here.
    unused = {
        ("publish", "/gnss/fix"),
        ("publish", "/trails"),
        ("subscribe", "/solver/solution"),
        ("subscribe", "/stars"),
    }
    hold(graph, "/starpos/replay", without=frozenset(("/replay", *use) for use in unused))


def test_every_executable_has_an_enclave():
    packages = (
        "starpos_bringup",
        "starpos_camera",
        "starpos_dashboard",
        "starpos_inclinometer",
        "starpos_solver",
    )
    made = {e.name for e in entry_points(group="console_scripts") if e.module.split(".")[0] in packages}
    # A device, no node.
    assert {f"/starpos/{name}" for name in made - {"emulator"}} == set(allowed())

# SPDX-License-Identifier: Apache-2.0
"""What Foxglove and RViz are given: every panel has its place, every topic and field is one there is."""

import json
import re
from importlib import import_module
from pathlib import Path

import yaml

LAYOUTS = Path(__file__).parent.parent / "layouts"
TOPICS = {
    "/fix": "sensor_msgs/NavSatFix",
    "/fix_averaged": "sensor_msgs/NavSatFix",
    "/heading/imu": "sensor_msgs/Imu",
    "/tilt": "starpos_interfaces/Tilt",
    "/solver/solution": "starpos_interfaces/Solution",
    "/detector/image_annotated": "sensor_msgs/Image",
    "/diagnostics": "diagnostic_msgs/DiagnosticArray",
}


def panels(node) -> list[str]:
    """The panels of a mosaic, in order; every split is whole."""
    if isinstance(node, str):
        return [node]
    assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
    assert set(node) == {"direction", "splitPercentage", "first", "second"}
    return panels(node["first"]) + panels(node["second"])


def said(value) -> list[str]:
    """Every text in a value."""
    if isinstance(value, dict):
        return [text for k, v in value.items() for text in (k, *said(v))]
    if isinstance(value, list):
        return [text for v in value for text in said(v)]
    return [value] if isinstance(value, str) else []


def field_is_there(path: str) -> bool:
    """Whether a message path, as /topic.field[:]{name=="x"}.field, leads to a field of the topic's type."""
    topic, *fields = re.sub(r"\[:\]|\{[^}]*\}", "", path).split(".")
    package, name = TOPICS[topic].split("/")
    kind = getattr(import_module(f"{package}.msg"), name)
    for field in fields:
        of = kind.get_fields_and_field_types().get(field)
        if of is None:
            return False
        match = re.fullmatch(r"(?:sequence<)?(\w+)/(\w+)(?:>)?", of)
        kind = getattr(import_module(f"{match[1]}.msg"), match[2]) if match else None
    return True


def test_foxgloves_layout_holds_together():
    layout = json.loads((LAYOUTS / "starpos.foxglove.json").read_text())
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    placed = panels(layout["layout"])
    assert sorted(placed) == sorted(layout["configById"]) and len(placed) == len(set(placed))
    paths = {text for text in said(layout["configById"]) if text.startswith("/")}
    assert all(field_is_there(path) for path in paths), paths
    assert {re.split(r"[.\[]", p)[0] for p in paths} >= set(TOPICS) - {"/heading/imu"}
    for plot in (c for name, c in layout["configById"].items() if name.startswith("Plot!")):
        assert all(path["enabled"] and path["value"] for path in plot["paths"])


def test_rvizs_configuration_holds_together():
    config = yaml.safe_load((LAYOUTS / "starpos.rviz").read_text())
    manager = config["Visualization Manager"]
    topics = [d["Topic"]["Value"] for d in manager["Displays"] if "Topic" in d]
    assert set(topics) == {"/heading/imu", "/detector/image_annotated"}
    assert manager["Global Options"]["Fixed Frame"] == "starpos_link"
    names = [d["Class"] for d in manager["Displays"]]
    assert all(re.fullmatch(r"rviz_(default_plugins|imu_plugin)/\w+", name) for name in names)

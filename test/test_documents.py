# SPDX-License-Identifier: Apache-2.0
"""What the documents name is there: links, headings, files, tools, parameters; changelogs are as bloom reads them."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = sorted(p.parent for p in (*ROOT.glob("*/package.xml"), *ROOT.glob("src/*/package.xml")))
DOCUMENTS = sorted(
    {d for folder in (ROOT, ROOT / "docs", ROOT / "test", *PACKAGES) for d in folder.glob("*.md")}
)
OF_NODES = {
    "camera": "starpos_camera",
    "dashboard": "src/starpos_dashboard",
    "detector": "starpos_camera",
    "inclinometer": "starpos_inclinometer",
    "solver": "starpos_solver",
}


def headings(document: Path) -> set[str]:
    """As GitHub makes anchors of them."""
    found = re.findall(r"^#+ (.*)$", document.read_text(), re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", h).replace("`", "").strip().lower() for h in found)
    return {re.sub(r"[^\w\- ]", "", h).replace(" ", "-") for h in plain}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: str(d.relative_to(ROOT)))
def test_every_link_and_every_tool_that_is_named_is_there(document):
    text = document.read_text()
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = document.parent / path if path else document
        assert target.exists(), link
        assert not anchor or anchor in headings(target), link
    for tool in re.findall(r"\b(?:tools|test)/(?:\w+/)*\w+\.\w+", text):
        assert any((folder / tool).exists() for folder in (ROOT, document.parent, *PACKAGES)), tool


def test_every_parameter_is_in_its_packages_readme():
    nodes = yaml.safe_load((ROOT / "src" / "starpos_bringup" / "config" / "starpos.yaml").read_text())
    for name, node in nodes.items():
        name = name.rsplit("/", 1)[-1]
        readme = (ROOT / OF_NODES[name] / "README.md").read_text()
        missing = [p for p in flat(node["ros__parameters"]) if f"`{p}`" not in readme]
        assert not missing, name


def flat(parameters: dict, before: str = ""):
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from flat(value, f"{before}{name}.")
        else:
            yield before + name


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.name)
def test_a_package_has_a_changelog_as_catkin_prepare_release_wants_it(package):
    name = ElementTree.parse(package / "package.xml").findtext("name")
    bar, title, again, _, section, line, *entries = (package / "CHANGELOG.rst").read_text().splitlines()
    assert title == f"Changelog for package {name}" and bar == again == "^" * len(title)
    assert re.fullmatch(r"Forthcoming|\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)", section) and line == "-" * len(
        section
    )
    assert entries and all(re.match(r"\* |  \S|-+$|$|\d+\.", entry) for entry in entries)

# SPDX-License-Identifier: Apache-2.0
"""A command that a document shows can be typed: options, nodes, launch files, parameters, targets of make are there."""

import doctest
import json
import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from test_documents import DOCUMENTS, ROOT, flat
from test_policies import allowed

from starpos.cli import main, parser_for
from starpos.files import rows_of
from starpos.instrument import instrument_file

LAUNCH = ROOT / "src" / "starpos_bringup" / "launch"
PARAMETERS = {
    name.rsplit("/", 1)[-1]: set(flat(node["ros__parameters"]))
    for name, node in yaml.safe_load((LAUNCH.parent / "config" / "starpos.yaml").read_text()).items()
}
# of whole processes, the nodes in them
NODES = {"camera_detector": ("camera", "detector")}
OURS = (
    "starpos ",
    "ros2 run starpos_",
    "ros2 launch starpos_",
    "ros2 service ",
    "ros2 topic ",
    "ros2 param ",
    "make ",
)


def shown(document: Path) -> list[str]:
    """The lines of code blocks, a continued one as one line, without prompts, and what a sentence has ROS show."""
    text = document.read_text().replace("\\\n", " ")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    # a table or an item of a list is not so far in, and the code of an item is 3 or 4 further
    indented = re.findall(r"^ {4}(?: {3,4})?(\S.*)", text, re.MULTILINE)
    told = re.findall(r"`(ros2 (?:topic|service) \w+ [^`]+)`", text)
    lines = "\n".join([*fenced, *indented, *told]).splitlines()
    return [re.sub(r"^\s*(?:\w*\$ )?", "", line) for line in lines]


CALLS = sorted(
    {
        (line.strip(), str(document.relative_to(ROOT)))
        for document in DOCUMENTS
        for line in shown(document)
        if line.startswith(OURS)
    }
)


def words(call: str) -> list[str]:
    """The words of the first command of a line."""
    one = re.split(r" && | \| |; | > ", call)[0]
    return shlex.split(one, comments=True)


def calls(begin: str) -> list:
    return [pytest.param(call, id=f"{place}: {call[:60]}") for call, place in CALLS if call.startswith(begin)]


@pytest.mark.parametrize("call", calls("starpos "))
def test_a_command_line_is_understood(call):
    _, *arguments = words(call)
    if arguments[0] not in ("--help", "--version", "COMMAND"):
        parser_for(arguments).parse_args(arguments)


@pytest.mark.parametrize("call", calls("ros2 launch "))
def test_a_launch_file_and_its_arguments_are_there(call):
    _, _, package, file, *arguments = words(call)
    assert (ROOT / "src" / package / "launch" / file).is_file()
    known = rows_of(ROOT / "src" / package / package / "data" / "launch.yaml")[file.partition(".")[0]]
    assert known.keys() >= {a.split(":=")[0] for a in arguments if ":=" in a}


@pytest.mark.parametrize("call", calls("ros2 run "))
def test_an_executable_and_its_parameters_are_there(call):
    _, _, package, executable, *arguments = words(call)
    [setup] = [p for p in (ROOT / package / "setup.py", ROOT / "src" / package / "setup.py") if p.is_file()]
    assert f'"{executable} = ' in setup.read_text()
    for name in re.findall(r"(?<=-p )'?([\w./]+):=", call):
        known = set().union(*(PARAMETERS[node] for node in NODES.get(executable, (executable,))))
        assert name in known or name.startswith("qos_overrides."), name
    assert all(arguments)


def named(action: str) -> set[str]:
    """The names that nodes publish or reply under, as the security policy allows them."""
    return {name for rules in allowed().values() for _, what, name in rules if what == action}


# the namespace of robot.launch.py
OF_ROBOT = "/starpos"


@pytest.mark.parametrize("call", calls("ros2 topic echo "))
def test_a_topic_is_there(call):
    _, _, _, name, *_ = words(call)
    assert name.removeprefix(OF_ROBOT) in named("publish")


@pytest.mark.parametrize("call", calls("ros2 service "))
def test_a_service_and_its_request_are_there(call):
    _, _, _, name, kind, *request = words(call)
    package, _, service = kind.split("/")
    fields = getattr(import_module(f"{package}.srv"), service).Request.get_fields_and_field_types()
    assert name.removeprefix(OF_ROBOT) in named("reply")
    assert set(yaml.safe_load(request[0]) if request else {}) <= set(fields)


@pytest.mark.parametrize("call", calls("ros2 param set"))
def test_a_parameter_is_there(call):
    _, _, _, node, name, value = words(call)
    assert name in PARAMETERS[node.strip("/")] and value


@pytest.mark.parametrize("call", calls("make "))
def test_a_target_of_make_is_there(call):
    _, *targets = words(call)
    folder = ROOT
    if targets[0] == "-C":
        folder, targets = ROOT / targets[1], targets[2:]
    makefile = (folder / "Makefile").read_text()
    for target in (w for w in targets if "=" not in w):
        assert re.search(rf"^(?:.* )?{target}(?: .*)?:", makefile, re.MULTILINE), target


def test_commands_are_found():
    found = {begin: sum(call.startswith(begin) for call, _ in CALLS) for begin in OURS}
    assert min(found.values()) >= 1 and found["starpos "] > 20, found


def test_the_methods_numbers_are_true():
    page = (ROOT / "docs" / "tutorials" / "method.md").read_text()
    examples = "\n".join(re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL))
    test = doctest.DocTestParser().get_doctest(examples, {}, "method.md", None, 0)
    assert doctest.DocTestRunner().run(test).failed == 0 and len(test.examples) > 15


def test_the_notebook_is_that_of_the_page_and_runs(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "data"))
    page = ROOT / "docs" / "tutorials" / "method.md"
    told = page.with_suffix(".ipynb").read_text()
    assert told == import_module("notebook").notebook(page.read_text()), "python tools/data/notebook.py"
    code = ["".join(c["source"]) for c in json.loads(told)["cells"] if c["cell_type"] == "code"]
    exec("\n".join(code), {})
    assert capsys.readouterr().out.splitlines()[-1] == "35.7044 51.4104"


WIDE = ("--focal-mm", "29.67", "--pixel-um", "6.4", "--size", "1000", "700")


def python_of(page: str) -> str:
    [code] = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)
    return code


def test_the_tutorials_python_solves_a_night(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "night", "-n", "1", *WIDE]) == 0
    names = {}
    exec(python_of("docs/tutorials/disk.md").replace("night.solve()", "solved = night.solve()"), names)
    assert "1 of 1 frames fixed" in repr(names["solved"])


def test_the_readmes_python_prints_what_it_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "night", "-n", "3", *WIDE]) == 0
    page = python_of("README.md").replace("10 of 10 frames", "3 of 3 frames")
    example = doctest.DocTestParser().get_doctest(page, {}, "README.md", None, 0)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    assert runner.run(example).failed == 0 and len(example.examples) == 3


def test_the_instrument_file_that_is_shown_can_be_read(tmp_path):
    page = (ROOT / "docs" / "reference" / "files.md").read_text()
    [shown] = re.findall(r"^    starpos_instrument: 1\n(?:    .*\n)+", page, re.MULTILINE)
    path = tmp_path / "mine.yaml"
    path.write_text(re.sub(r"^    ", "", shown, flags=re.MULTILINE))
    assert instrument_file.read(path).inclinometer_model == "scl3300"
    assert [key for key in instrument_file.KEYS if not re.search(rf"\b{key}\b", page)] == []


@pytest.mark.parametrize("name", ["docs/tutorials/robot.md", "src/starpos_bringup/README.md"])
def test_the_parameters_of_a_file_that_is_shown_are_known(name):
    text = (ROOT / name).read_text()
    blocks = re.findall(r"^    /\*\*/(\w+):\n((?:      .*\n)+)", text, re.MULTILINE)
    assert blocks
    for node, block in blocks:
        named = flat(yaml.safe_load(re.sub(r"^      ", "", block, flags=re.MULTILINE))["ros__parameters"])
        assert set(named) - PARAMETERS[node] == set()

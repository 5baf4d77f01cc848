# SPDX-License-Identifier: Apache-2.0
"""The text of a node's executable for `--help`."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence

from starpos.session.parameter import Parameter
from starpos_common.parameters import yaml_value

WIDTH = 110
HOW = """A parameter is set with -p NAME:=VALUE, or in a FILE like config/starpos.yaml of starpos_bringup;
most also while the node runs: ros2 param set /{node} NAME VALUE. -r __ns:=/NAMESPACE moves its topics and services.
The README of {package} says what it hears and publishes.
"""


def node_help(package: str, executable: str, about: str, nodes: Mapping[str, Sequence[Parameter]]) -> str:
    """Write what an executable is, how its parameters are set, and each of them; nodes: the parameters of each node."""
    options = "[-p NAME:=VALUE]... [--params-file FILE] [-r FROM:=TO]..."
    usage = f"usage: ros2 run {package} {executable} [--ros-args {options}]"
    lines = [usage, "", about, "", HOW.rstrip().format(package=package, node=next(iter(nodes)))]
    for node, parameters in nodes.items():
        lines += ["", f"parameters of the node {node}:"]
        lines += [line for p in parameters for line in _lines(p)]
    return "\n".join(lines)


def _lines(parameter: Parameter) -> Iterator[str]:
    fixed = "; fixed while the node runs" if parameter.read_only else ""
    said = f"{parameter.description} Must be {parameter.constraint}{fixed}."
    yield f"  {parameter.name}: {yaml_value(parameter.default)}"
    yield textwrap.fill(said, WIDTH, initial_indent="      ", subsequent_indent="      ")

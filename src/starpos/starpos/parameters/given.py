# SPDX-License-Identifier: Apache-2.0
"""Values of the nodes' parameters from ROS's parameter files and NAME:=VALUE, without ROS."""

from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from starpos.errors import InstrumentError
from starpos.instrument import yaml_file
from starpos.parameters.table import defaults_of, parameters_of

# the nodes whose work is done without ROS; a text without a node is the first one's
NODES = ("solver", "detector", "inclinometer")
SOLVER = NODES[0]
WILDCARDS = ("*", "**")


def values_of(
    node: str, file: Path | None, given: Sequence[str], namespace: str | None = None
) -> dict[str, Any]:
    """The values of a node's parameters by name, as the node would have them.

    file: a parameter file, None for none.  given: texts [NODE:]NAME:=VALUE, which override it.
    namespace: the instrument's; None: any, if the file is of one instrument.
    Raises ParameterError if a value is not allowed, InstrumentError if something cannot be read, or is no parameter.
    """
    known = {p.name: p for p in parameters_of(node)}
    values = defaults_of(node)
    stated = [] if file is None else list(_in_file(file, node, namespace))
    stated += [(name, value) for whose, name, value in map(_assigned, given) if whose == node]
    for name, value in stated:
        # these are of every node
        if name.startswith("qos_overrides.") or name == "use_sim_time":
            continue
        if name not in known:
            near = get_close_matches(name, known, 1)
            meant = f"did you mean {near[0]}?" if near else f"they are {', '.join(known)}"
            raise InstrumentError(f"there is no parameter {name}: {meant}")
        values[name] = known[name].convert(value)
    return values


def of_solver(given: Sequence[str]) -> list[str]:
    """Select from the texts [NODE:]NAME:=VALUE the solver's own; raises InstrumentError for any other text."""
    return [text for text in given if _assigned(text)[0] == SOLVER]


def _assigned(text: str) -> tuple[str, str, Any]:
    """Node, name and value of a text [NODE:]NAME:=VALUE, as ROS's command line has them."""
    full, sign, value = text.partition(":=")
    node, colon, name = full.rpartition(":")
    if not sign:
        raise InstrumentError(f"{text}: write NAME:=VALUE, such as refraction.pressure:=95000.0")
    if colon and node not in NODES:
        raise InstrumentError(f"{text}: there is no node {node} here: {', '.join(NODES)}")
    return node or SOLVER, name, yaml_file.parse(value, f"{text}: not a readable value")


def _in_file(path: Path, node: str, namespace: str | None) -> Iterator[tuple[str, Any]]:
    """(name, value) of each parameter of a node, in the order of the file."""
    content = yaml_file.load(path, "parameter file")
    if not isinstance(content, Mapping):
        raise InstrumentError(f"{path}: no parameter file: it has no names of nodes")
    sections = [
        s for pattern, below in content.items() for s in _sections(path, node, _names(str(pattern)), below)
    ]
    if namespace is not None:
        full = [*_names(namespace), node]
        sections = [s for s in sections if _fits(s[0], full)]
    else:
        several = sorted({"/" + "/".join(names[:-1]) for names, _ in sections if _is_of_one(names)})
        if len(several) > 1:
            raise InstrumentError(
                f"{path}: it is of the instruments {', '.join(several)}: choose one with --namespace"
            )
    for _, parameters in sections:
        yield from _flat("", parameters)


def _names(path: str) -> list[str]:
    return [name for name in path.split("/") if name]


def _sections(path: Path, node: str, names: list[str], below: Any) -> Iterator[tuple[list[str], Any]]:
    """Go down the names of namespaces and nodes, which may be nested, to each `ros__parameters` of a node."""
    if not isinstance(below, Mapping):
        raise InstrumentError(f"{path}: {'/'.join(names)} has no ros__parameters")
    for key, value in below.items():
        if key != "ros__parameters":
            yield from _sections(path, node, [*names, *_names(str(key))], value)
        elif names and names[-1] in (node, *WILDCARDS):
            yield names, value


def _is_of_one(names: list[str]) -> bool:
    """Whether a section's names say of which instrument it is, and are no pattern for all."""
    return names not in (["*"], ["**"]) and not any(name in WILDCARDS for name in names[:-1])


def _fits(pattern: list[str], names: list[str]) -> bool:
    """Whether a pattern of a parameter file is of a node: * stands for one name, ** for any number of them."""
    if not pattern:
        return not names
    if pattern[0] == "**":
        return any(_fits(pattern[1:], names[k:]) for k in range(len(names) + 1))
    return bool(names) and pattern[0] in ("*", names[0]) and _fits(pattern[1:], names[1:])


def _flat(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(f"{prefix}.{key}" if prefix else str(key), inner)
    else:
        yield prefix, value

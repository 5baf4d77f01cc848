# SPDX-License-Identifier: Apache-2.0
"""The solver's parameters from ROS's parameter files and NAME:=VALUE, without ROS."""

from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from starpos.errors import InstrumentError
from starpos.instrument import yaml_file
from starpos.session.parameters import PARAMETERS
from starpos.session.settings import Settings

NODE = "solver"
WILDCARDS = ("*", "**")


def settings_of(file: Path | None, given: Sequence[str], namespace: str | None = None) -> Settings:
    """The Settings of a parameter file (None: none) and of texts NAME:=VALUE, which count more, as the node has them.

    namespace: that of the solver; None: whatever it is, if the file is of one instrument.
    Raises ParameterError if a value is not allowed, InstrumentError if something cannot be read, or is no parameter.
    """
    table = {p.name: p for p in PARAMETERS}
    values: dict[str, Any] = {p.name: p.default for p in PARAMETERS}
    told = ({} if file is None else dict(_in_file(file, namespace))) | dict(map(_assigned, given))
    for name, value in told.items():
        # qos_overrides, use_sim_time: they are of the node
        if name.startswith("qos_overrides.") or name == "use_sim_time":
            continue
        if name not in table:
            near = get_close_matches(name, table, 1)
            meant = f"did you mean {near[0]}?" if near else f"they are {', '.join(table)}"
            raise InstrumentError(f"there is no parameter {name}: {meant}")
        values[name] = table[name].convert(value)
    settings = Settings(values)
    if trouble := settings.check(values, frozenset(values), None):
        raise InstrumentError(trouble)
    settings.adopt()
    return settings


def _assigned(text: str) -> tuple[str, Any]:
    name, sign, value = text.partition(":=")
    if not sign:
        raise InstrumentError(f"{text}: write NAME:=VALUE, such as refraction.pressure:=95000.0")
    return name, yaml_file.parse(value, f"{text}: not a readable value")


def _in_file(path: Path, namespace: str | None) -> Iterator[tuple[str, Any]]:
    """(name, value) of each parameter of the solver, in the order of the file."""
    content = yaml_file.load(path, "parameter file")
    if not isinstance(content, Mapping):
        raise InstrumentError(f"{path}: no parameter file: it has no names of nodes")
    sections = [s for pattern, below in content.items() for s in _sections(path, _names(str(pattern)), below)]
    if namespace is not None:
        node = [*_names(namespace), NODE]
        sections = [s for s in sections if _fits(s[0], node)]
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


def _sections(path: Path, names: list[str], below: Any) -> Iterator[tuple[list[str], Any]]:
    """Go down the names of namespaces and nodes, which may be nested, to each `ros__parameters` of a solver."""
    if not isinstance(below, Mapping):
        raise InstrumentError(f"{path}: {'/'.join(names)} has no ros__parameters")
    for key, value in below.items():
        if key != "ros__parameters":
            yield from _sections(path, [*names, *_names(str(key))], value)
        elif names and names[-1] in (NODE, *WILDCARDS):
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

# SPDX-License-Identifier: Apache-2.0
"""Parameters of a node: declared with descriptors, refused with a sentence, applied once they are set, and explained."""

import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import rclpy.parameter
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node

from starpos.parameters.table import Parameter, ParameterError, parameters_of, yaml_value

INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1


def descriptor_of(p: Parameter) -> ParameterDescriptor:
    """Make its descriptor, without the range of ROS where the default is NaN, because that range would refuse NaN."""
    unit = f" [{p.unit}]" if p.unit else ""
    descriptor = ParameterDescriptor(
        name=p.name,
        type=rclpy.parameter.Parameter.Type.from_parameter_value(ros_value(p.default)).value,
        description=p.description + unit,
        additional_constraints=f"must be {p.constraint}",
        read_only=p.read_only,
    )
    bounded = p.minimum is not None or p.maximum is not None
    kind = type(p.default)
    if bounded and kind is int:
        first = INT64_MIN if p.minimum is None else int(p.minimum)
        last = INT64_MAX if p.maximum is None else int(p.maximum)
        descriptor.integer_range = [IntegerRange(from_value=first, to_value=last, step=0)]
    elif bounded and kind is float and not p.may_be_nan:
        low = -math.inf if p.minimum is None else float(p.minimum)
        high = math.inf if p.maximum is None else float(p.maximum)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    return descriptor


def ros_value(value: Any) -> Any:
    """Convert a value to the type that rclpy wants: a tuple to a list."""
    return list(value) if isinstance(value, tuple) else value


class Values(Mapping[str, Any]):
    """The present values of the parameters by name; a list is a tuple here."""

    def __init__(self, node: Node, table: Mapping[str, Parameter]) -> None:
        self._node = node
        self._table = table

    def __getitem__(self, name: str) -> Any:
        return self._table[name].convert(self._node.get_parameter(name).value)

    def __iter__(self) -> Iterator[str]:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)


def declare(
    node: Node,
    parameters: Sequence[Parameter],
    apply: Callable[[frozenset[str]], None] | None = None,
    check: Callable[[Mapping[str, Any], frozenset[str]], str | None] | None = None,
) -> Values:
    """Declare a node's parameters and return a live view of their values.

    apply: called with the names that were set, after a successful change at run time (not for the values at start-up).
    check: called with all values as they would be, and the names that are set (at start-up: all); returns a sentence if
    the values do not fit together, otherwise None.
    Raises ParameterError if a value given at start-up (command line, YAML) is not allowed.
    """
    table = {p.name: p for p in parameters}
    values = Values(node, table)
    for p in parameters:
        # Any type is accepted first: rclpy would refuse `5` for a float, and its errors name no constraint.
        node.declare_parameter(p.name, ros_value(p.default), ParameterDescriptor(dynamic_typing=True))
        value = p.convert(node.get_parameter(p.name).value)
        node.set_parameters([rclpy.parameter.Parameter(p.name, value=ros_value(value))])
        node.set_descriptor(p.name, descriptor_of(p))
    complaint = check(values, frozenset(table)) if check else None
    if complaint:
        raise ParameterError(complaint)

    def prepare(changes: list[rclpy.parameter.Parameter]) -> list[rclpy.parameter.Parameter]:
        return [_prepared(node, table[c.name], c) if c.name in table else c for c in changes]

    def validate(changes: list[rclpy.parameter.Parameter]) -> SetParametersResult:
        for change in changes:
            if isinstance(change, _Refused):
                return SetParametersResult(successful=False, reason=change.reason)
        wanted = {c.name: table[c.name].convert(c.value) for c in changes if c.name in table}
        try:
            reason = check({**values, **wanted}, frozenset(wanted)) if check and wanted else None
        except Exception as error:
            # A defect loses only this change; the node goes on.
            reason = f"the new values could not be checked ({type(error).__name__}: {str(error)[:200]})"
        return SetParametersResult(successful=not reason, reason=reason or "")

    def applied(changes: list[rclpy.parameter.Parameter]) -> None:
        names = frozenset(c.name for c in changes if c.name in table)
        if apply and names:
            apply(names)

    node.add_pre_set_parameters_callback(prepare)
    node.add_on_set_parameters_callback(validate)
    if apply:
        node.add_post_set_parameters_callback(applied)
    return values


def warn_of_unknown(nodes: Sequence[Node]) -> None:
    """Log a warning for each parameter that was given to a node of this process and that the node does not have.

    ROS drops such a parameter silently, and a mistyped one would stay at its default. `-p NAME:=VALUE` reaches every
    node of a process: if another node was given the parameter and has it, no warning is needed.
    Call it when all nodes are made.
    """
    for node in nodes:
        known = node.list_parameters([], 0).names
        for name in sorted(_given(node).keys() - known):
            if any(name in _given(other) and other.has_parameter(name) for other in nodes):
                continue
            from difflib import get_close_matches

            near = get_close_matches(name, known, 1)
            meant = f"did you mean {near[0]}?" if near else "see `ros2 param list` for those there are."
            node.get_logger().warning(f"there is no parameter {name}, it is ignored: {meant}")


def _given(node: Node) -> Mapping[str, Any]:
    # rclpy has no public access to what was given.
    return node._parameter_overrides


class _Refused(rclpy.parameter.Parameter):
    """Takes the place of a change that is not allowed, with the present value, until the change can be refused.

    Between the two callbacks rclpy checks types and ranges itself. Its messages lack the unit, and the name of a
    parameter of a wrong type; with the present value its checks pass, and `validate` refuses with our sentence.
    """

    def __init__(self, present: rclpy.parameter.Parameter, reason: str) -> None:
        super().__init__(present.name, present.type_, present.value)
        self.reason = reason


def _prepared(
    node: Node, parameter: Parameter, change: rclpy.parameter.Parameter
) -> rclpy.parameter.Parameter:
    """Convert a whole number to a float where the parameter is one, so that `ros2 param set ... 5` works."""
    try:
        return rclpy.parameter.Parameter(change.name, value=ros_value(parameter.convert(change.value)))
    except ParameterError as error:
        return _Refused(node.get_parameter(change.name), str(error))


WIDTH = 110
HOW = """A parameter is set with -p NAME:=VALUE, or in a FILE like config/starpos.yaml of starpos_bringup;
most also while the node runs: ros2 param set /{node} NAME VALUE. -r __ns:=/NAMESPACE moves its topics and services.
The README of {package} says what it hears and publishes.
"""


def node_help(package: str, executable: str, about: str, *nodes: str) -> str:
    """Write what an executable is, how the parameters of its nodes are set, and each of them."""
    options = "[-p NAME:=VALUE]... [--params-file FILE] [-r FROM:=TO]..."
    usage = f"usage: ros2 run {package} {executable} [--ros-args {options}]"
    lines = [usage, "", about, "", HOW.rstrip().format(package=package, node=nodes[0])]
    for node in nodes:
        lines += ["", f"parameters of the node {node}:"]
        lines += [line for p in parameters_of(node) for line in _lines(p)]
    return "\n".join(lines)


def _lines(parameter: Parameter) -> Iterator[str]:
    fixed = "; fixed while the node runs" if parameter.read_only else ""
    said = f"{parameter.description} Must be {parameter.constraint}{fixed}."
    yield f"  {parameter.name}: {yaml_value(parameter.default)}"
    yield textwrap.fill(said, WIDTH, initial_indent="      ", subsequent_indent="      ")

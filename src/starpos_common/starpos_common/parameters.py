# SPDX-License-Identifier: Apache-2.0
"""Parameters from one table: declared with descriptors, refused with a sentence, applied once they are set."""

import math
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import rclpy.parameter
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node

from starpos.errors import StarposError
from starpos_common.paths import LONGEST_PATH

INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1
# Characters of a text, as of a path. Nothing else limits what a caller may send.
LONGEST = LONGEST_PATH
SHOWN = reprlib.Repr()
SHOWN.maxstring = SHOWN.maxother = SHOWN.maxlist = SHOWN.maxtuple = 200


class ParameterError(StarposError):
    """A parameter has a value that is not allowed."""


@dataclass(frozen=True)
class Form:
    """Rule for a text. `constraint` is the rest of the sentence 'NAME must be ...'."""

    constraint: str
    fits: Callable[[str], bool]


FRAME_NAME = Form(
    "a frame's name, not empty, without blanks, control characters or a leading /",
    lambda text: text.isprintable() and " " not in text and text[:1] not in ("", "/"),
)


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    default      bool, int, float, str, or a tuple of one of these; it fixes the type, and the length of a tuple.
                 With a NaN default the parameter may be NaN, which means unset. Otherwise NaN is refused; infinity
                 is always refused.
    description  what it is, and what goes wrong when it is wrong
    unit         '' for a bare number or a text
    minimum, maximum   inclusive bounds of a number (of each number of a tuple); None: unbounded
    choices      the allowed values; () for any
    form         the rule for a text; None for any of up to LONGEST characters
    read_only    cannot be changed while the node runs
    """

    name: str
    default: Any
    description: str
    _: KW_ONLY
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple = ()
    read_only: bool = False
    form: Form | None = None

    @property
    def items(self) -> tuple:
        """The default as a tuple; a scalar gives a tuple of one."""
        return self.default if isinstance(self.default, tuple) else (self.default,)

    @property
    def may_be_nan(self) -> bool:
        return any(isinstance(item, float) and math.isnan(item) for item in self.items)

    @property
    def constraint(self) -> str:
        """The rest of the sentence 'NAME must be ...'."""
        kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
        text = kinds[type(self.items[0])]
        unit = f" {self.unit}" if self.unit else ""
        if self.choices:
            text = "one of " + ", ".join(map(str, self.choices))
        elif self.form:
            text = self.form.constraint
        elif self.minimum is not None and self.maximum is not None:
            text += f" from {self.minimum:g} to {self.maximum:g}{unit}"
        elif self.minimum is not None:
            text += f" of at least {self.minimum:g}{unit}"
        elif self.maximum is not None:
            text += f" of at most {self.maximum:g}{unit}"
        elif unit:
            text += f" in{unit}"
        if isinstance(self.default, tuple):
            text = f"{len(self.default)} values, each {text}"
        return text + (", or nan for unset" if self.may_be_nan else "")

    def convert(self, value: Any) -> Any:
        """Convert a value to this parameter's type (a whole number becomes a float where the default is one).

        Raises ParameterError with the constraint if the value is not allowed.
        """
        if isinstance(self.default, tuple) and not _is_large(value):
            sequence = not isinstance(value, (str, bytes)) and isinstance(value, (Sequence, memoryview))
            values = tuple(value) if sequence or hasattr(value, "tolist") else None
            if values is None or len(values) != len(self.default):
                raise self._error(value)
            return tuple(self._convert_item(item, value) for item in values)
        return self._convert_item(value, value)

    def _convert_item(self, item: Any, whole: Any) -> Any:
        kind = type(self.items[0])
        if kind is float and type(item) is int:
            item = float(item)
        if type(item) is not kind or _is_large(item) or (self.choices and item not in self.choices):
            raise self._error(whole)
        if self.form and not self.form.fits(item):
            raise self._error(whole)
        if kind is float and not math.isfinite(item):
            if math.isnan(item) and self.may_be_nan:
                return item
            raise self._error(whole)
        below = self.minimum is not None and item < self.minimum
        above = self.maximum is not None and item > self.maximum
        if kind in (int, float) and (below or above):
            raise self._error(whole)
        return item

    def _error(self, value: Any) -> ParameterError:
        if _is_large(value):
            what = "characters" if isinstance(value, (str, bytes)) else "values"
            shown = f"a value of {len(value)} {what}, over {LONGEST},"
        else:
            shown = SHOWN.repr(value.tolist() if hasattr(value, "tolist") else value)[:200]
        return ParameterError(f"parameter {self.name} must be {self.constraint}; {shown} was given.")

    def descriptor(self) -> ParameterDescriptor:
        """Make its descriptor, without the range of ROS where the default is NaN, because that range would refuse NaN."""
        unit = f" [{self.unit}]" if self.unit else ""
        descriptor = ParameterDescriptor(
            name=self.name,
            type=rclpy.parameter.Parameter.Type.from_parameter_value(self.ros_value(self.default)).value,
            description=self.description + unit,
            additional_constraints=f"must be {self.constraint}",
            read_only=self.read_only,
        )
        bounded = self.minimum is not None or self.maximum is not None
        kind = type(self.default)
        if bounded and kind is int:
            first = INT64_MIN if self.minimum is None else int(self.minimum)
            last = INT64_MAX if self.maximum is None else int(self.maximum)
            descriptor.integer_range = [IntegerRange(from_value=first, to_value=last, step=0)]
        elif bounded and kind is float and not self.may_be_nan:
            low = -math.inf if self.minimum is None else float(self.minimum)
            high = math.inf if self.maximum is None else float(self.maximum)
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
        return descriptor

    def ros_value(self, value: Any) -> Any:
        """Convert a value to the type that rclpy wants: a tuple to a list."""
        return list(value) if isinstance(value, tuple) else value


def _is_large(value: Any) -> bool:
    """Whether a text or an array is longer than any parameter's."""
    return hasattr(value, "__len__") and len(value) > LONGEST


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
        node.declare_parameter(p.name, p.ros_value(p.default), ParameterDescriptor(dynamic_typing=True))
        value = p.convert(node.get_parameter(p.name).value)
        node.set_parameters([rclpy.parameter.Parameter(p.name, value=p.ros_value(value))])
        node.set_descriptor(p.name, p.descriptor())
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
            # A defect costs this change only; the node goes on.
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
        return rclpy.parameter.Parameter(
            change.name, value=parameter.ros_value(parameter.convert(change.value))
        )
    except ParameterError as error:
        return _Refused(node.get_parameter(change.name), str(error))


def to_yaml(node_name: str, parameters: Sequence[Parameter]) -> str:
    """Write a parameter file with every default, each below a comment with its meaning, unit and constraint."""
    lines = ["# SPDX-License-Identifier: Apache-2.0", f"/**/{node_name}:", "  ros__parameters:"]
    for p in parameters:
        fixed = "; fixed while the node runs" if p.read_only else ""
        lines += [f"    # {p.description}", f"    # {p.name} must be {p.constraint}{fixed}."]
        lines.append(f"    {p.name}: {_yaml(p.default)}")
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, float):
        if math.isnan(value):
            return ".nan"
        # rcl's YAML parser reads 1e5, which has no point, as a text.
        return repr(value) if "e" not in repr(value) else f"{value:.17f}".rstrip("0")
    return str(value)

# SPDX-License-Identifier: Apache-2.0
"""The parameters that a node takes: name, default, meaning, unit and constraint of each, read from data/NODE.yaml."""

import math
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from starpos.errors import StarposError
from starpos.files import LONGEST_PATH, rows_of

NODES = ("camera", "detector", "inclinometer", "solver", "navigator", "dashboard")
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
# An empty address would silently mean every network of this machine.
ADDRESS = Form(
    "an address of this machine, such as 127.0.0.1, without blanks", lambda text: text.split() == [text]
)
FORMS = {"frame_name": FRAME_NAME, "address": ADDRESS}


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node: a row of its file, whose keys are these names.

    default      bool, int, float, str, or a tuple of one of these; it fixes the type, and the length of a tuple.
                 With a NaN default the parameter may be NaN, which means unset. Otherwise NaN is refused; infinity
                 is always refused.
    description  what it is, and what goes wrong when it is wrong
    unit         '' for a bare number or a text
    minimum, maximum   inclusive bounds of a number (of each number of a tuple); None: unbounded
    choices      the allowed values; () for any
    form         the rule for a text, in a file its name in FORMS; None for any of up to LONGEST characters
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
            text = "one of " + ", ".join(str(choice) or "''" for choice in self.choices)
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

    @property
    def rule(self) -> str:
        """The constraint, and whether the parameter is fixed, as a sentence."""
        return (
            f"{self.name} must be {self.constraint}{'; fixed while the node runs' if self.read_only else ''}."
        )

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
        fits = type(item) is kind and not _is_large(item) and (not self.choices or item in self.choices)
        if fits and self.form:
            fits = self.form.fits(item)
        elif fits and kind is float and not math.isfinite(item):
            fits = math.isnan(item) and self.may_be_nan
        elif fits and kind in (int, float):
            low, high = self.minimum, self.maximum
            fits = (low is None or item >= low) and (high is None or item <= high)
        if not fits:
            raise self._error(whole)
        return item

    def _error(self, value: Any) -> ParameterError:
        if _is_large(value):
            what = "characters" if isinstance(value, (str, bytes)) else "values"
            shown = f"a value of {len(value)} {what}, over {LONGEST},"
        else:
            shown = SHOWN.repr(value.tolist() if hasattr(value, "tolist") else value)[:200]
        return ParameterError(f"parameter {self.name} must be {self.constraint}; {shown} was given.")


def _is_large(value: Any) -> bool:
    """Whether a text or an array is longer than any parameter's."""
    return hasattr(value, "__len__") and len(value) > LONGEST


@cache
def parameters_of(node: str) -> tuple[Parameter, ...]:
    """The parameters of a node, in the order of its file.

    A row that is the name of another node stands for the row of the same name there.
    """
    rows = rows_of(Path(__file__).with_name("data") / f"{node}.yaml")
    return tuple(_parameter(name, row) for name, row in rows.items())


def defaults_of(node: str) -> dict[str, Any]:
    """The default values of a node's parameters, by name."""
    return {p.name: p.default for p in parameters_of(node)}


def _parameter(name: str, row: Any) -> Parameter:
    if isinstance(row, str):
        return next(p for p in parameters_of(row) if p.name == name)
    made = dict(row)
    if isinstance(made["default"], list):
        made["default"] = tuple(made["default"])
    if "form" in made:
        made["form"] = FORMS[made["form"]]
    return Parameter(name, **made | {"choices": tuple(made.get("choices", ()))})


def yaml_value(value: Any) -> str:
    """Write the value of a parameter as YAML that rcl reads."""
    if isinstance(value, tuple):
        return "[" + ", ".join(map(yaml_value, value)) + "]"
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

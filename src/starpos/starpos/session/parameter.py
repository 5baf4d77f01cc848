# SPDX-License-Identifier: Apache-2.0
"""A parameter of a node: its name, default, meaning, unit and constraint; a table of them is what a node takes."""

import math
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

from starpos.errors import StarposError
from starpos.files import LONGEST_PATH

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


def _is_large(value: Any) -> bool:
    """Whether a text or an array is longer than any parameter's."""
    return hasattr(value, "__len__") and len(value) > LONGEST

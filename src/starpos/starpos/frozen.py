# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses of the hot path, made in a third of the time."""

from dataclasses import MISSING, Field, fields
from typing import Any, TypeVar

T = TypeVar("T")


def at_once(cls: type[T]) -> type[T]:
    """Let a frozen dataclass set all its fields in one step: dataclasses call `object.__setattr__` for each.

    Its signature and all else stay. Fields with a factory, or that are not arguments, are not for it.
    """
    all_fields: tuple[Field[Any], ...] = fields(cls)  # type: ignore[arg-type]
    # those that need their names come last, as dataclasses have it
    by_name = [f for f in all_fields if f.kw_only]
    arguments = ["self", *(_argument(f) for f in all_fields if not f.kw_only)]
    arguments += ["*", *map(_argument, by_name)] if by_name else []
    values = ", ".join(f"{f.name!r}: {f.name}" for f in all_fields)
    after = "\n    self.__post_init__()" if hasattr(cls, "__post_init__") else ""
    made: dict[str, Any] = {"_default": {f.name: f.default for f in all_fields}, "_set": object.__setattr__}
    exec(f"def __init__({', '.join(arguments)}):\n    _set(self, '__dict__', {{{values}}}){after}", made)
    made["__init__"].__annotations__ = cls.__init__.__annotations__
    made["__init__"].__qualname__ = f"{cls.__qualname__}.__init__"
    cls.__init__ = made["__init__"]  # type: ignore[method-assign]
    return cls


def _argument(f: "Field[Any]") -> str:
    if f.default_factory is not MISSING or not f.init:
        raise TypeError(f"{f.name} has a factory, or is no argument")
    return f.name if f.default is MISSING else f"{f.name}=_default[{f.name!r}]"

# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses that set all fields at once are dataclasses like others."""

import contextlib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from dataclasses import KW_ONLY, FrozenInstanceError, dataclass, field, fields, is_dataclass, replace

import numpy as np
import pytest

from starpos.frozen import at_once
from starpos.instrument.inclinometer import Tilt


def made() -> type:
    @dataclass(frozen=True)
    class Value:
        first: int
        second: str = "two"
        _: KW_ONLY
        third: float
        fourth: tuple = ()

        def __post_init__(self) -> None:
            if self.first < 0:
                raise ValueError("below 0")

    return Value


Plain, Quick = made(), at_once(made())


@pytest.mark.parametrize("given", [((1,), {"third": 3.0}), ((1, "b"), {"third": 3.0, "fourth": (4,)})])
def test_it_holds_the_same_values(given):
    arguments, named = given
    assert vars(Quick(*arguments, **named)) == vars(Plain(*arguments, **named))
    assert inspect.signature(Quick) == inspect.signature(Plain)
    assert str(Quick(*arguments, **named)) == str(Plain(*arguments, **named))


@pytest.mark.parametrize(
    "wrong", [((), {"third": 3.0}), ((1, "b", 3.0), {}), ((1,), {"third": 3.0, "fifth": 5})]
)
def test_it_refuses_the_same_arguments(wrong):
    for made in Plain, Quick:
        with pytest.raises(TypeError, match="argument"):
            made(*wrong[0], **wrong[1])


def test_it_is_frozen_checked_and_replaced():
    value = Quick(1, third=3.0)
    with pytest.raises(FrozenInstanceError):
        value.first = 2
    with pytest.raises(ValueError, match="below 0"):
        Quick(-1, third=3.0)
    assert replace(value, third=4.0) == Quick(1, third=4.0) != value


def test_fields_with_a_factory_are_refused():
    @dataclass(frozen=True)
    class Value:
        several: list = field(default_factory=list)

    with pytest.raises(TypeError, match="factory"):
        at_once(Value)


@at_once
@dataclass(frozen=True)
class Held:
    name: str
    numbers: np.ndarray
    more: tuple = ()
    number: float = float("nan")


@pytest.mark.parametrize(
    ("one", "other", "equal"),
    [
        (Held("a", np.arange(3.0)), Held("a", np.arange(3.0)), True),
        (Held("a", np.arange(3.0)), Held("b", np.arange(3.0)), False),
        (Held("a", np.arange(3.0)), Held("a", np.arange(4.0)), False),
        (Held("a", np.array([1.0, np.nan])), Held("a", np.array([1.0, np.nan])), True),
        (Held("a", np.array(["x"])), Held("a", np.array(["x"])), True),
        (Held("a", np.zeros(2), (np.ones(2), 1)), Held("a", np.zeros(2), (np.ones(2), 1)), True),
        (Held("a", np.zeros(2), (np.ones(2), 1)), Held("a", np.zeros(2), (np.zeros(2), 1)), False),
        (Held("a", np.zeros(2)), Held("a", np.zeros(2), number=1.0), False),
        (Held("a", np.zeros(2)), "a", False),
        (Tilt(0.1, 0.2, np.eye(2), utc_unix_s=3.0), Tilt(0.1, 0.2, np.eye(2), utc_unix_s=3.0), True),
        (Tilt(0.1, 0.2, np.eye(2), utc_unix_s=3.0), Tilt(0.1, 0.2, 2 * np.eye(2), utc_unix_s=3.0), False),
    ],
)
def test_arrays_are_compared_by_what_they_hold(one, other, equal):
    assert (one == other) is equal
    assert (one != other) is not equal


def test_what_holds_an_array_has_no_hash():
    with pytest.raises(TypeError, match="unhashable"):
        hash(Held("a", np.zeros(2)))
    assert hash(Quick(1, third=3.0)) == hash(Quick(1, third=3.0))


PACKAGES = "starpos", "starpos_common", "starpos_camera", "starpos_inclinometer", "starpos_solver"


def dataclasses_with_arrays() -> list[type]:
    """All dataclasses of the product with a field that is an array, of modules that can be imported here."""
    found = []
    for name in PACKAGES:
        if importlib.util.find_spec(name) is None:
            continue
        package = importlib.import_module(name)
        for module in pkgutil.walk_packages(package.__path__, f"{name}."):
            # what needs ROS, or a camera's library, is not everywhere
            with contextlib.suppress(ImportError):
                if not module.name.endswith("__main__"):
                    importlib.import_module(module.name)
        made = [m for n, m in sys.modules.items() if n.partition(".")[0] == name]
        found += [
            k for m in made for k in vars(m).values() if isinstance(k, type) and k.__module__ == m.__name__
        ]
    return [k for k in found if is_dataclass(k) and any("ndarray" in str(f.type) for f in fields(k))]


def instance(cls: type, first: float) -> object:
    """One that holds arrays, which begin with a number, where it has arrays."""
    made = object.__new__(cls)
    for f in fields(cls):
        value = np.array([first, np.nan, 2.0]) if "ndarray" in str(f.type) else f.name
        object.__setattr__(made, f.name, value)
    return made


def test_every_dataclass_with_an_array_compares_by_value_or_has_no_comparison():
    every = dataclasses_with_arrays()
    assert len(every) > 100
    for cls in every:
        one, other = instance(cls, 1.0), instance(cls, 1.0)
        if cls.__eq__ is object.__eq__:
            assert one != other and hash(one) == hash(one)
            continue
        assert one == other and one != instance(cls, 3.0), cls
        assert cls.__hash__ is None, cls

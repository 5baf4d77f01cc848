# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses that set all fields at once are dataclasses like others."""

import inspect
from dataclasses import KW_ONLY, FrozenInstanceError, dataclass, field, replace

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

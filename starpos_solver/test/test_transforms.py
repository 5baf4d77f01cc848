# SPDX-License-Identifier: Apache-2.0
"""The instrument as a tree of frames, whatever names messages give them."""

from types import SimpleNamespace

import pytest

from starpos.instrument.instrument import Calibration, Instrument
from starpos.session.driver import name_in
from starpos_solver.publishing import transforms_of

INSTRUMENT = Instrument(1000.0, calibration=Calibration.of((0.4, -0.3, 35.0), (5.0,) * 3))


@pytest.mark.parametrize(
    ("camera", "inclinometer", "tree"),
    [
        ("camera", "tilt", [("link", "camera"), ("camera", "tilt")]),
        ("camera", "link", [("link", "camera")]),
        ("camera", "camera", [("link", "camera")]),
        ("link", "tilt", [("link", "tilt")]),
        ("link", "link", []),
        ("", "tilt", []),
        ("camera", "", [("link", "camera")]),
    ],
)
def test_each_frame_is_once_in_the_tree(camera, inclinometer, tree):
    found = transforms_of(INSTRUMENT, "link", camera, inclinometer)
    assert [(t.header.frame_id, t.child_frame_id) for t in found] == tree


@pytest.mark.parametrize(
    ("frame_id", "name"), [("rover/tilt", "rover/tilt"), ("/tilt", ""), ("a b", ""), ("a\n", ""), ("", "")]
)
def test_what_is_no_name_is_no_frame(frame_id, name):
    assert name_in(SimpleNamespace(header=SimpleNamespace(frame_id=frame_id))) == name

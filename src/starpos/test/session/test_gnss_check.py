# SPDX-License-Identifier: Apache-2.0
"""GNSS next to a fix: an impossible place is reported, and only if it is of the same time."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from fixes import T0, fix_at

from starpos.earth.vertical import Deflection
from starpos.fix.solution import Status
from starpos.session.driver import Now
from starpos.session.gnss import ComparedPlaces


def gnss(latitude_deg, longitude_deg, seconds=0.0):
    whole, part = divmod(round((T0 + seconds) * 1e6), 1_000_000)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="gps", stamp=SimpleNamespace(sec=whole, nanosec=part * 1000)),
        latitude=latitude_deg,
        longitude=longitude_deg,
        position_covariance=(np.eye(3) * 9.0).ravel(),
        position_covariance_type=2,
        status=SimpleNamespace(status=0),
    )


@pytest.mark.parametrize(
    ("latitude_deg", "seconds", "said"), [(40.0, 0.0, False), (56.0, 0.0, True), (56.0, 60.0, False)]
)
def test_a_place_that_cannot_be_is_said_with_its_distance(latitude_deg, seconds, said):
    fix = fix_at(0.0)
    answer = SimpleNamespace(fix=fix, status=Status.OK)
    check = ComparedPlaces()
    assert check.remark(answer, Deflection()) == ""
    check.receive(gnss(latitude_deg, math.degrees(fix.longitude), seconds), Now(None, 0.0))
    remark = check.remark(answer, Deflection())
    assert bool(remark) == said and (not said or "1.78e+06 m" in remark)

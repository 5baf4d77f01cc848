# SPDX-License-Identifier: Apache-2.0
"""A self-calibration that is switched off while its job works."""

from types import SimpleNamespace

import pytest

from starpos.session.calibrating import Calibrating
from starpos.session.driver import JobsInTurn, Outcome
from starpos.session.settings import Settings


@pytest.mark.parametrize("on", [True, False])
def test_it_takes_no_a3_and_begins_no_other_job_once_it_is_off(on, monkeypatch):
    settings, taken = Settings.of(None, [f"self_calibration:={str(on).lower()}"]), []
    made = Calibrating(settings, JobsInTurn(print), SimpleNamespace(), print, SimpleNamespace())
    made._again = True
    for name in ("_why_not", "_is_better", "_adopt_turned", "_turn_by_itself"):
        monkeypatch.setattr(
            made, name, lambda *a, name=name: taken.append(name) or name == "_is_better" or ""
        )
    made._turned_by_itself(Outcome(SimpleNamespace(calibrated=None)), made._era)
    assert taken == (["_why_not", "_is_better", "_adopt_turned", "_turn_by_itself"] if on else [])
    assert made._again is on

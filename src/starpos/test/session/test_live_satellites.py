# SPDX-License-Identifier: Apache-2.0
"""Satellites in a session: which frames are looked at, for how long the place holds, and how much it teaches."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos.session.driver import JobsInTurn, Level, Located
from starpos.session.satellites import TEACHES, LiveSatellites
from starpos.session.settings import Settings
from starpos_testing.skies import orbits

NIGHT = 1.6e9
STAMP = SimpleNamespace(sec=int(NIGHT), nanosec=0)


class Heard:
    """What was refused."""

    def __init__(self):
        self.refused = []

    def came(self, name):
        """A message that is sound."""

    def refuse(self, name, sentence):
        self.refused.append((name, sentence))


@pytest.fixture
def live(tmp_path):
    (tmp_path / "active.tle").write_text(orbits.drawn(3, 1, NIGHT - 86400)[1])
    settings = Settings.of(given=[f"satellites.elements:={tmp_path}", "satellites.window:=600.0"])
    live = LiveSatellites(settings, settings.orbits, JobsInTurn(print), Heard())
    return live


def placed(live):
    """Have it know a place."""
    fix = SimpleNamespace(latitude=0.8, longitude=0.1, covariance=np.diag([900.0, 1600.0, 400.0]))
    live._finish(Located(stamp=STAMP, trails=(SimpleNamespace(utc_unix_s=np.array([NIGHT])),), fix=fix))
    return fix


def test_one_place_teaches_what_one_place_knows(live):
    assert live.teaching(NIGHT) is None and not live.located
    fix = placed(live)
    taught = [live.teaching(NIGHT + k) for k in range(TEACHES + 5)]
    weights = [np.linalg.inv(place.covariance) for place in taught if place is not None]
    assert len(weights) == TEACHES
    assert sum(weights) == pytest.approx(np.linalg.inv(fix.covariance[:2, :2]))


def test_the_place_holds_for_its_window(live):
    placed(live)
    assert live.at(NIGHT + 590).latitude == 0.8 and live.at(NIGHT - 590).utc_unix_s == NIGHT - 590
    assert live.at(NIGHT + 610) is None
    live.forget()
    assert live.at(NIGHT) is None


def trail(**changes):
    ends, covariance = np.array([10.0, 20, 40, 60]), np.eye(4).ravel()
    return SimpleNamespace(**({"ends": ends, "covariance": covariance, "snr": 9.0, "flags": 0} | changes))


@pytest.mark.parametrize(
    "changes",
    [{"ends": np.full(4, 5.0)}, {"ends": np.array([np.nan, 0, 1, 1])}, {"covariance": -np.eye(4).ravel()}],
)
def test_a_trail_that_cannot_be_is_refused(live, changes):
    header = SimpleNamespace(stamp=STAMP)
    live.receive(SimpleNamespace(header=header, trails=[trail(**changes)]))
    ((name, sentence),) = live._driver.refused
    assert name == "trails" and "impossible" in sentence
    live.receive(SimpleNamespace(header=header, trails=[trail()]))
    # its stars have not come: nothing to look at
    assert live.fetch() == [] and not live._jobs.busy
    assert live.report().level is Level.WARN

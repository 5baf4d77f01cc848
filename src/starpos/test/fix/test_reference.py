# SPDX-License-Identifier: Apache-2.0
"""A night made by an independent program; skips where that is not at hand."""

import json
import subprocess
import sys

import numpy as np
import pytest

from starpos.averaging.average import average
from starpos.earth.refraction import Atmosphere
from starpos.fix.solver import Solver
from starpos.frames.reading import read_frame
from starpos.instrument.instrument import Instrument, focal_px_of
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.simulation.scene import scene_of
from starpos.units import ARCSEC


@pytest.fixture(scope="module")
def night(shared, tmp_path_factory):
    """Star lists from an independent simulator that rests on astropy's AltAz, nearly without tilt noise."""
    out = tmp_path_factory.mktemp("independent")
    # in the final table too (IERS B), all that astropy 6.0 looks at: a date beyond it would have UT1 = UTC there
    options = "--start 2025-11-02T18:00:00 --level stars -n 3 --tilt-noise 0.000001 --seed 11"
    options += " --lat -33.2 --lon 149.1 --azimuth 310 --altitude 85 --roll 200"
    command = [sys.executable, str(shared / "night" / "night.py"), str(out), *options.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return out


def test_a_night_made_by_others(night, catalogue):
    """The fix is within 0.3 arcsec in latitude and longitude and 3 arcsec in heading of what they put in."""
    truth = json.loads((night / "truth.json").read_text())
    mine = scene_of(pointing_deg=(310.0, 85.0, 200.0))
    assert np.degrees(mine.heading) == pytest.approx(truth["frames"][0]["heading_deg"], abs=1e-9)
    assert np.degrees(mine.tilt) == pytest.approx(truth["frames"][0]["theta_ideal_deg"], abs=1e-9)
    site, tilts = truth["site"], read_tilt_csv(night / "tilt.csv")
    solver = Solver(Instrument(focal_px_of(600.0, 6.4)), catalogue, Atmosphere.measured(88000.0, 12.0, 0.3))
    solved = [solver.solve(read_frame(path), tilts) for path in sorted(night.glob("centroids_*.csv"))]
    assert [s.message for s in solved] == ["fix"] * 3
    if solved[0].extrapolated_days > 0:
        pytest.skip("the IERS table that is installed ends before this night")
    for s, frame in zip(solved, truth["frames"], strict=True):
        assert s.fix.latitude == pytest.approx(np.radians(site["lat_deg"]), abs=0.3 * ARCSEC)
        east = (s.fix.longitude - np.radians(site["lon_deg"])) * np.cos(s.fix.latitude)
        assert abs(east) < 0.3 * ARCSEC
        assert s.fix.heading == pytest.approx(np.radians(frame["heading_deg"]), abs=3 * ARCSEC)
    together = average([s.fix for s in solved])
    assert together.latitude == pytest.approx(np.radians(site["lat_deg"]), abs=0.2 * ARCSEC)

# SPDX-License-Identifier: Apache-2.0
"""The IERS table as it is read here against astropy's own reader."""

import erfa
import numpy as np
from astropy.utils import iers
from astropy_iers_data import IERS_A_FILE

from starpos.earth import orientation


def test_it_is_what_astropy_reads():
    theirs, ours = iers.IERS_A.open(IERS_A_FILE), orientation._table()

    def column(name, unit):
        return np.ma.filled(theirs[name], np.nan).to_value(unit)[: len(ours.mjd)]

    known = np.isfinite(np.ma.filled(theirs["UT1_UTC_A"], np.nan).to_value("s"))
    assert len(ours.mjd) == np.flatnonzero(known)[-1] + 1
    np.testing.assert_array_equal(ours.mjd, column("MJD", "d"))
    np.testing.assert_allclose(ours.ut1_minus_tai + ours.tai_minus_utc, column("UT1_UTC_A", "s"), atol=1e-12)
    for mine, name in ((ours.pole_x, "PM_x_A"), (ours.pole_y, "PM_y_A")):
        np.testing.assert_allclose(mine, column(name, "rad"), rtol=1e-12)
    np.testing.assert_allclose(ours.ut1_sigma, np.maximum(column("e_UT1_UTC_A", "s"), 1e-5), rtol=1e-12)
    sigma = np.hypot(column("e_PM_x_A", "rad"), column("e_PM_y_A", "rad"))
    np.testing.assert_allclose(ours.pole_sigma, np.maximum(sigma, 1e-10), rtol=1e-12)


def test_its_age_counts_from_the_last_day_that_is_measured():
    theirs = iers.IERS_A.open(IERS_A_FILE)
    measured = theirs["MJD"][np.asarray(theirs["UT1Flag_A"]) == "I"].to_value("d")
    assert orientation.measured_until() == (measured[-1] - 40587) * 86400


def test_its_leap_seconds_are_those_of_erfa():
    table = orientation._table()
    for year, seconds in ((1973, 12), (1999, 32), (2017, 37), (2023, 37)):
        _, days = erfa.cal2jd(year, 6, 1)
        assert table.tai_minus_utc[int(days - table.mjd[0])] == seconds

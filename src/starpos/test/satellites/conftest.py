# SPDX-License-Identifier: Apache-2.0
"""astropy, against which satellites are tested, uses the table of the Earth's rotation that is installed."""

import pytest
from astropy.utils import iers


@pytest.fixture(scope="module", autouse=True)
def installed_table():
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        yield

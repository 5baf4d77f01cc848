# SPDX-License-Identifier: Apache-2.0
"""A kernel of JPL's form in place of ERFA's series: one that is written here, with each body at rest."""

import pickle
import struct

import numpy as np
import pytest

pytest.importorskip("jplephem")

import erfa
from jplephem.daf import DAF

from starpos.earth.orientation import earth_state
from starpos.errors import InstrumentError, TimeError
from starpos.sky.bodies import EARTH, ERFA, MOON, NAIF, JplKernel, body_at
from starpos.units import unix_of

WHEN = unix_of("2025-06-01T09:00:00")
DAYS = (earth_state(WHEN).year - 2000.0) * erfa.DJY
EMB = 3


def write_kernel(path, days=DAYS, without=()):
    """Each body where ERFA has it on one day, for 20 days: a degree 1 polynomial a component, as type 2 has them."""
    record = struct.pack("<8sii60siii8s603s28s297s", b"DAF/SPK ", 2, 6, b"test", 2, 2, 385, b"LTL-IEEE", b"",
                         b"FTPSTR:\r:\n:\r\n:\r\x00:\x81:\x10\xce:ENDFTP", b"")  # fmt: skip
    path.write_bytes(record + struct.pack("<ddd", 0, 0, 0).ljust(1024, b"\0") + b" " * 1024)
    earth = ERFA.earth_au(days)
    places = {number: (ERFA.body_au(name, days), 0) for name, number in NAIF.items()}
    # the Moon by way of the Earth and the barycentre of both, as in JPL's files
    places |= {
        EMB: (earth, 0),
        EARTH: (np.zeros(3), EMB),
        NAIF[MOON]: (ERFA.body_au(MOON, days) - earth, EMB),
    }
    begin, end = ((days + d) * 86400 for d in (-10, 10))
    with path.open("r+b") as file:
        daf = DAF(file)
        for number, (au, centre) in places.items():
            if number in without:
                continue
            one = [(begin + end) / 2, (end - begin) / 2, *(c for k in au * erfa.DAU / 1000 for c in (k, 0.0))]
            array = np.array([*one, begin, end - begin, len(one), 1])
            daf.add_array(b"test", (begin, end, number, centre, 1, 2), array)
    return path


def test_bodies_stand_where_the_kernel_has_them(tmp_path):
    kernel, state = JplKernel(str(write_kernel(tmp_path / "drawn.bsp"))), earth_state(WHEN)
    for name in NAIF:
        by_kernel, by_erfa = body_at(name, state, kernel), body_at(name, state)
        # at rest for the time of the light
        assert np.linalg.norm(by_kernel.itrs - by_erfa.itrs) < 3e-4
        assert by_kernel.sigma <= by_erfa.sigma
    moon = body_at(MOON, state, kernel), body_at(MOON, state)
    assert np.linalg.norm(moon[0].itrs - moon[1].itrs) < 2e-4
    assert moon[0].sigma < 0.01 * moon[1].sigma
    assert body_at(MOON, state, pickle.loads(pickle.dumps(kernel))).sigma == moon[0].sigma


def test_what_is_no_kernel_is_refused_in_a_sentence(tmp_path):
    broken = tmp_path / "broken.bsp"
    broken.write_bytes(b"no ephemeris" * 500)
    with pytest.raises(InstrumentError, match="no ephemeris in SPICE's format"):
        JplKernel(str(broken))
    with pytest.raises(InstrumentError, match="No such file"):
        JplKernel(str(tmp_path / "none.bsp"))
    with pytest.raises(InstrumentError, match="it lacks venus, the Earth"):
        JplKernel(str(write_kernel(tmp_path / "less.bsp", without=(NAIF["venus"], EARTH))))
    with pytest.raises(TimeError, match="does not hold this date"):
        body_at(MOON, earth_state(WHEN + 40 * 86400), JplKernel(str(write_kernel(tmp_path / "old.bsp"))))

# SPDX-License-Identifier: Apache-2.0
"""The URDF of the instrument has its links turned as the solver's /tf_static has."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos.instrument import instrument_file
from starpos.instrument.instrument import TOP_OF_FRAME, Calibration, Instrument
from starpos_solver.publishing import transforms_of
from starpos_testing.lacking import require

URDF = Path(__file__).parent.parent / "urdf" / "starpos.urdf.xacro"
NAMES = ("starpos_link", "starpos_camera_optical_frame", "starpos_inclinometer_frame")
# C's x is up: roll and yaw of the camera turn about one axis
ON_ITS_SIDE = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))


def joints(**arguments) -> dict[tuple[str, str], tuple[str, Rotation]]:
    """Origin and rotation of each joint, by parent and child."""
    require("xacro")
    import xacro

    document = xacro.process_file(str(URDF), mappings=arguments)
    found = {}
    for joint in ElementTree.fromstring(document.toxml()).iter("joint"):
        assert joint.attrib["type"] == "fixed"
        ends = joint.find("parent").attrib["link"], joint.find("child").attrib["link"]
        origin = joint.find("origin").attrib
        found[ends] = origin["xyz"], Rotation.from_euler("xyz", [float(a) for a in origin["rpy"].split()])
    return found


def file_of(folder, link, angles_deg) -> tuple[Instrument, str]:
    instrument = Instrument(5000.0, calibration=Calibration.of(angles_deg, (5.0,) * 3), link_to_camera=link)
    instrument_file.write(folder / "i.yaml", instrument)
    return instrument, str(folder / "i.yaml")


@pytest.mark.parametrize(
    ("link", "angles_deg"),
    [
        (TOP_OF_FRAME, (0.91, -0.48, 20.0)),
        (tuple(map(tuple, Rotation.from_euler("xyz", [0.3, -1.1, 2.2]).as_matrix())), (-170.0, 60.0, -100.0)),
        (ON_ITS_SIDE, (10.0, 90.0, 35.0)),
        (ON_ITS_SIDE, (10.0, -90.0, 35.0)),
    ],
)
def test_its_joints_are_turned_as_tf_static_says(link, angles_deg, tmp_path):
    instrument, path = file_of(tmp_path, link, angles_deg)
    made = joints(instrument=path, xyz="0.2 0 0.4", rpy="0 0 1.5")
    xyz, turned = made.pop(("base_link", "starpos_link"))
    assert xyz == "0.2 0 0.4" and np.allclose(turned.as_euler("xyz"), (0, 0, 1.5))
    wanted = {
        (t.header.frame_id, t.child_frame_id): [getattr(t.transform.rotation, axis) for axis in "xyzw"]
        for t in transforms_of(instrument, *NAMES)
    }
    assert set(made) == set(wanted)
    for ends, quaternion in wanted.items():
        assert (made[ends][1] * Rotation.from_quat(quaternion).inv()).magnitude() < 1e-7


def test_two_instruments_have_links_of_their_own_and_none_of_what_nobody_knows():
    made = joints(prefix="left_")
    assert set(made) == {
        ("base_link", "left_starpos_link"),
        ("left_starpos_link", "left_starpos_camera_optical_frame"),
    }

# SPDX-License-Identifier: Apache-2.0
"""Camera, detector and inclinometer on one computer, the solver on another: what the cable carries and what it may do."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from starpos.simulation.scene import scene_of
from starpos_interfaces.msg import Solution
from starpos_testing.graph import hosts
from starpos_testing.graph.link import FULL_FRAME_BYTES, TILT_RATE_HZ, start, traffic, two_hosts
from starpos_testing.graph.shots import FULL, SMALL
from starpos_testing.patience import WAIT_S
from starpos_testing.skies.bags import knowing

NIGHT = Path(__file__).parent / "data" / "night"
LOSSY = Path(__file__).parents[1] / "src" / "starpos_bringup" / "config" / "lossy_link.xml"
PATIENCE_S = 2 * WAIT_S
# 20 by default.
LEASE_S = 6
IMPATIENT = f"""<dds xmlns="http://www.eprosima.com"><profiles>
<participant profile_name="impatient" is_default_profile="true"><rtps><builtin><discovery_config>
<leaseDuration><sec>{LEASE_S}</sec></leaseDuration><leaseAnnouncement><sec>1</sec></leaseAnnouncement>
</discovery_config></builtin></rtps></participant></profiles></dds>"""


@pytest.fixture(autouse=True)
def namespaces(domain):
    hosts.need()


def play(instrument, folder: Path, together: bool) -> dict:
    """A recorded night with its detector on the mount, or all of it on the robot: solution and fix by stamp."""
    robot, ear = instrument.robot, instrument.ear
    mount = robot if together else instrument.mount
    truth = json.loads(NIGHT.with_suffix(".json").read_text())
    known = (*knowing(truth), "tilt_timeout:=5.0")
    robot.start(folder / "solver", "starpos_solver", "solver", *known)
    mount.start(folder / "detector", "starpos_camera", "detector", "use_sim_time:=true")
    arguments = (str(NIGHT), "--rate", "0", "--wait", "30")
    replay = mount.start(folder / "replay", "starpos_bringup", "replay", arguments=arguments)
    count = len(truth["frames"])
    instrument.wait(lambda: all(len(heard) == count for heard in ear.heard.values()))
    assert replay.wait() == 0, replay.output
    for solution in ear.solutions.values():
        assert solution.status == Solution.OK, solution.status_text
        solution.identify_seconds = solution.fix_seconds = 0.0
    return {stamp: (ear.solutions[stamp], ear.heard["fix"][stamp]) for stamp in sorted(ear.solutions)}


def test_two_computers_give_the_fixes_of_one_to_the_last_bit(tmp_path):
    found = []
    for k, together in enumerate((True, False)):
        folder = tmp_path / str(k)
        folder.mkdir()
        with two_hosts() as instrument:
            found.append(play(instrument, folder, together))
    one, two = found
    assert list(one) == list(two) and len(one) == 13
    for stamp, (solution, fix) in one.items():
        other, other_fix = two[stamp]
        for name in ("latitude", "longitude", "heading", "covariance", "stars_matched"):
            assert np.array_equal(getattr(solution, name), getattr(other, name)), (stamp, name)
        # Repr: NaN equals NaN.
        assert repr(solution) == repr(other) and repr(fix) == repr(other_fix)


def test_only_stars_and_tilts_cross_the_cable(tmp_path):
    # a quarter of the pixels has nearly as many stars
    seen = traffic(tmp_path, frames=3, cadence_s=1.0, quiet_s=4.0, size=(FULL[0] // 2, FULL[1] // 2))
    print(seen)
    # Bytes of the messages alone.
    star_bytes, tilt_bytes = 80 * seen.stars, 80 * TILT_RATE_HZ
    # on a busy machine lists of stars are under way that have no solution yet, at the begin or at the end
    assert star_bytes / 4 < seen.bytes_per_frame < FULL_FRAME_BYTES / 400
    assert tilt_bytes < seen.bytes_per_second < 10_000


def test_a_cable_that_is_pulled_and_plugged_in_again(tmp_path):
    profile = tmp_path / "impatient.xml"
    profile.write_text(IMPATIENT)
    with two_hosts(FASTRTPS_DEFAULT_PROFILES_FILE=str(profile)) as instrument:
        ear = instrument.ear
        start(instrument, tmp_path, SMALL, cadence_s=1.0)
        instrument.wait(lambda: len(ear.fixed) > 2)
        # after a longer time than its lease DDS gives up the other host
        for away_s in (LEASE_S / 2, LEASE_S + 2):
            instrument.mount.ip("link", "set", hosts.DEVICE, "down")
            pulled = divmod(time.time_ns(), 10**9)
            assert not ear.comes(lambda pulled=pulled: max(ear.solutions) > pulled, away_s)
            instrument.mount.ip("link", "set", hosts.DEVICE, "up")
            plugged = divmod(time.time_ns(), 10**9)
            instrument.wait(lambda plugged=plugged: len([s for s in ear.fixed if s > plugged]) > 2)
            first = next(s for s in ear.fixed if s > plugged)
            print(
                f"away {away_s:g} s: a fix again, of the frame {first[0] - plugged[0]} s after the plugging"
            )
        assert all(p.process.poll() is None for h in (instrument.mount, instrument.robot) for p in h.running)


def seconds_of(stamp: tuple[int, int]) -> float:
    return stamp[0] + stamp[1] * 1e-9


def test_a_link_that_loses_a_fifth_of_the_packets_costs_time_but_no_fix_is_wrong(tmp_path):
    """Each takes a tenth of a second, either way. Without the profile hardly one list of stars comes through whole."""
    cadence_s = 0.5
    with two_hosts(FASTRTPS_DEFAULT_PROFILES_FILE=str(LOSSY)) as instrument:
        ear = instrument.ear
        instrument.cable.loss, instrument.cable.delay_s = 0.2, 0.1
        start(instrument, tmp_path, SMALL, cadence_s, "tilt_timeout:=10.0")
        # They have met.
        instrument.wait(lambda: len(ear.fixed) > 1, seconds=PATIENCE_S)
        before = set(ear.solutions)
        instrument.wait(lambda: len(set(ear.solutions) - before) >= 10, seconds=PATIENCE_S)
        later = sorted(set(ear.solutions) - before)
        taken = 1 + round((seconds_of(later[-1]) - seconds_of(later[0])) / cadence_s)
        fixed = [s for s in later if s in ear.fixed]
        print(f"{taken} frames, {len(later)} came, {len(fixed)} fixes")
        # Without the profile a twelfth.
        assert len(fixed) > taken / 4
        for solution in (ear.solutions[stamp] for stamp in ear.fixed):
            off_m = (solution.latitude - scene_of().site.latitude_deg) * 111e3
            assert abs(off_m) < 5 * solution.covariance[4] ** 0.5


def test_a_network_without_multicast_takes_static_peers(tmp_path):
    with two_hosts(ROS_STATIC_PEERS=";".join(hosts.Cable.ADDRESSES)) as instrument:
        instrument.cable.multicast = False
        start(instrument, tmp_path, SMALL, cadence_s=1.0)
        instrument.wait(lambda: len(instrument.ear.fixed) > 1)
        # either side has called, and the cable carried no call: without the peers they would not have met
        assert min(instrument.cable.refused) > 0

# SPDX-License-Identifier: Apache-2.0
"""A session with the messages of a recorded night: what waits for what, and that only the data count."""

import math
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("rosbags")

from starpos.errors import InstrumentError
from starpos.fix.solution import Status
from starpos.messages.stamp import stamp_to_unix
from starpos.recording.bag import BagReader
from starpos.recording.topics import CAMERA_INFO, INPUTS, NAV_SAT_FIX, STARS, TILT, instrument_in
from starpos.session import reports
from starpos.session.driver import Answered, JobsInTurn, Level, Now, Sent
from starpos.session.replay import Replay
from starpos.session.session import SolverSession
from starpos.session.settings import Settings

NIGHT = Path(__file__).resolve().parents[4] / "test" / "data" / "night"
if not NIGHT.is_dir():
    pytest.skip("the recorded night is not beside this package", allow_module_level=True)
KNOWN = ("inclinometer.model:=sca100t_calibrated",
         "misalignment:=[0.31,-0.22,0.53]", "misalignment_stddev:=0.1", "refraction.pressure:=66000.0",
         "refraction.temperature:=-4.0", "refraction.humidity:=0.4")  # fmt: skip


class Said:
    """Keeps what a session says."""

    def __init__(self):
        self.refused, self.errors, self.warnings = [], [], []

    def came(self, name):
        pass

    def refuse(self, name, sentence):
        self.refused.append((name, sentence))

    def info(self, message):
        pass

    def warning(self, message):
        self.warnings.append(message)

    def error(self, message):
        self.errors.append(message)


NOTHING_TOLD = Sent()


class Told:
    """A session that receives messages, and its jobs, which are done when a test says so."""

    def __init__(self, *parameters):
        self.said, self.jobs = Said(), []
        self.session = SolverSession(Settings.of(None, (*KNOWN, *parameters)), self._new, self.said)

    def _new(self):
        self.jobs.append(JobsInTurn(self.said.error))
        return self.jobs[-1]

    def tell(self, kind, message, at_s, played=True, sent=NOTHING_TOLD):
        now = Now.in_data(at_s) if played else Now(at_s, at_s)
        return self.session.receive(kind, message, now, sent)

    def at(self, at_s):
        return self.session.at(Now.in_data(at_s))

    def work(self, at_s):
        for jobs in self.jobs:
            jobs.work()
        return self.at(at_s)


@pytest.fixture(scope="module")
def messages():
    """(type, message, time it was recorded at) of the night."""
    with BagReader(NIGHT, typed=True) as bag:
        chosen = instrument_in(bag, None, INPUTS)
        decoded = bag.decoded(chosen.connections)
        return [(c.msgtype, message, log_ns * 1e-9) for c, log_ns, message in decoded]


@pytest.fixture(scope="module")
def begin_s(messages):
    return messages[0][2]


def first(messages, kind):
    return next((message, at_s) for k, message, at_s in messages if k == kind)


@pytest.fixture
def told(messages, begin_s):
    """A session with its camera and its triangles."""
    told = Told()
    told.tell(CAMERA_INFO, first(messages, CAMERA_INFO)[0], begin_s)
    told.work(begin_s)
    return told


def tilts_of(messages, end_s):
    return [(message, at_s) for kind, message, at_s in messages if kind == TILT and at_s < end_s]


@pytest.mark.parametrize(("model", "times"), [("", 1), ("scl3300", 0)])
def test_that_nobody_has_named_the_inclinometer_is_said_once(model, times, messages, begin_s):
    told = Told(f"inclinometer.model:={model!r}")
    told.tell(CAMERA_INFO, first(messages, CAMERA_INFO)[0], begin_s)
    told.work(begin_s)
    said = [warning for warning in told.said.warnings if "model is not stated" in warning]
    assert len(said) == times and all("set inclinometer.model" in warning for warning in said)


def test_frames_have_the_names_of_messages_that_are_taken(told, messages, begin_s):
    tilt, came_s = first(messages, TILT)
    names = "starpos_camera_optical_frame", "starpos_inclinometer_frame"
    told.tell(TILT, tilt, came_s)
    assert (told.session.instrument.frame_id, told.session.tilts.frame_id) == names
    broken = deepcopy(tilt)
    broken.x, broken.header.frame_id = float("nan"), "elsewhere"
    told.tell(TILT, broken, came_s)
    no_camera = deepcopy(first(messages, CAMERA_INFO)[0])
    no_camera.k[0], no_camera.header.frame_id = float("nan"), "elsewhere"
    told.tell(CAMERA_INFO, no_camera, came_s)
    assert (told.session.instrument.frame_id, told.session.tilts.frame_id) == names


def test_a_frame_without_tilts_waits_by_the_clock_of_the_data(told, messages):
    stars, came_s = first(messages, STARS)
    assert told.tell(STARS, stars, came_s) == []
    assert told.at(came_s + 0.49) == []
    [answer] = told.at(came_s + 0.51)
    assert answer.solution.status is Status.NO_TILT


def test_a_frame_is_answered_with_its_last_tilt(told, messages):
    stars, came_s = first(messages, STARS)
    tilts = tilts_of(messages, came_s)
    assert told.tell(STARS, stars, came_s) == []
    made = []
    for tilt, _ in tilts:
        assert not made
        made = told.tell(TILT, tilt, came_s + 0.1)
        if made:
            break
    assert made[0].solution.ok and made[0].solution.tilt.samples == 5


def test_the_end_answers_what_waits(told, messages):
    stars, came_s = first(messages, STARS)
    told.tell(STARS, stars, came_s)
    [answer] = told.session.end(Now.in_data(came_s))
    assert answer.solution.status is Status.NO_TILT and not told.session.waits


def test_who_plays_a_night_again_after_one_that_was_broken_off_is_no_second_inclinometer(told, messages):
    for tilts in (tilts_of(messages, float("inf"))[:30], tilts_of(messages, float("inf"))[5:20]):
        # another process, whose numbers begin anew
        for number, (tilt, came_s) in enumerate(tilts, 1):
            told.tell(TILT, tilt, came_s, sent=Sent(number))
    assert told.said.refused == []


def test_a_clock_that_begins_anew_keeps_no_frame(told, messages):
    stars, came_s = first(messages, STARS)
    told.tell(STARS, stars, came_s)
    assert [type(made) for made in told.at(came_s - 100.0)] == [Answered]


def test_another_camera_counts_from_its_stamp_on_though_it_is_read_before(told, messages):
    stars, came_s = first(messages, STARS)
    info = deepcopy(first(messages, CAMERA_INFO)[0])
    info.header.stamp.sec += 5
    info.width, info.height = 1000, 700
    info.k[2], info.k[5] = 499.5, 349.5
    told.tell(CAMERA_INFO, info, came_s)
    for tilt, _ in tilts_of(messages, came_s):
        told.tell(TILT, tilt, came_s)
    made = told.tell(STARS, stars, came_s)
    assert made[0].solution.ok
    later = deepcopy(stars)
    later.header.stamp.sec += 5
    assert told.tell(STARS, later, came_s + 5.0) == []
    # its triangles are a job
    assert told.session.busy and told.session.instrument.camera.width == 1000


def test_live_another_camera_counts_at_once(told, messages, begin_s):
    info = deepcopy(first(messages, CAMERA_INFO)[0])
    info.width, info.k[2] = 1000, 499.5
    told.tell(CAMERA_INFO, info, begin_s, played=False)
    assert told.session.instrument.camera.width == 1000


def test_tilts_ahead_of_a_played_clock_wait_for_its_next_tick(told, messages, begin_s):
    tilt = deepcopy(tilts_of(messages, begin_s + 60.0)[0][0])
    tilt.header.stamp.sec += 5
    told.tell(TILT, tilt, begin_s)
    assert not told.said.refused and not len(told.session.tilts)
    told.at(begin_s + 5.0)
    assert len(told.session.tilts) == 1
    tilt.header.stamp.sec += 50
    told.tell(TILT, tilt, begin_s + 6.0)
    told.at(begin_s + 7.0)
    assert "in the future" in told.said.refused[0][1]


def answers_of(messages, delay):
    """The solutions of a night that turns, with jobs that are done a number of messages after they were begun."""
    told, made, left = Told("self_calibration:=true"), [], 0
    for kind, message, at_s in messages:
        made += told.tell(kind, message, at_s)
        if told.session.busy:
            left = left or delay
            left -= 1
            if not left:
                made += told.work(at_s)
    end = Now.in_data(messages[-1][2])
    made += told.session.end(end)
    while told.session.busy:
        made += told.work(end.unix_s)
        made += told.session.end(end)
    assert not told.said.errors
    return [m.solution for m in made if isinstance(m, Answered)], told.session.calibrating.found


@pytest.mark.montecarlo
def test_how_long_a_job_takes_does_not_matter_to_recorded_frames(messages):
    (quick, found), (slow, found_slowly) = answers_of(messages, 1), answers_of(messages, 120)
    assert found is not None and found == found_slowly
    assert len(quick) == len(slow) == 10
    for a, b in zip(quick, slow, strict=True):
        assert (a.status, a.fix and a.fix.latitude, a.fix and a.fix.longitude) == (
            b.status,
            b.fix and b.fix.latitude,
            b.fix and b.fix.longitude,
        )


def test_a_replay_twice_is_the_same():
    def played():
        said = Said()
        return [repr(replace(m, stamp=None)) for m in Replay(Settings.of(None, KNOWN), said).play(NIGHT)]

    first = played()
    assert first == played() and len(first) == 10


def test_tilts_stamped_before_their_time_are_refused_though_they_are_read_when_it_has_come(messages):
    """The solver's process stood still: by its own clock they are no longer of the future."""
    told, count = Told(), 0
    for kind, message, at_s in messages:
        if kind == TILT:
            stamp_s = stamp_to_unix(message.header.stamp)
            told.tell(
                kind, message, at_s, played=False, sent=Sent(unix_s=stamp_s - (3.0 if count % 2 else -0.1))
            )
            count += 1
    assert len(told.session.tilts) == (count + 1) // 2 > 0


SITE = ("site.latitude:=46.5475", "site.longitude:=7.9852")


def seen_at(messages, begin_s, *parameters):
    told = Told(*parameters)
    told.tell(CAMERA_INFO, first(messages, CAMERA_INFO)[0], begin_s)
    told.work(begin_s)
    return told


def gnss_fix(stars, **changed):
    about = {
        "latitude": 46.5475,
        "longitude": 7.9852,
        "position_covariance": [4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0],
    }
    return SimpleNamespace(
        header=stars.header, status=SimpleNamespace(status=0), position_covariance_type=2, **(about | changed)
    )


def test_at_a_site_a_frame_has_its_heading_at_once_and_no_fix(messages, begin_s):
    told = seen_at(messages, begin_s, *SITE)
    stars, came_s = first(messages, STARS)
    [answer] = told.tell(STARS, stars, came_s)
    solution = answer.solution
    assert solution.fix is None and solution.status is Status.NO_TILT and answer.ground is None
    assert math.degrees(solution.at_place.plumb.heading) == pytest.approx(195.31952, abs=2e-3)
    assert answer.attitude is not None
    report = reports.of_solution(solution, told.session.pace.counts)
    assert report.level is Level.OK and "heading at the known place" in report.message


def test_at_a_site_tilts_make_a_fix_too(messages, begin_s):
    told = seen_at(messages, begin_s, *SITE)
    stars, came_s = first(messages, STARS)
    for tilt, _ in tilts_of(messages, came_s + 5.0):
        told.tell(TILT, tilt, came_s)
    [answer, *_] = told.tell(STARS, stars, came_s)
    assert answer.solution.ok and answer.solution.fix is not None and answer.solution.at_place is not None


def test_a_site_that_the_stars_contradict_gives_a_sentence_and_no_heading(messages, begin_s):
    told = seen_at(messages, begin_s, "site.latitude:=-46.5475", "site.longitude:=7.9852")
    stars, came_s = first(messages, STARS)
    [answer] = told.tell(STARS, stars, came_s)
    assert answer.solution.at_place is None and "check latitude and longitude" in answer.solution.message


def test_half_a_site_is_refused():
    settings = Settings.of(None, KNOWN)
    said = settings.check(settings.values | {"site.latitude": 46.0}, frozenset({"site.latitude"}))
    assert "belong together" in said


def test_the_place_of_a_heading_may_be_that_of_gnss(messages, begin_s):
    told = seen_at(messages, begin_s, "gnss.use:=true")
    stars, came_s = first(messages, STARS)
    told.session.receive(NAV_SAT_FIX, gnss_fix(stars), Now.in_data(came_s))
    [answer] = told.tell(STARS, stars, came_s)
    at_place = answer.solution.at_place
    assert math.degrees(at_place.ellipsoid.heading) == pytest.approx(195.31952, abs=2e-3)
    # the deflection is not known, and GNSS has the place on the ellipsoid
    assert at_place.ellipsoid.angles_covariance[0, 0] < 0.3 * at_place.plumb.angles_covariance[0, 0]
    later = deepcopy(stars)
    later.header.stamp.sec += 30
    [answer] = told.tell(STARS, later, came_s + 30.0)
    assert answer.solution.at_place is None and "no GNSS place within 3 s" in answer.solution.message


def test_gnss_without_a_fix_is_no_place(messages, begin_s):
    told = seen_at(messages, begin_s, "gnss.use:=true")
    stars, came_s = first(messages, STARS)
    told.session.receive(NAV_SAT_FIX, gnss_fix(stars, latitude=float("nan")), Now.in_data(came_s))
    lost = gnss_fix(stars)
    lost.status = SimpleNamespace(status=-1)
    told.session.receive(NAV_SAT_FIX, lost, Now.in_data(came_s))
    [answer] = told.tell(STARS, stars, came_s)
    assert answer.solution.at_place is None


def test_gnss_is_an_input_with_gnss_use_alone():
    without = Told().session
    assert without.inputs == INPUTS and without.gnss is None
    assert Told("gnss.use:=true").session.inputs == INPUTS | {"gnss/fix": NAV_SAT_FIX}


@pytest.mark.parametrize(
    "part, named",
    [
        ("gyro.predicted", ""),
        ("_search.solve", "the solver failed on this frame (RuntimeError: a defect)"),
        ("doubt.judge", "the solver failed on this frame"),
        ("gyro.learn_from", ""),
        ("deflection.include", ""),
        ("calibrating.include", ""),
        ("gnss.solve", "what GNSS taught could not be used on this frame"),
    ],
)
def test_a_defect_in_any_part_loses_only_what_that_part_makes(messages, monkeypatch, part, named):
    """The parts are broken one after another, so that a part without a guard shows."""
    told = Told(*(("gnss.use:=true",) if part.startswith("gnss") else ()))
    owner, name = part.split(".") if "." in part else (None, part)
    of = getattr(told.session, owner)
    whole, broken = getattr(of, name), iter([True])

    def breaks_once(*arguments, **named):
        if next(broken, False):
            raise RuntimeError("a defect")
        return whole(*arguments, **named)

    monkeypatch.setattr(of, name, breaks_once)
    answers = []
    for kind, message, at_s in messages:
        answers += [a for a in told.tell(kind, message, at_s) if isinstance(a, Answered)]
        answers += [a for a in told.work(at_s) if isinstance(a, Answered)]
    first, *others = [a.solution for a in answers]
    assert len(told.said.errors) == 1 and "RuntimeError: a defect" in told.said.errors[0]
    assert named in first.message and first.ok == (not named)
    assert others and all(a.found is not None for a in others)


def test_an_ephemeris_that_cannot_be_read_is_refused_with_a_sentence(tmp_path):
    broken = tmp_path / "de440s.bsp"
    broken.write_bytes(b"DAF/SPK " + bytes(1016))
    pytest.importorskip("jplephem")
    for path, said in ((broken, "no ephemeris"), (tmp_path / "none.bsp", "none.bsp")):
        with pytest.raises(InstrumentError, match=said):
            Settings.of(None, [f"ephemeris:={path}"])

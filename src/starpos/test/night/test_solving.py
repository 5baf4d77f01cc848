# SPDX-License-Identifier: Apache-2.0
"""The driver of a night: frames solved one by one, by turning or compared with GNSS; failures and remarks."""

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from starpos.earth.place import Place
from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, InstrumentError
from starpos.fix import searching
from starpos.fix.searching import Sight
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.gnss.receiver import GnssTrack
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.tilt_log import NO_TILTS, TiltsByTime
from starpos.night.reading import Instruments
from starpos.night.remarks import worth_saving
from starpos.night.solving import ONE_BY_ONE, Exposures, How, answers_of, solved_night
from starpos.night.together import Gathered, together, turned
from starpos.night.work import Solving
from starpos.rotation import about_axis
from starpos_testing.skies.scenes import (
    AIR,
    EXPOSURE,
    FOCAL_PX,
    START,
    random_stars,
    stars_of,
    tilt_of,
    wide_scene,
)

KNOWN = Calibration.of((0.0, 0.0, 0.0), (5.0, 5.0, 5.0))
UNREADABLE = FrameError("broken.fits: no frame")
HEADINGS_DEG = (40.0, 130.0, 220.0, 310.0)


class Frames:
    """Star lists of frames a minute apart, with their tilts; the azimuth of each is given."""

    def __init__(self, catalogue, azimuths_deg, calibration=KNOWN, **scene):
        rng = np.random.default_rng(3)
        self.scene = wide_scene(misalignment_deg=(0.0, 0.0, 0.0), **scene)
        self.instrument = replace(self.scene.instrument, calibration=calibration)
        self.stars, tilts = [], {}
        for k, azimuth_deg in enumerate(azimuths_deg):
            turned, start = replace(self.scene, azimuth_deg=azimuth_deg), START + 60.0 * k
            self.stars.append(stars_of(turned, catalogue, rng, start))
            tilts[start + EXPOSURE / 2] = tilt_of(turned, rng, start)
        self.work = Solving(Instruments(self.instrument), atmosphere=AIR, tilts=TiltsByTime(tilts))

    def sights(self, how=ONE_BY_ONE, items=None):
        """The sights of the frames, or of other items, by name."""
        work = how.work(self.work)
        for k, item in enumerate(self.stars if items is None else items):
            yield f"frame {k}", item if isinstance(item, FrameError) else work(item)

    def answers(self, how=ONE_BY_ONE, items=None):
        return answers_of(self.sights(how, items), self.work, Deflection(), how)

    def exposures(self, items=None):
        given = self.stars if items is None else items
        return Exposures(
            name="night",
            origin="made here",
            count=len(given),
            each=lambda work: (
                (f"frame {k}", item if isinstance(item, FrameError) else work(item))
                for k, item in enumerate(given)
            ),
            work=self.work,
            vertical=Deflection(),
        )

    def is_here(self, place):
        """Whether a place is the scene's within four of its sigma."""
        site = self.scene.site
        off = np.radians([site.longitude_deg, site.latitude_deg]) - [place.longitude, place.latitude]
        off *= 6.37e6 * np.array([np.cos(place.latitude), 1.0])
        return bool((np.abs(off) < 4 * np.sqrt(np.diag(place.covariance)[:2])).all())


@pytest.fixture(scope="module")
def still(catalogue):
    return Frames(catalogue, 3 * [40.0])


@pytest.fixture(scope="module")
def turning(catalogue):
    return Frames(catalogue, HEADINGS_DEG, Calibration())


@pytest.fixture
def points(rng):
    return random_stars(30, rng, mid_unix_s=START + EXPOSURE / 2)


def test_each_frame_is_answered_in_order_as_soon_as_it_is_there(still):
    taken = []

    def sights():
        for row in still.sights():
            taken.append(row[0])
            yield row

    answers = answers_of(sights(), still.work, Deflection())
    assert answers.given is answers.instrument is still.instrument
    first = next(iter(answers.each))
    assert taken == [first.name] == ["frame 0"] and first.solution.ok and first.stars is still.stars[0]


def test_a_frame_that_is_not_identified_is_looked_for_where_the_last_one_looked(still, monkeypatch):
    few = still.stars[1].select(np.arange(0, 60, 15))
    lost, after = still.work(few), still.work(still.stars[0]).solution.hint
    assert lost.solution.lost
    found = still.work.after(lost, after)
    assert found.solution.found is not None and found.stars is few
    answers = list(still.answers(items=[still.stars[0], few]).each)
    assert answers[1].solution.found.star.tolist() == found.found.star.tolist()
    # not before any was identified, and not without a tilt
    assert next(iter(still.answers(items=[few]).each)).solution.lost
    assert replace(still.work, tilts=None).after(lost, after) is lost


def test_points_are_no_stars_though_the_last_frame_was_near(still, points):
    answers = list(still.answers(items=[still.stars[0], points]).each)
    assert [a.solution.status for a in answers] == [Status.OK, Status.NOT_IDENTIFIED]


@pytest.mark.parametrize("how", [ONE_BY_ONE, How(180.0), How(gnss=GnssTrack([]))])
def test_a_file_that_cannot_be_read_costs_its_own_answer_alone(how, still):
    items = [UNREADABLE, still.stars[0], UNREADABLE]
    answers = list(still.answers(how, items).each)
    assert [a.name for a in answers] == ["frame 0", "frame 1", "frame 2"]
    assert [a.readable for a in answers] == [False, True, False]
    assert answers[0].solution.message == str(UNREADABLE) and answers[1].stars is still.stars[0]


@pytest.mark.parametrize("how", [How(180.0), How(gnss=GnssTrack([]))])
def test_frames_solved_together_are_only_identified_before(how, still):
    work = how.work(still.work)
    assert (work.tilts, work.places) == (None, None) and ONE_BY_ONE.work(still.work) is still.work
    nothing = still.answers(how, [UNREADABLE])
    assert (nothing.instrument, nothing.turned, nothing.watched) == (None, None, None)


def test_turning_finds_a3_and_says_what_it_rests_on(turning):
    answers = turning.answers(How(180.0))
    assert answers.given is None and answers.turned.fixes
    assert answers.instrument is answers.turned.instrument
    gathered = Gathered()
    for answer in answers.each:
        gathered.gather(answer)
    assert len(gathered.solved) == len(HEADINGS_DEG)
    assert turning.is_here(together(gathered, None).average)


def test_a_frame_that_no_way_identified_is_not_searched_again_while_turning(turning, points, monkeypatch):
    how = How(180.0)
    sights = [*turning.sights(how), *turning.sights(how, [points])]
    monkeypatch.setattr("starpos.fix.solver.identify", None)
    answers = list(answers_of(sights, turning.work, Deflection(), how).each)
    assert [a.solution.ok for a in answers] == [True] * len(HEADINGS_DEG) + [False]
    assert (
        answers[-1].solution is sights[-1][1].solution or answers[-1].solution.status is Status.NOT_IDENTIFIED
    )


def test_beside_gnss_nothing_that_is_identified_or_lost_is_searched_again(still, points, monkeypatch):
    site = still.scene.site
    place = Place.on_ellipsoid(site.latitude_deg, site.longitude_deg, Deflection(0.0, 0.0, 0.0))
    how = How(gnss=_Standing(place))
    sights = [*still.sights(how), *still.sights(how, [points])]
    monkeypatch.setattr("starpos.fix.solver.identify", None)
    answers = answers_of(sights, still.work, Deflection(), how)
    rows = list(answers.each)
    assert answers.watched.answers[0] is rows[0].watched and rows[-1].solution.lost
    assert [a.solution.at_place is not None or a.solution.fix is not None for a in rows] == [
        True,
        True,
        True,
        False,
    ]


class _Standing:
    """A receiver that is never anywhere else, and says nothing."""

    def __init__(self, place):
        self.place = place

    def at(self, utc_unix_s):
        return None


def test_turning_with_nothing_identified_keeps_each_sentence(still, points):
    lost = Solving(Instruments(still.instrument))(points)
    solver = Solver(still.instrument, still.work.solver(points).catalogue)
    found, _ = turned(solver, [lost, lost], still.work.tilts, 180.0)
    assert found.solutions == (lost.solution, lost.solution) and not worth_saving(found)


def test_the_remark_of_a_wrong_header_outlives_the_turn(turning):
    how = How(180.0)
    rows = list(turning.sights(how))
    name, sight = rows[1]
    rows[1] = name, replace(sight, solution=replace(sight.solution, remark="its header is wrong"))
    answers = list(answers_of(rows, turning.work, Deflection(), how).each)
    assert [a.solution.remark for a in answers] == ["", "its header is wrong", "", ""]


def test_what_a_night_comes_to_is_gathered(still, points):
    night, kept = still.answers(items=[UNREADABLE, points, *still.stars]), Gathered()
    for answer in night.each:
        kept.gather(answer)
    assert kept.unreadable and kept.lost is points and len(kept.solved) == 3
    assert not kept.headings and not kept.warnings
    # only what an average takes is kept
    assert not len(kept.solved[0].fix.used) and len(kept.solved[0].names) > 20


def test_a_solved_night(still, points):
    shown = []
    night = solved_night(
        still.exposures([*still.stars, UNREADABLE]), progress=lambda what, done: shown.append(done)
    )
    assert still.is_here(night.combined) and len(night.fixed) == 3 and shown[-1] == 1.0
    assert night.shots[-1].message == str(UNREADABLE) and night.why_not == ""
    assert night.steady.shape == (3, 3)
    none = solved_night(still.exposures([points, points]))
    assert none.combined is None and "none of its 2 frames gave a fix" in none.why_not


def test_a_night_without_a_fix_says_which_focal_length_fits(catalogue, still):
    frames = Frames(catalogue, [40.0])
    wrong = replace(frames.instrument, focal_px=1.2 * FOCAL_PX)
    frames.work = replace(frames.work, instruments=Instruments(wrong))
    said = " ".join(solved_night(frames.exposures()).remarks)
    (focal_px,) = map(float, re.findall(r"a focal length of (\d+) px fits", said))
    assert focal_px == pytest.approx(FOCAL_PX, rel=1e-3)


def test_without_a_focal_length_a_frame_is_refused_or_searched_at_every_scale(still, monkeypatch):
    stars = replace(still.stars[0], focal_px=None)
    with pytest.raises(InstrumentError, match="no focal length"):
        Solving(Instruments(None))(stars)
    blind = Sight(stars, Solution.failed(stars, Status.NOT_IDENTIFIED, "searched"))
    monkeypatch.setattr("starpos.fix.searching.identify_blind_every_way", lambda *_: blind)
    assert Solving(Instruments(None), search_s=1.0)(stars).solution is blind.solution


@pytest.mark.parametrize("tilts", [None, NO_TILTS], ids=["none asked for", "missing"])
def test_at_a_known_place_a_frame_without_a_tilt_has_its_heading(still, tilts):
    site = still.scene.site
    place = Place.by_gravity(site.latitude_deg, site.longitude_deg, Deflection())
    answer = replace(still.work, tilts=tilts, places=place)(still.stars[0]).solution
    assert answer.fix is None and answer.at_place is not None
    assert answer.ok == (tilts is None)


def test_an_unknown_a3_is_no_calibration_worth_saving(still):
    """One heading does not determine A3."""
    unknown = Instrument(FOCAL_PX)
    solver = Solver(unknown, still.work.solver(still.stars[0]).catalogue, AIR)
    sights = [searching.answer_frame(solver, searching.Question(item=s, stars=s)) for s in still.stars]
    assert not worth_saving(turned(solver, sights, still.work.tilts, 180.0)[0])


def test_a_worker_is_not_sent_the_solver_and_its_catalogue(catalogue, rng):
    stars = random_stars(9, rng)
    work = Solving(Instruments(Instrument(FOCAL_PX)))
    before = len(pickle.dumps(work))
    assert work.solver(stars) is work.solver(stars)
    assert len(pickle.dumps(work)) == before


def sized(stars, width=800, height=600):
    """The stars of a part of a frame, as of another camera."""
    return replace(
        stars.select(np.flatnonzero((stars.x < width - 1) & (stars.y < height - 1))),
        width=width,
        height=height,
    )


@pytest.mark.parametrize(
    "how", [ONE_BY_ONE, How(180.0), How(gnss=GnssTrack([]))], ids=["alone", "turning", "gnss"]
)
@pytest.mark.parametrize("k", [0, 1])
def test_a_frame_of_another_size_costs_its_own_answer_alone(catalogue, how, k):
    """A frame of a bag ended the whole night, with a sentence on a header that it has not."""
    frames = Frames(catalogue, 3 * [40.0])
    given, _ = Instruments(frames.instrument).framed(frames.stars[0])
    cameras = {(1000, 700): frames.instrument.camera_for(1000, 700)}
    items = [*frames.stars[:k], sized(frames.stars[1]), *frames.stars[k:]]
    for instruments, said in (
        (given, "of 1000 x 700 px"),
        (replace(given, cameras=cameras, any_size=False), "no camera_info"),
    ):
        frames.work = replace(frames.work, instruments=instruments)
        night = solved_night(frames.exposures(items), how)
        assert [s.status is Status.OK for s in night.shots] == [j != k for j in range(4)]
        assert said in night.shots[k].message and frames.is_here(night.combined)


def test_a_sensor_that_hangs_has_the_same_steady_places(catalogue):
    """X' and Y' alone say that it stands: its places lay on the other hemisphere."""
    hanging, frames = about_axis(0, np.pi), Frames(catalogue, 3 * [40.0])
    tilts = {}
    for at, tilt in frames.work.tilts.tilts.items():
        x, y, z = np.arcsin(hanging @ tilt.up)
        tilts[at] = replace(tilt, theta_x=x, theta_y=y, theta_z=z)
    known = replace(frames.instrument, calibration=KNOWN.turned_to(hanging @ KNOWN.a3))
    frames.work = replace(frames.work, instruments=Instruments(known), tilts=TiltsByTime(tilts))
    night = solved_night(frames.exposures())
    here = [night.combined.latitude, night.combined.longitude, night.combined.heading]
    assert np.abs(night.steady - here).max() < np.radians(0.01)


def mixed(still, points, name):
    """The frames of a night at rest, as they may come, and how many of them have a fix."""
    s = still.stars
    untimed = replace(s[1], mid_unix_s=None)
    late = replace(s[2], mid_unix_s=s[2].mid_unix_s + 3600)
    return {
        "one": ([s[0]], 1),
        "none": ([], 0),
        "the other way round": (s[::-1], 3),
        "one of them three times": ([s[0]] * 3, 3),
        "half of them not found": ([points, s[0], points, s[1], UNREADABLE, s[2]], 3),
        "nothing but points": ([points] * 3, 0),
        "one without a time": ([s[0], untimed, s[2]], 2),
        "tilts that end": ([s[0], s[1], late], 2),
        "a hundred points and one frame": ([*[points.select(np.arange(3))] * 100, s[0]], 1),
    }[name]


NAMES = ["one", "none", "the other way round", "one of them three times", "half of them not found", "nothing but points",
         "one without a time", "tilts that end", "a hundred points and one frame"]  # fmt: skip


@pytest.mark.parametrize(
    "how", [ONE_BY_ONE, How(gnss=GnssTrack([])), How(180.0)], ids=["alone", "gnss", "turning"]
)
@pytest.mark.parametrize("name", NAMES)
def test_whatever_frames_a_night_has_each_has_an_answer_and_the_claim_holds(still, points, name, how):
    items, fixed = mixed(still, points, name)
    night = solved_night(still.exposures(items), how)
    assert len(night.shots) == len(items) and all(s.place or s.message for s in night.shots)
    assert len(night.fixed) == fixed and (night.combined is None) == (fixed == 0) == bool(night.why_not)
    if night.combined is None:
        return
    assert still.is_here(night.combined)
    sigmas_m = [np.sqrt(np.trace(s.place.covariance[:2, :2])) for _, s in night.fixed]
    whole_m = np.sqrt(np.trace(night.combined.covariance[:2, :2]))
    assert whole_m <= 1.01 * max(sigmas_m)
    # the same frame once more adds nothing
    if name == "one of them three times" and how.turn_stddev_deg is None:
        assert whole_m == pytest.approx(min(sigmas_m), rel=0.01)

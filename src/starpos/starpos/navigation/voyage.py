# SPDX-License-Identifier: Apache-2.0
"""Place, heading and velocity of a recorded voyage, from all its stars, inertial readings and velocities at once.

The equations are solved again and again until the place settles. Equations of a wrong place make a filter sure of it:
of each round nothing is kept but the motion that it led to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.gravity import itrs_place, zenith_at
from starpos.errors import FixError, VoyageError
from starpos.navigation import start
from starpos.navigation.chain import Chain, Smoothed, log_likelihood, smoothed
from starpos.navigation.equations import (
    BY_LAW,
    CONSTANTS,
    MEASURED,
    MOUNT,
    PLACE,
    TURN,
    Links,
    Motion,
    Odometry,
    Residuals,
    StarAttitudes,
    known_residuals,
    law_residuals,
    links_of,
    prior_rows,
    standing_residuals,
    star_residuals,
    sums_of,
)
from starpos.navigation.estimate import Estimate, VoyageFix
from starpos.navigation.evidence import (
    MIN_STANDSTILLS,
    NOWHERE,
    borne_out,
    by_the_rest,
    judged_by,
    noise_density2,
    standstills,
)
from starpos.navigation.preintegration import Pieces, summed
from starpos.navigation.records import ImuLog, VelocityLog
from starpos.navigation.sightings import FrameUnderWay, SunFrame
from starpos.navigation.start import first_motion, nodes_of
from starpos.navigation.vessel import PARKED, ROVER, Vessel
from starpos.progress import Progress, quiet
from starpos.rotation import normalised
from starpos.units import ARCSEC

MIN_FRAMES = 3
# place and attitude have settled where a step is below it, in m, in rad and as a share of its sigma
SETTLED_M, SETTLED_RAD, SETTLED_SHARE = 1.0, 10 * ARCSEC, 0.02
# equations of a place farther off are wrong by more than the stars' errors: the square of the angle
NEAR_M = 2000.0
# minimum ratio of found to stated variances that is reported
NOTABLE = 4.0
# least error (m an axis) of a known place
PLACE_M = 1.0
# no step on the Earth is longer
FARTHEST_M, MAX_ROUNDS = 2e7, 25
# a law is weighed until its terms change by a smaller factor, and so often at most
LAW_CHANGE, MAX_WEIGHINGS = 1.1, 4
# stars are seen anew where the zenith has moved by more: 2 m of refraction
ZENITH_MOVED = 1e-3
# a standstill, m/s: of each node, and of a middle one alone on trial
STANDING_SIGMA, TRIAL_SIGMA = 2e-3, 5e-3
# of a chi-squared of three degrees of freedom: the median, and what one in a million exceeds
MEDIAN_OF_CHI2, OUTLIER_CHI2 = 2.366, 30.7
# A disc is the Sun if a lamp, which stands still, is farther away than this in sigma, and the Sun nearer: chi-squared of
# three degrees of freedom that one in a thousand exceeds
LAMP_SIGMAS, SUN_CHI2 = 5.0, 16.3
# with a wrong heading places or velocities scatter by more than this factor, in variances
MISFIT = 1.5
# 1 sigma of a further constant of which nothing is known
UNKNOWN = 100.0
# steps of the accelerometer's noise, how many at most, and when to stop: a factor of e^8; of e^3 by a law, since much
# more noise would take the law's errors too, and be likely again
FACTOR, MAX_FACTORS, UNLIKELY, UNLIKELY_BY_LAW = 2**0.5, 16, 8.0, 3.0


class Adjustment:
    """The equations of a voyage, and how much more than stated its measurements scatter.

    excess: of the variances of each kind of measurement over those that are stated.
    """

    def __init__(
        self,
        frames: Sequence[FrameUnderWay],
        nodes: np.ndarray,
        imu: ImuLog,
        velocity: VelocityLog | None,
        vessel: Vessel,
    ) -> None:
        self.frames, self.nodes, self.vessel = frames, nodes, vessel
        self.pieces, self.vibration = Pieces.cut(imu, nodes), imu.vibration
        self.odometry = None if velocity is None else Odometry.of(velocity, nodes, self.pieces)
        if self.odometry is not None and not len(self.odometry.node):
            raise VoyageError("no velocity lies on the voyage: check that its clock and the camera's agree")
        self.law = vessel.law(measured=self.odometry is not None)
        self.unknowns = MEASURED if self.law is None else BY_LAW
        self.model = vessel.model
        self.excess = dict.fromkeys(("frames", "places", "velocities", "forces", "forces at rest"), 1.0)
        # how many times as much wind or current change as their law says
        self.weighings, self.more_drift = 0, 1.0
        self.noise_weighed = False
        # velocities that are wrong, and nodes whose measurement of a kind is
        self.slipped = np.zeros(0 if self.odometry is None else len(self.odometry.node), bool)
        self.wrong: dict[str, np.ndarray] = {kind: np.zeros(0, int) for kind in self.excess}
        self.strays = 0
        # where it stands, once that is looked for; and whether the rest of the record contradicts that it does
        self.standing, self.contradicted = NOWHERE, False
        self.looked_for = self.odometry is not None or vessel.vehicle != ROVER

    @property
    def left_out(self) -> dict[str, int]:
        """How many measurements of each kind are left out."""
        at = np.zeros(0, int) if self.odometry is None else self.odometry.node
        velocities = int((self.slipped | np.isin(at, self.wrong["velocities"])).sum())
        return {"frames": self.strays + len(self.wrong["frames"]), "velocities": velocities}

    @property
    def faults(self) -> tuple[str, ...]:
        """What of the record does not go with the rest, in sentences."""
        said = [
            f"{number} {kind} contradict the rest: left out"
            for kind, number in self.left_out.items()
            if number
        ]
        said += [
            f"the {kind} scatter {excess**0.5:.1f} times as much as stated: their errors are widened by that"
            for kind, excess in self.excess.items()
            if excess > NOTABLE
        ]
        if self.more_drift**2 > NOTABLE:
            said.append(
                f"wind or current change {self.more_drift:.1f} times as much as the law of motion says: the claim is "
                "widened by that"
            )
        if self.contradicted:
            said.append(
                "it seems to stand now and then, but the rest of the record contradicts that: not believed; check that "
                "the ground stays where it is, and the IMU's noise"
            )
        return tuple(said)

    def settle(self, progress: Progress) -> tuple[Motion, Smoothed]:
        """The motion, and the solution of the last round.

        VoyageError where the measurements do not go together, FixError where the place does not settle.
        """
        stars, motion = self._begin()
        solution: Smoothed | None = None
        zenith, step, sigma = np.zeros(3), np.inf, 1.0
        for k in range(MAX_ROUNDS):
            # equations for another place show neither how the stars are seen nor which measurements are wrong
            near = step < min(NEAR_M, sigma)
            up = zenith_at(motion.place[len(motion) // 2])
            seen_anew = near and bool(np.linalg.norm(up - zenith) > ZENITH_MOVED)
            if seen_anew:
                zenith, stars = up, self._attitudes(up)
            chain, links = self._chain(motion, stars, solution if near and not seen_anew else None)
            solution = smoothed(chain)
            motion = motion.moved(solution.nodes, solution.constants)
            step = float(np.linalg.norm(solution.nodes[:, PLACE], axis=1).max())
            # true for NaN too
            if not step < FARTHEST_M:
                break
            variance = np.trace(solution.covariance[:, PLACE, PLACE], axis1=1, axis2=2)
            sigma = float(np.sqrt(variance.min()))
            progress("adjusting", min(0.95, (k + 1) / 8))
            settled = near and not seen_anew and step < max(SETTLED_M, SETTLED_SHARE * sigma)
            # a known place settles long before the heading
            turned = np.linalg.norm(solution.nodes[:, TURN], axis=1)
            variance = np.trace(solution.covariance[:, TURN, TURN], axis1=1, axis2=2)
            settled = settled and bool(
                (turned < np.maximum(SETTLED_RAD, SETTLED_SHARE * variance**0.5)).all()
            )
            if settled and not self._revised(motion, chain, links, stars):
                self._check_sun(motion, chain, stars)
                progress("adjusting", 1.0)
                return motion, solution
        raise FixError(
            f"the voyage's position does not converge (the last step was {step:.0f} m): check the IMU's "
            f"axes and units, and the stated vehicle"
        )

    def _begin(self) -> tuple[StarAttitudes, Motion]:
        """Rough attitudes of the frames that go with the gyro, and a first motion from them."""
        stars = self._attitudes(None)
        zero, none = np.zeros((len(self.nodes) - 1, 3)), np.zeros((3, 3))
        sums = summed(self.pieces, zero, zero, none, none)
        believed = self.vessel.camera_to_body
        start.check_gravity(self.pieces, sums, self.model, believed)
        whole, stray = stars.select(stars.whole), np.zeros(len(self.frames), bool)
        start.check_turns(whole, self.pieces, self.model, believed)
        stray[stars.whole] = start.stray_frames(whole, self.pieces, sums, self.model, believed)
        if stray.any():
            self.strays = int(stray.sum())
            self.frames = [frame for frame, wrong in zip(self.frames, stray, strict=True) if not wrong]
            if len(self.frames) < MIN_FRAMES:
                raise VoyageError(
                    f"the stars of {len(self.frames)} frames go with the gyro: at least {MIN_FRAMES} are needed"
                )
            stars = self._attitudes(None)
        if suns := self._suns:
            sun = suns[len(suns) // 2]
            zenith = sun.place.plumb_axes[2]
            stars, off = start.upright(self._attitudes(zenith), zenith, sums, believed)
            start.check_sun(off, sun, self.model, self.vessel.mount_stddev, zenith)
        motion = first_motion(self.nodes, stars, self.pieces, sums, self.odometry, believed)
        return stars, motion

    @property
    def _suns(self) -> list[SunFrame]:
        return [frame for frame in self.frames if isinstance(frame, SunFrame)]

    def _check_sun(self, motion: Motion, chain: Chain, stars: StarAttitudes) -> None:
        """Raise VoyageError unless the disc moves as the Sun and not as a lamp, which stands still.

        Three constants are fitted.  The first is the share of the Sun's way in the sky that the disc stays behind: 0 for
        the Sun, 1 for what is fixed to the ground.  The others are its height above the Sun and its azimuth, which the
        vehicle's own way shows.  Stars in the window make that unnecessary.
        """
        lone = ~stars.whole
        if not lone.any():
            return
        contradicted, undecided = self.excess["frames"] > NOTABLE, False
        if lone.all():
            suns = np.einsum("kij,kj->ki", stars.camera_to_itrs, stars.rays)
            still = np.cross(suns, suns[len(suns) // 2])
            up = zenith_at(motion.place[stars.index])
            turns = np.stack([still, normalised(np.cross(suns, up)), up], -1)
            found, covariance = self._fitted(motion, chain, stars, turns)
            contradicted |= max(self.excess["places"], self.excess["velocities"]) > MISFIT
            contradicted |= bool(found @ np.linalg.solve(covariance, found) > SUN_CHI2)
            undecided = bool(1 - found[0] < LAMP_SIGMAS * covariance[0, 0] ** 0.5)
        if contradicted:
            raise VoyageError(
                "the bright disc does not move as the Sun by gravity, gyro and the places: it is a lamp, or the clock or "
                "a place is wrong"
            )
        if undecided:
            raise VoyageError(
                "the bright disc may be a lamp as high as the Sun: that it moves as the Sun does shows only later"
            )

    def _revised(self, motion: Motion, chain: Chain, links: Links, stars: StarAttitudes) -> bool:
        """Whether the motion, settled, changes what is believed of noise, law or standstills."""
        weighed = self._weighed(motion, chain, links)
        # standstills are judged by the law alone at first, and again by what is known in the end
        judged = self.looked_for and weighed
        return weighed if judged else self._stopped(motion, chain, stars) or weighed

    def _fitted(
        self, motion: Motion, chain: Chain, stars: StarAttitudes, turns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Further constants (T,) and their covariance (T, T); turns (F, 3, T): of frames by each, about ITRS's axes."""
        n, more = chain.unknowns, turns.shape[2]
        camera = (motion.attitude[stars.index] @ motion.camera_to_body).transpose(0, 2, 1)

        def widened(rows: np.ndarray) -> np.ndarray:
            return np.insert(rows, [rows.shape[-1] - 1] * more, 0.0, axis=-1)

        first, nodes, links = widened(chain.first), widened(chain.nodes), widened(chain.links)
        free = np.zeros((more, first.shape[1]))
        free[:, -1 - more : -1] = np.eye(more) / UNKNOWN
        first = np.vstack([first, free])
        # the mount's columns are the whitening itself
        nodes[stars.index, :3, -1 - more : -1] = -nodes[stars.index, :3, n:][..., MOUNT] @ camera @ turns
        solution = smoothed(Chain(first=first, nodes=nodes, links=links, constants=chain.constants + more))
        return solution.constants[-more:], solution.covariance[-1, -more:, -more:]

    def _stopped(self, motion: Motion, chain: Chain, stars: StarAttitudes) -> bool:
        """Whether it is believed to stand elsewhere than before: where it seems to, and the rest bears that out."""
        before = len(self.standing)
        seeming = self.standing if self.looked_for else standstills(stars, self.pieces)
        if len(seeming):
            trial = standing_residuals(motion, seeming.middle, TRIAL_SIGMA, self.unknowns)
            nodes = np.concatenate([chain.nodes[:, : -trial.rows.shape[1]], self._by_law(motion, trial)], 1)
            rest = by_the_rest(trial, TRIAL_SIGMA, smoothed(replace(chain, nodes=nodes)))
            checked, contradicted = judged_by(*rest, TRIAL_SIGMA)
            self.contradicted |= contradicted
            seeming = seeming.select(checked & (checked.sum() >= MIN_STANDSTILLS and not contradicted))
        self.standing, self.looked_for = seeming, True
        return len(seeming) != before

    def _weighed(self, motion: Motion, chain: Chain, links: Links) -> bool:
        """Whether the record changes the weight of its own noise, or of the law that stands in for velocities.

        The noise only if velocities or standstills show it: a law's errors hide it.
        """
        if (self.odometry is not None or self.standing) and not self.noise_weighed:
            self._weigh(chain, links)
            self.noise_weighed = True
            return True
        stated = self.vessel.law(measured=False)
        if self.odometry is not None or self.law is None or stated is None or self.weighings == MAX_WEIGHINGS:
            return False
        self.weighings += 1
        law = borne_out(stated, motion)
        change = np.log([law.drift_walk / self.law.drift_walk, law.rest_stddev / self.law.rest_stddev])
        if np.abs(change).max() < np.log(LAW_CHANGE):
            return False
        self.law, self.more_drift = law, law.drift_walk / stated.drift_walk
        return True

    def _weigh(self, chain: Chain, links: Links) -> None:
        """Raise the accelerometer's noise to what the voyage shows: of vibration some is left in sums."""
        stated2 = self.model.accelerometer_noise_density**2
        at_rest = max(1.0, noise_density2(self.pieces, self.standing) / stated2)
        unlikely = UNLIKELY_BY_LAW if self.odometry is None else UNLIKELY
        factors: list[float] = []
        likely: list[float] = []
        while len(factors) < MAX_FACTORS and (not likely or likely[-1] > max(likely) - unlikely):
            factors.append(FACTOR ** len(factors))
            excess = at_rest * np.where(self._shaken, factors[-1] ** 2, 1.0)
            noisy = links.noisier((excess - 1) * stated2, self.pieces)
            likely.append(log_likelihood(replace(chain, links=noisy.whitened())) - noisy.log_determinant)
            # what is stated, or shown at rest, is believed within a factor of e, where the record says nothing
            likely[-1] -= np.log(factors[-1]) ** 2 / 2
        weight = np.exp(np.array(likely) - max(likely))
        self.excess["forces at rest"] = at_rest
        self.excess["forces"] = at_rest * float(weight @ np.square(factors) / weight.sum())
        density = self.model.accelerometer_noise_density * np.sqrt(self.excess["forces"])
        self.model = replace(self.model, accelerometer_noise_density=density)

    @property
    def _shaken(self) -> np.ndarray:
        """Mask (K - 1,) of the intervals in which the vehicle is not known to stand."""
        return ~self.standing.links(len(self.nodes))

    def _attitudes(self, zenith: np.ndarray | None) -> StarAttitudes:
        """Attitudes of all frames, as seen under a zenith, or roughly."""
        air = self.vessel.atmosphere
        found = [
            (frame.rough(), np.zeros(3)) if zenith is None else frame.under(zenith, air)
            for frame in self.frames
        ]
        return StarAttitudes(
            index=np.searchsorted(self.nodes, [frame.utc_unix_s for frame in self.frames]),
            camera_to_itrs=np.array([a.rotation for a, _ in found]),
            covariance=np.array([a.covariance_about_own for a, _ in found]),
            by_refraction=np.array([a.rotation.T @ bent for a, bent in found]),
            stamp_stddev_s=np.array([frame.stamp_stddev_s for frame in self.frames]),
            rays=np.array([f.ray if isinstance(f, SunFrame) else np.zeros(3) for f in self.frames]),
        )

    def _places(self, motion: Motion) -> Residuals:
        """Equations of the nodes from whose known place the Sun is seen."""
        suns, sigma_m = self._suns, self.vessel.height_stddev_m
        where, covariance = [], []
        for place in (sun.place for sun in suns):
            height = self.vessel.height_m if np.isnan(place.height_m) else place.height_m
            where.append(itrs_place(*place.plumb, height))
            level, axes = place.covariance + np.eye(2) * PLACE_M**2, place.plumb_axes
            covariance.append(axes[:2].T @ level @ axes[:2] + np.outer(axes[2], axes[2]) * sigma_m**2)
        index = np.searchsorted(self.nodes, [sun.utc_unix_s for sun in suns])
        off = np.array(where) - motion.place[index]
        return known_residuals(PLACE, off, index, np.array(covariance), self.unknowns)

    def _chain(self, motion: Motion, stars: StarAttitudes, before: Smoothed | None) -> tuple[Chain, Links]:
        """The equations about a motion, without measurements that a solution has shown to be wrong."""
        n, count = self.unknowns, len(motion)
        sums = sums_of(self.pieces, motion)
        parts = [self._sound(star_residuals(motion, stars, sums, self.pieces, n), before, "frames")]
        if self._suns:
            parts.append(self._sound(self._places(motion), before, "places"))
        if self.odometry is not None:
            missed = self.odometry.missed(motion, sums, self.pieces)
            if before is not None:
                self.slipped = ~self.odometry.sound(missed)
            measured = self.odometry.residuals(motion, missed, ~self.slipped, self.vibration, n)
            parts.append(self._sound(measured, before, "velocities"))
        if self.vessel.vehicle == PARKED:
            parts.append(standing_residuals(motion, np.arange(count), STANDING_SIGMA, n))
        rows = [part.whitened(count) for part in parts]
        if self.law is not None and self.odometry is None:
            stands = standing_residuals(motion, self.standing.nodes, STANDING_SIGMA, n)
            rows.append(self._by_law(motion, stands))
        links = links_of(motion, sums, self.pieces, self.model, self.law)
        # what shakes the accelerometer while it drives is not there where it stands
        at_rest2 = self.excess["forces at rest"] * self.vessel.model.accelerometer_noise_density**2
        less = at_rest2 - self.model.accelerometer_noise_density**2
        links = links.noisier(less * ~self._shaken, self.pieces)
        chain = Chain(
            first=prior_rows(motion, self.model, self.vessel, self.law),
            nodes=np.concatenate(rows, 1),
            links=links.whitened(),
            constants=CONSTANTS,
        )
        return chain, links

    def _by_law(self, motion: Motion, stands: Residuals) -> np.ndarray:
        """Whitened equations (K, 3, n + m + 1) of the law of motion, replaced by the equations of standstills."""
        assert self.law is not None
        rows = law_residuals(motion, self.law).whitened(len(motion))
        rows[stands.index] = stands.whitened(len(motion))[stands.index]
        return rows

    def _sound(self, residuals: Residuals, before: Smoothed | None, kind: str) -> Residuals:
        """Equations without outliers, with wider errors where most of them scatter by more than is stated.

        Where no solution is near, those that were left out stay so: leaving them out moves the solution, and judged
        from there they would look good again.
        """
        used = self.excess[kind]
        if before is not None and len(residuals.index):
            left_out = np.isin(residuals.index, self.wrong[kind])
            stated = replace(residuals, covariance=residuals.covariance * used)
            distance2 = stated.distance2(before.covariance, left_out)
            change = max(1 / used, float(np.median(distance2)) / MEDIAN_OF_CHI2)
            self.wrong[kind] = residuals.index[distance2 > OUTLIER_CHI2 * change]
            self.excess[kind] = used = used * change
        keep = ~np.isin(residuals.index, self.wrong[kind])
        return replace(residuals, covariance=residuals.covariance * used).select(keep)


@dataclass(frozen=True, eq=False, kw_only=True)
class Voyage:
    """Fixes at the times that were asked for, None where there is no answer.

    Attributes
    ----------
    faults : what is wrong with the record, in sentences
    excess, left_out : of frames and velocities, as `Adjustment` has them
    motion : of its last round
    last : where it ends, to be carried on

    Examples
    --------
    >>> lists = sorted(Path("drive").glob("stars_*.csv"))
    >>> voyage = starpos.navigate(lists, "drive/imu.csv", starpos.Instrument(4635.9375), vehicle="rover")
    >>> len(voyage.fixes) == len(lists)
    True
    """

    fixes: tuple[VoyageFix | None, ...]
    faults: tuple[str, ...]
    excess: dict[str, float]
    left_out: dict[str, int]
    motion: Motion
    last: Estimate


def adjust_voyage(
    frames: Sequence[FrameUnderWay],
    imu: ImuLog,
    velocity: VelocityLog | None,
    vessel: Vessel,
    times: np.ndarray | None = None,
    progress: Progress = quiet,
) -> Voyage:
    """Fixes at times (T,), Unix s, or at the frames' times; VoyageError or FixError if there is no fix.

    No prior knowledge of the start is needed.  The place is where gravity points, astronomic.
    """
    times = np.array([f.utc_unix_s for f in frames]) if times is None else np.asarray(times, float)
    begin, end = imu.utc_unix_s[0] - imu.length_s[0], imu.utc_unix_s[-1]
    within = sorted((f for f in frames if begin <= f.utc_unix_s <= end), key=lambda f: f.utc_unix_s)
    if len({f.utc_unix_s for f in within}) < MIN_FRAMES:
        raise VoyageError(
            f"{len(within)} frames with stars have inertial readings at their times: at least {MIN_FRAMES} are "
            "needed; check that the clocks of camera and IMU agree"
        )
    inside = (times >= begin) & (times <= end)
    asked = np.concatenate([times[inside], [f.utc_unix_s for f in within]])
    nodes = nodes_of(np.unique(asked))
    adjustment = Adjustment(within, nodes, imu, velocity, vessel)
    motion, solution = adjustment.settle(progress)
    stamp_s = float(np.median([f.stamp_stddev_s for f in within]))
    clock_s = vessel.clock_stddev_of(within)

    def at(k: int) -> Estimate:
        return Estimate(
            motion=motion.part(np.array([k])),
            covariance=solution.covariance[k],
            model=adjustment.model,
            law=adjustment.law,
            clock_stddev_s=clock_s,
            stamp_stddev_s=stamp_s,
        )

    return Voyage(
        fixes=tuple(
            at(k).fix if there else None
            for k, there in zip(np.searchsorted(nodes, times), inside, strict=True)
        ),
        faults=(*imu.faults, *(() if velocity is None else velocity.faults), *adjustment.faults),
        excess=adjustment.excess,
        left_out=adjustment.left_out,
        motion=motion,
        last=at(-1),
    )

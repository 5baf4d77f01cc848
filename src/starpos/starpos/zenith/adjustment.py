# SPDX-License-Identifier: Apache-2.0
"""The deflection of the vertical of one session, by generalised least squares of all its frames.

Unknown are xi, eta and A3 (its two tilts, which hold the tiltmeter's zero, and its turn).  All else is in the covariance
of the readings.  The session's residuals determine the size of image motion and anomalous refraction, by restricted
maximum likelihood (Patterson and Thompson 1971, Biometrika 58, 545).  A session hardly shows an error that changes as
slowly as the second, so anomalous refraction is at least AIR_SHARE times the image motion.

Where the residuals show that the tiltmeter's zero drifts more than its file states, or that its scale is off by more,
they determine that size, too, and the errors grow by it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from starpos.earth.gravity import itrs_place, plumb_tide
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import plumb_curvature_arcsec_per_m
from starpos.errors import FixError
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.units import ARCSEC
from starpos.zenith.equations import ANOMALOUS, MOTION, LeanEstimate, Lines, errors_of, start_of
from starpos.zenith.sighting import StarPlaces, ZenithSighting, faces_of, mean_headings


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceQuality:
    """A face against all others.

    number: from 0.  heading_deg: azimuth of the top of the frame.  frames: number of its frames.
    off_arcsec, stddev_arcsec (2,): xi and eta that it alone has more than the others have, with 1 sigma; NaN where they
    cannot be separated from A3.  chi2: of these two.
    """

    number: int
    heading_deg: float
    frames: int
    off_arcsec: np.ndarray
    stddev_arcsec: np.ndarray
    chi2: float


STEPS = 8
# A deflection with a larger sigma is useless: maps of the geoid know it better.
MAX_SIGMA_ARCSEC = 3.0
# closer to a pole, a deflection is no longer small compared with the distance from it
MIN_COSINE = 1e-3
# of its sigma: a smaller step is the last
SETTLED = 1e-3
# Anomalous refraction over image motion: a twenty-minute mean of zenith cameras scatters by 0.05 arcsec (Hirt 2006, A&A
# 459, 283: 0.05 to 0.2 over hours) where a frame's image motion is 0.4. In air that moves no image nothing bends slowly.
AIR_SHARE = 1 / 8
# A night's share exceeds AIR_SHARE by this factor (1 sigma), at most by MAX_SIGMA of these: a face that is off by more
# is no air.
AIR_FACTOR, MAX_SIGMA = 1.5, 3.0
# size of the image motion at which its search begins, rad
MOTION_RAD = 0.3 * ARCSEC
# and below which it makes no difference
MIN_RAD = 1e-3 * ARCSEC
# Fields of the inclinometer's errors that a session can show to be larger, their sources, and the size at which a search
# begins where none is stated: rad per root of an hour, and a share.
SHOWN = (("drift_rad_per_sqrt_hour", "tilt drift", 0.01 * ARCSEC), ("scale", "tilt scale", 1e-4))
# The search begins where the residuals have an excess of SHOWN_SIGMA over chance. Its result is taken where twice the log
# of the likelihood gains SHOWN_GAIN, as by chance in one session of 13: that makes the errors a little larger.
SHOWN_SIGMA, SHOWN_GAIN, MAX_FACTOR = 1.0, 2.0, 100.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Air:
    """1 sigma of image motion and of anomalous refraction, rad."""

    motion: float
    anomalous: float


@dataclass(frozen=True, eq=False, kw_only=True)
class DeflectionSession:
    """The deflection of a session at the mark, with its errors.

    Attributes
    ----------
    sightings : (N,) in order of time
    xi_arcsec, eta_arcsec : arcsec, north and east
    covariance_arcsec2 : (2, 2) of xi, eta, the sum over sources of error, by_source (2, 2)
    a3 : (3, 3) C into S, with the tiltmeter's zero
    faces : (N,) number of each frame's face
    frame_arcsec, frame_stddev_arcsec : (N, 2) xi, eta of each frame minus the session's, and what they should scatter by
    catalogue_factor : size of the catalogue's errors over what it states, by the session's own stars
    inclinometer : the errors that were assumed
    as_stated : the session with the errors of the tiltmeter's file, where the residuals show larger ones
    same_air : likewise, with the air of this adjustment
    cost : -2 log of the likelihood
    chi2_per_degree : of the residuals; 1 where the stated errors and the air's explain them
    stars : (S,) rows of the catalogue
    lines : the equations of the last step, before which the estimate was off the prior's by offset (5,)
    projector, weighted : (2 N, 2 N), (2 N,) weights that the unknowns leave, and the weighted residuals

    Examples
    --------
    >>> lists = sorted(Path("zenith").glob("stars_*.csv"))
    >>> session = starpos.deflection(lists, "zenith/tilt.csv", (61.2, 24.5, 900.0), "zenith/instrument.yaml")
    >>> len(session.sightings)
    8
    """

    sightings: tuple[ZenithSighting, ...]
    xi_arcsec: float
    eta_arcsec: float
    covariance_arcsec2: np.ndarray
    by_source: dict[str, np.ndarray]
    a3: np.ndarray
    faces: np.ndarray
    frame_arcsec: np.ndarray
    frame_stddev_arcsec: np.ndarray
    air: Air
    catalogue_factor: float
    chi2_per_degree: float
    stars: np.ndarray
    inclinometer: InclinometerErrors
    cost: float
    lines: Lines
    offset: np.ndarray
    projector: np.ndarray
    weighted: np.ndarray
    as_stated: "DeflectionSession | None" = None
    same_air: "DeflectionSession | None" = None

    @property
    def mid_unix_s(self) -> float:
        """Mean time of its frames, UTC."""
        return sum(s.utc_unix_s for s in self.sightings) / len(self.sightings)

    @property
    def sigma_arcsec(self) -> np.ndarray:
        """Standard deviations (2,) of xi, eta."""
        return _sigma(self.covariance_arcsec2)

    @property
    def terms(self) -> tuple[tuple[str, float, float], ...]:
        """1 sigma of xi and eta for each source of error."""
        return tuple((name, *_sigma(c).tolist()) for name, c in self.by_source.items())

    @property
    def correlations(self) -> dict[str, float]:
        """Correlation of xi and eta for each source of error."""
        sizes = {name: float(np.prod(_sigma(c))) for name, c in self.by_source.items()}
        return {name: float(self.by_source[name][0, 1]) / s if s else 0.0 for name, s in sizes.items()}

    @property
    def misalignment_deg(self) -> tuple[float, ...]:
        """A3 as three angles, as instrument files have them."""
        return Calibration().turned_to(self.a3).misalignment_deg

    @property
    def gain(self) -> float:
        """Twice the log of the likelihood minus the one of same_air; 0 without that."""
        return 0.0 if self.same_air is None else self.same_air.cost - self.cost

    def tested(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The best multiple (m,) of further columns (N, 2, m), its normal matrix, and by how much chi-square falls."""
        flat = columns.reshape(-1, columns.shape[2])
        normal = flat.T @ self.projector @ flat
        right = flat.T @ self.weighted
        step = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
        return step, normal, float(step @ right)

    def excess(self, covariance: np.ndarray) -> float:
        """How many sigma more of an error of this covariance (2 N, 2 N) the residuals have than the weights assume."""
        weighted = self.projector @ covariance
        more = self.weighted @ covariance @ self.weighted - np.trace(weighted)
        spread = np.sqrt(2 * np.sum(weighted * weighted.T))
        return float(more / spread) if spread > 0 else 0.0

    @cached_property
    def face_quality(self) -> tuple[FaceQuality, ...]:
        """Each face against the others; empty for fewer than three: of two it is unknown which is wrong."""
        headings, qualities = np.degrees(mean_headings(self.sightings, self.faces)).tolist(), []
        for number, heading_deg in enumerate(headings if len(headings) > 2 else ()):
            member = self.faces == number
            step, normal, chi2 = self.tested(self.lines.by_lean * member[:, None, None])
            known = np.linalg.cond(normal) < 1e9
            stddev = np.sqrt(np.diag(np.linalg.inv(normal))) if known else np.full(2, np.nan)
            qualities.append(
                FaceQuality(
                    number=number,
                    heading_deg=heading_deg,
                    frames=int(member.sum()),
                    off_arcsec=step / ARCSEC,
                    stddev_arcsec=stddev / ARCSEC,
                    chi2=chi2,
                )
            )
        return tuple(qualities)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fit:
    """A weighted fit of xi, eta and A3's turns: step (5,), covariance (5, 5), gain (5, 2 N) by the readings, rad.

    root (2 N, 2 N): of the covariance of the readings.  cost: -2 log of the likelihood.
    """

    step: np.ndarray
    covariance: np.ndarray
    gain: np.ndarray
    root: np.ndarray
    cost: float
    chi2: float


def adjusted(
    sightings: Sequence[ZenithSighting], instrument: Instrument, atmosphere: Atmosphere, mark: Place
) -> DeflectionSession:
    """The deflection of a session; sightings: at least three, in any order.

    Raises FixError where there are fewer, at the poles, or where the equations have no solution or do not settle.
    """
    if len(sightings) < 3:
        raise FixError(f"{len(sightings)} frames make no session: at least 3, in several faces, are needed")
    if np.cos(mark.latitude) < MIN_COSINE:
        raise FixError("the mark is within 6 km of a pole, where eta has no direction")
    try:
        return _Session(sightings, instrument, atmosphere, mark).whole()
    except np.linalg.LinAlgError as error:
        raise FixError(
            f"the session's equations have no solution ({error}): turn the instrument to several faces, and state the "
            "noise of the tiltmeter's readings"
        ) from None


class _Session:
    """What is given: sightings, as seen and with the stars' places that they adjusted, and what is known before.

    prior (5, 5): weights of what is known before: A3, as far as the instrument's calibration has it.
    """

    def __init__(
        self, sightings: Sequence[ZenithSighting], instrument: Instrument, atmosphere: Atmosphere, mark: Place
    ) -> None:
        c = instrument.calibration
        self.given, self.mark, self.inclinometer = c, mark, instrument.inclinometer
        self.seen = tuple(sorted(sightings, key=lambda s: s.utc_unix_s))
        self.places = StarPlaces.of(self.seen)
        self.sightings = self.places.applied(self.seen)
        self.faces = faces_of(self.sightings)
        self.bending = atmosphere.refraction().a
        self.prior = np.zeros((5, 5))
        covariance = np.asarray(c.covariance_arcsec2, float) + np.eye(3) * c.remounted_arcsec**2
        self.prior[2:, 2:] = np.linalg.inv(covariance * ARCSEC**2 + np.eye(3) * MIN_RAD**2)

    def whole(self) -> DeflectionSession:
        """The session with the errors of the tiltmeter as stated, or larger ones where the residuals show them."""
        stated = self.solved(self.inclinometer, None)
        if (shown := self.shown(stated)) is None:
            return stated
        larger, size = shown
        # under one air: what is wrong with the tiltmeter had seemed to be the air's
        same_air = self.solved(self.inclinometer, size)
        return replace(self.solved(larger, size), as_stated=stated, same_air=same_air)

    def errors(self, lines: Lines, inclinometer: InclinometerErrors) -> dict[str, np.ndarray]:
        since = self.given.utc_unix_s
        return errors_of(lines, self.sightings, self.places, self.faces, inclinometer, since)

    def solved(self, inclinometer: InclinometerErrors, air: Air | None) -> DeflectionSession:
        """The session with a tiltmeter of these errors; air: its size, else the residuals determine it."""
        known = not self.given.unknown
        estimate = LeanEstimate(lean=np.zeros(2), a3=self.given.a3) if known else start_of(self.sightings)
        offset, size = np.zeros(5), air
        for _ in range(STEPS):
            lines = Lines.at(estimate, self.sightings, self.bending, self.mark)
            errors = self.errors(lines, inclinometer)
            stated = _stated(errors)
            # A3's prior stays where it was
            if size is None:
                # wide: in still air the cost hardly changes over a factor of ten
                simplex = np.array([[0.0, 0.0], [-3.0, 0.0], [0.0, 1.0]])
                size = _air(self.likeliest(lines, errors, stated, (), offset, simplex, 0.002, 120)[0])
            fit = self.fitted(lines, _whole(stated, errors, size), offset)
            before, estimate, offset = offset, estimate.moved(fit.step), offset + fit.step
            if np.abs(fit.step).max() < SETTLED * np.sqrt(np.diag(fit.covariance)).min():
                break
        else:
            check_round(fit.covariance[:2, :2] / ARCSEC**2, self.sightings, self.faces)
            raise FixError(
                f"the session does not settle in {STEPS} steps (the last one was {np.abs(fit.step).max() / ARCSEC:.2g} "
                "arcsec): check the site, and the order and the signs of the tiltmeter's axes"
            )
        assert size is not None
        return self.answer(estimate, lines, errors, fit, size, before, inclinometer)

    def shown(self, stated: DeflectionSession) -> tuple[InclinometerErrors, Air] | None:
        """The tiltmeter's errors and the air as the residuals show them; None: as stated, or hardly more."""
        given, lines, units = stated.inclinometer, stated.lines, {}
        errors = self.errors(lines, given)
        base = _stated(errors)
        for field, source, _ in SHOWN:
            unit = self.errors(lines, _larger(given, {field: 1.0}))[source]
            if stated.excess(unit) > SHOWN_SIGMA:
                units[field] = unit
                base = base - errors[source]
        if not units:
            return None
        motion = max(stated.air.motion, 2 * MIN_RAD)
        slow = np.log(stated.air.anomalous / stated.air.motion / AIR_SHARE) / np.log(AIR_FACTOR)
        begin = np.array([np.log(motion / MOTION_RAD), slow, *np.zeros(len(units))])
        simplex = begin + np.vstack([np.zeros(len(begin)), np.diag([-0.5, 0.7, *np.full(len(units), 1.5)])])
        sizes, gain = self.likeliest(
            lines, errors, base, tuple(units.values()), stated.offset, simplex, 0.02, 200
        )
        if gain < SHOWN_GAIN:
            return None
        return _larger(given, dict(zip(units, _factors(sizes).tolist(), strict=True))), _air(sizes)

    def likeliest(
        self,
        lines: Lines,
        errors: dict[str, np.ndarray],
        base: np.ndarray,
        units: tuple[np.ndarray, ...],
        offset: np.ndarray,
        simplex: np.ndarray,
        precision: float,
        most: int,
    ) -> tuple[np.ndarray, float]:
        """The parameters of `_air` and `_factors` that make the residuals likeliest, and what they gain over the first.

        base: covariance (2 N, 2 N) of the readings without the air's, and without errors whose sizes are sought, units.
        simplex: that the search begins with; precision: of the cost; most: evaluations of it.
        """
        # slow to import
        from scipy.optimize import minimize

        costs = []

        def cost(p: np.ndarray) -> float:
            tilts = sum(f**2 * unit for f, unit in zip(_factors(p), units, strict=True))
            covariance = _whole(base + tilts, errors, _air(p))
            costs.append(self.fitted(lines, covariance, offset).cost + float(p[1] ** 2))
            return costs[-1]

        options = {"initial_simplex": simplex, "xatol": 0.05, "fatol": precision, "maxfev": most}
        found = minimize(cost, simplex[0], method="Nelder-Mead", options=options)
        return found.x, costs[0] - float(found.fun)

    def fitted(self, lines: Lines, covariance: np.ndarray, offset: np.ndarray) -> _Fit:
        """Weighted fit of the equations; offset (5,): how far the estimate has moved from the prior's."""
        # slow to import
        from scipy.linalg import cholesky, solve_triangular

        design, prior = lines.by_parameters.reshape(-1, 5), self.prior
        root = cholesky(covariance, lower=True)
        both = solve_triangular(root, np.column_stack([design, lines.off.reshape(-1)]), lower=True)
        white, off = both[:, :5], both[:, 5]
        normal = white.T @ white + prior
        inverse = np.linalg.inv(normal)
        step = inverse @ (white.T @ off - prior @ offset)
        left, moved = off - white @ step, offset + step
        chi2 = float(left @ left + moved @ prior @ moved)
        cost = chi2 + 2 * float(np.log(np.diag(root)).sum()) + float(np.linalg.slogdet(normal)[1])
        gain = inverse @ solve_triangular(root, white, lower=True, trans=1).T
        return _Fit(step=step, covariance=inverse, gain=gain, root=root, cost=cost, chi2=chi2)

    def answer(
        self,
        estimate: LeanEstimate,
        lines: Lines,
        errors: dict[str, np.ndarray],
        fit: _Fit,
        air: Air,
        offset: np.ndarray,
        inclinometer: InclinometerErrors,
    ) -> DeflectionSession:
        """The session as it is solved, with its errors by source."""
        # slow to import
        from scipy.linalg import cho_solve

        size2 = {MOTION: air.motion**2, ANOMALOUS: air.anomalous**2}
        sources = {name: size2.get(name, 1.0) * covariance for name, covariance in errors.items()}
        gain = fit.gain[:2] / ARCSEC
        by_source = {name: gain @ covariance @ gain.T for name, covariance in sources.items()}
        whole = fit.covariance[:2, :2] / ARCSEC**2
        values, axes = np.linalg.eigh(whole - np.sum(list(by_source.values()), 0))
        by_source = {name: term for name, term in by_source.items() if term.any()}
        # the rest, without what rounding leaves of it
        by_source["A3 as given"] = (axes * np.maximum(values, 0.0)) @ axes.T
        parameters = lines.by_parameters.reshape(-1, 5)
        left = lines.off.reshape(-1) - parameters @ fit.step
        inverse = cho_solve((fit.root, True), np.eye(len(parameters)))
        design = inverse @ parameters
        back = np.linalg.inv(lines.by_lean)
        own = sources["tilt readings"] + sources["centroids"] + sources[MOTION]
        n = len(self.sightings)
        own = own.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
        per_frame = np.einsum("nab,nbc,ndc->nad", back, own, back)
        xi, eta = (estimate.deflection(self.mark.latitude) / ARCSEC).tolist()
        return DeflectionSession(
            sightings=self.seen,
            xi_arcsec=xi,
            eta_arcsec=eta,
            covariance_arcsec2=whole,
            by_source=by_source,
            a3=estimate.a3,
            faces=self.faces,
            frame_arcsec=np.einsum("nab,nb->na", back, left.reshape(-1, 2)) / ARCSEC,
            frame_stddev_arcsec=np.sqrt(np.diagonal(per_frame, axis1=1, axis2=2)) / ARCSEC,
            air=air,
            catalogue_factor=self.places.factor,
            chi2_per_degree=fit.chi2 / max(left.size - 5, 1),
            stars=self.places.stars,
            inclinometer=inclinometer,
            cost=fit.cost,
            lines=lines,
            offset=offset,
            projector=inverse - design @ fit.covariance @ design.T,
            weighted=inverse @ left,
        )


def check_round(
    covariance_arcsec2: np.ndarray, sightings: Sequence[ZenithSighting], faces: np.ndarray
) -> None:
    """Raise FixError where a session's faces (N,) leave its deflection undetermined, by its covariance (2, 2)."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance_arcsec2)[-1]))
    if sigma > MAX_SIGMA_ARCSEC:
        headings = np.degrees(mean_headings(sightings, faces))
        shown = ", ".join(f"{h:.0f}" for h in headings[:8])
        raise FixError(
            f"the faces do not come round: the top of the frame was at {shown} deg, which leaves {sigma:.3g} arcsec of "
            "the deflection undetermined: turn the instrument by half a turn, better to four faces, or calibrate A3"
        )


def _larger(given: InclinometerErrors, factors: dict[str, float]) -> InclinometerErrors:
    """The errors with fields larger by factors; a field of zero is at least what SHOWN has."""
    least = {field: size for field, _, size in SHOWN}
    return replace(given, **{n: min(max(getattr(given, n), least[n]) * f, 1.0) for n, f in factors.items()})


def _stated(errors: dict[str, np.ndarray]) -> np.ndarray:
    """Covariance (2 N, 2 N) of the readings without the air's."""
    return np.sum([c for name, c in errors.items() if name not in (MOTION, ANOMALOUS)], axis=0)


def _whole(stated: np.ndarray, errors: dict[str, np.ndarray], air: Air) -> np.ndarray:
    """Covariance (2 N, 2 N) of the readings."""
    return stated + air.motion**2 * errors[MOTION] + air.anomalous**2 * errors[ANOMALOUS]


def _air(p: np.ndarray) -> Air:
    """Sizes of image motion and anomalous refraction by the first two parameters."""
    motion = float(np.hypot(MIN_RAD, MOTION_RAD * np.exp(p[0])))
    slow = AIR_FACTOR ** min(max(float(p[1]), 0.0), MAX_SIGMA)
    return Air(motion=motion, anomalous=motion * AIR_SHARE * slow)


def _factors(p: np.ndarray) -> np.ndarray:
    """Factors on errors of the tiltmeter by the other parameters."""
    return np.exp(np.clip(p[2:], 0.0, np.log(MAX_FACTOR)))


def _sigma(covariance: np.ndarray) -> np.ndarray:
    """Standard deviations (2,); rounding may leave a variance of zero below it."""
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def reduced(found: DeflectionSession, mark: Place) -> dict[str, np.ndarray]:
    """A deflection's reductions, xi and eta each in arcsec.

    tide_arcsec: what Moon and Sun added, on the mean of the session.  curvature_arcsec: what the normal plumb line's
    curvature between geoid and mark added.  mark_arcsec, geoid_arcsec: without the tide, at the mark and at the geoid.
    The mark's height above the ellipsoid stands for that above the geoid: 50 m between them are 0.009 arcsec at most.
    What mountains add to the curvature no formula of the latitude has.
    """
    place = itrs_place(mark.latitude, mark.longitude, mark.height_m)
    t = np.array([s.utc_unix_s for s in found.sightings])
    number = np.bincount(found.faces)
    middles = np.bincount(found.faces, t) / number
    tides = np.array([plumb_tide(middle, place, mark.axes) for middle in middles.tolist()])
    east, north = number @ tides / number.sum() / ARCSEC
    tide = np.array([north, east])
    curvature = np.array([plumb_curvature_arcsec_per_m(mark.latitude) * mark.height_m, 0.0])
    at_mark = np.array([found.xi_arcsec, found.eta_arcsec]) - tide
    return {
        "tide_arcsec": tide,
        "curvature_arcsec": curvature,
        "mark_arcsec": at_mark,
        "geoid_arcsec": at_mark - curvature,
    }

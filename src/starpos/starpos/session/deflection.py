# SPDX-License-Identifier: Apache-2.0
"""The deflection of the vertical as a session goes on: its value so far, and whether that is enough."""

import math
from collections.abc import Sequence

import numpy as np

from starpos.earth.place import Place
from starpos.errors import StarposError
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.identification import Identification
from starpos.instrument.tilt_log import Tilts
from starpos.session.calibrating import OF_AVERAGE
from starpos.session.driver import Diagnosis, Jobs, Level, Outcome
from starpos.session.settings import Settings
from starpos.zenith.adjustment import DeflectionSession
from starpos.zenith.doubts import checked_session
from starpos.zenith.sighting import ZenithSighting, sighting
from starpos.zenith.stations import NEW

# An adjustment of more frames takes too long to keep up; the deflection is settled before.
MOST = 500
LEAST = 3
# adjusted again when so large a share of the frames is new
NEWS = 0.05
OF_SESSION = OF_AVERAGE | {"site.latitude", "site.longitude", "altitude"}
QUARTER = 4


class LiveDeflection:
    """Collects sightings at the mark of the parameters, while deflection.wanted is set, and adjusts them in a job."""

    def __init__(self, settings: Settings, jobs: Jobs) -> None:
        self._settings, self._jobs = settings, jobs
        self.forget()

    def forget(self) -> None:
        """Begin a new session."""
        self._sightings: list[ZenithSighting] = []
        self._found: DeflectionSession | None = None
        self._trouble = self._left_out = ""
        # number of frames in the last adjustment
        self._adjusted_of = 0
        self._jobs.disown()

    @property
    def measures(self) -> bool:
        """Whether a deflection is measured."""
        return not math.isnan(self._settings.values["deflection.wanted"])

    def parameters_set(self, names: frozenset[str]) -> None:
        """Begin a new session where the mark, the instrument or the air has changed."""
        if names & OF_SESSION:
            self.forget()

    def include(self, solver: Solver, stars: Stars, tilts: Tilts, found: Identification | None) -> None:
        """Include an identified frame; one that gives no sighting is counted by its reason only."""
        if found is None or not self.measures or len(self._sightings) >= MOST:
            return
        values = self._settings.values
        try:
            mark = Place.on_ellipsoid(
                values["site.latitude"], values["site.longitude"], height_m=values["altitude"]
            )
            self._sightings.append(sighting(solver, stars, found, mark, tilts))
        except StarposError as error:
            self._left_out = str(error)
            return
        number = len(self._sightings)
        if number >= LEAST and not self._jobs.busy and number - self._adjusted_of >= NEWS * number:
            self._adjust(solver, mark)

    def _adjust(self, solver: Solver, mark: Place) -> None:
        sightings = tuple(self._sightings)
        self._adjusted_of = len(sightings)
        # an A3 that was found by turning comes from these very frames
        instrument, air = self._settings.instrument(None), solver.atmosphere
        self._jobs.run(lambda: checked_session(sightings, instrument, air, mark), self._adjusted)

    def _adjusted(self, made: Outcome) -> None:
        self._found, self._trouble = made.value, made.trouble

    def report(self) -> Diagnosis:
        """What the session has so far, and whether it is enough."""
        if self._found is None:
            waiting = f"{len(self._sightings)} frames so far"
            said = self._trouble or self._left_out or "point the camera at the zenith"
            return Diagnosis(Level.WARN, f"{waiting}: {said}", {"frames": len(self._sightings)})
        found, wanted = self._found, self._settings.values["deflection.wanted"]
        sigma = float(found.sigma_arcsec.max())
        faces = int(found.faces.max()) + 1
        enough = sigma <= wanted and not self._trouble
        xi, eta = found.sigma_arcsec.tolist()
        text = (
            f"xi {found.xi_arcsec:+.3f} +- {xi:.3f}, eta {found.eta_arcsec:+.3f} +- {eta:.3f} arcsec, {faces} faces, "
            f"{len(found.sightings)} frames"
        )
        more = self._trouble or ("enough" if enough else f"not enough: {_lacking(found, faces, wanted)}")
        if len(self._sightings) >= MOST and not enough:
            more = f"{MOST} frames are the most: finish, and call solver/reset"
        values = {
            "xi arcsec": found.xi_arcsec,
            "eta arcsec": found.eta_arcsec,
            "sigma xi arcsec": xi,
            "sigma eta arcsec": eta,
            "wanted arcsec": wanted,
            "faces": faces,
            "frames": len(found.sightings),
            "enough": enough,
        }
        return Diagnosis(Level.OK if enough else Level.WARN, f"{more}; {text}", values)


def _lacking(found: DeflectionSession, faces: int, wanted_arcsec: float) -> str:
    """Advice on reaching the wanted error in a session."""
    if faces < QUARTER:
        return f"turn by a quarter, to face {faces + 1}"
    averages = _variance(found, [t for t in found.terms if t[0] in NEW])
    stays = [t for t in found.terms if t[0] not in NEW]
    left = wanted_arcsec**2 - _variance(found, stays)
    if left <= 0:
        name, *sizes = max(stays, key=lambda term: max(term[1:]))
        return f"more frames do not help, {name} alone leaves {max(sizes):.3f}"
    passed_s = found.sightings[-1].utc_unix_s - found.sightings[0].utc_unix_s
    minutes = max(passed_s * (averages / left - 1) / 60, 1.0)
    return f"about {minutes:.0f} min more, turning on"


def _variance(found: DeflectionSession, terms: Sequence[tuple[str, float, float]]) -> float:
    """Sum of the squares of terms, arcsec2, of the component that errs most."""
    worst = int(np.argmax(found.sigma_arcsec))
    return float(sum(sizes[worst] ** 2 for _, *sizes in terms))

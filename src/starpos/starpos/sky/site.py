# SPDX-License-Identifier: Apache-2.0
"""The sky seen from a known place: the fix solves the inverse problem."""

from dataclasses import dataclass, field

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import enu_axes
from starpos.earth.orientation import EarthState, station_velocity
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.sky.catalogue import Catalogue


@dataclass(frozen=True)
class Site:
    """A place with its air.

    Attributes
    ----------
    latitude_deg, longitude_deg : deg, astronomic
    atmosphere : of refraction

    Examples
    --------
    >>> site = starpos.Site(35.7046, 51.4106)
    >>> site.enu.shape  # rows east, north, up in ITRS
    (3, 3)
    """

    latitude_deg: float
    longitude_deg: float
    atmosphere: Atmosphere = field(default_factory=Atmosphere)

    @property
    def place(self) -> Place:
        """The place without its air, by the plumb line."""
        return Place.by_gravity(self.latitude_deg, self.longitude_deg)

    @property
    def enu(self) -> np.ndarray:
        """Rotation (3, 3) of ITRS into east, north, up."""
        return enu_axes(*np.radians([self.latitude_deg, self.longitude_deg]).tolist())

    def observed(self, catalogue: Catalogue, index: np.ndarray, state: EarthState) -> np.ndarray:
        """Refracted directions (n, 3) in ENU of the catalogue's rows `index` (n,)."""
        return self.refracted(catalogue.directions(index, state.year, state.observer_au), state)

    def refracted(self, icrs: np.ndarray, state: EarthState) -> np.ndarray:
        """Refracted directions (n, 3) in ENU of ICRS directions (n, 3) at the state's date."""
        v = rotation.normalised(state.to_itrs(icrs) + station_velocity(self.enu[2]))
        return self.atmosphere.refraction().bend(v @ self.enu.T)

    def overhead(
        self, catalogue: Catalogue, state: EarthState, toward: np.ndarray, radius: float, limit_mag: float
    ) -> np.ndarray:
        """Catalogue rows within `radius` rad of the observed direction `toward` (3,) in ENU, brightest first."""
        itrs = self.atmosphere.refraction().unbend(toward) @ self.enu
        # aberration and precession of the direction itself are far below the margin
        return catalogue.cone(itrs @ state.gcrs_to_itrs, radius + np.radians(0.05), limit_mag)


def camera_to_enu(azimuth_deg: float, altitude_deg: float, roll_deg: float) -> np.ndarray:
    """Rotation (3, 3) of C into ENU for a camera that looks at azimuth and altitude; at roll 0 its x axis is level."""
    a, h = np.radians([azimuth_deg, altitude_deg])
    z = rotation.unit_vector(np.pi / 2 - a, h)
    x = np.array([np.cos(a), -np.sin(a), 0.0])
    return np.stack([x, np.cross(z, x), z], 1) @ rotation.about_axis(2, -np.radians(roll_deg))

"""Where a map lies on the earth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.errors import ConfigError
from objslam.types import Floats

_A = 6_378_137.0
"""m, the semi-major axis of WGS 84."""
_F = 1 / 298.257223563
"""Its flattening."""
_E2 = _F * (2 - _F)


@dataclass(frozen=True)
class Datum:
    """The WGS 84 place of the map's origin, degrees, and the compass heading of its x axis, degrees clockwise from north."""

    latitude: float
    longitude: float
    heading: float

    @classmethod
    def parse(cls, text: str) -> Self:
        """A datum from "latitude,longitude,heading"; ConfigError where it is not one."""
        try:
            latitude, longitude, heading = (float(part) for part in text.split(","))
        except ValueError as error:
            hint = "for example 52.4006,16.9508,90: degrees; the map's x axis points east"
            raise ConfigError(f"--datum {text!r} is not latitude,longitude,heading", hint=hint) from error
        if not (abs(latitude) <= 90 and abs(longitude) <= 180 and abs(heading) <= 360):
            raise ConfigError(f"--datum {text!r}: latitude within 90, longitude within 180, heading within 360 degrees")
        return cls(latitude, longitude, heading)

    def geodetic(self, points: Floats) -> Floats:
        """Longitude and latitude (N, 2), degrees, of points (N, 3) of the map, m.

        East, north and up at the datum, taken through earth-centred coordinates to the ellipsoid; exact to well below 1 mm.
        """
        earth = _earth_T_enu(self)
        turn = np.radians(self.heading)
        east = points[:, 0] * np.sin(turn) - points[:, 1] * np.cos(turn)
        north = points[:, 0] * np.cos(turn) + points[:, 1] * np.sin(turn)
        x, y, z = earth[:3, :3] @ np.stack([east, north, points[:, 2]]) + earth[:3, 3:]
        across = np.hypot(x, y)
        latitude = np.arctan2(z, across * (1 - _E2))
        for _ in range(6):  # converges by e^2 each time; near the ellipsoid twice is enough
            sine = np.sin(latitude)
            latitude = np.arctan2(z + _E2 * _A / np.sqrt(1 - _E2 * sine**2) * sine, across)
        return np.degrees(np.column_stack([np.arctan2(y, x), latitude]))


def _earth_T_enu(datum: Datum) -> Floats:
    """The frame of east, north and up at a datum, in earth-centred, earth-fixed coordinates, (4, 4)."""
    latitude, longitude = np.radians([datum.latitude, datum.longitude])
    sine, cosine = np.sin(latitude), np.cos(latitude)
    radius = _A / np.sqrt(1 - _E2 * sine**2)
    pose = np.eye(4)
    pose[:3, 0] = -np.sin(longitude), np.cos(longitude), 0.0
    pose[:3, 1] = -sine * np.cos(longitude), -sine * np.sin(longitude), cosine
    pose[:3, 2] = cosine * np.cos(longitude), cosine * np.sin(longitude), sine
    pose[:3, 3] = radius * pose[:3, 2] * [1.0, 1.0, 1 - _E2]
    return pose

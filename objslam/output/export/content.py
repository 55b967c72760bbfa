"""The content of an export: a result that is read back from its folder, and the position of its map on the earth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.errors import ConfigError
from objslam.io.odometry_parquet import Motions
from objslam.io.results.read import is_site, load_map, load_motions, load_trajectory

_SEMI_MAJOR = 6_378_137.0  # The semi-major axis of the WGS 84 ellipsoid, m.
_FLATTENING = 1 / 298.257223563  # The flattening of the WGS 84 ellipsoid.
_E2 = _FLATTENING * (2 - _FLATTENING)  # The squared eccentricity of the WGS 84 ellipsoid.
_ROUNDS = 6  # The number of iterations for a latitude. Each divides the error by 150. 2 are enough near the ground.


@dataclass(frozen=True)
class Datum:
    """The WGS 84 position of the map's origin, and the compass heading of the map's x axis."""

    latitude: float  # Degrees north.
    longitude: float  # Degrees east.
    heading: float  # Degrees clockwise from north.

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the datum in the text "latitude,longitude,heading", degrees.

        Raises ConfigError if the text is malformed or a number is out of range.
        """
        try:
            latitude, longitude, heading = (float(part) for part in text.split(","))
        except ValueError as error:
            hint = "give degrees: 52.4006,16.9508,90 is a map whose x axis points east"
            raise ConfigError(f"--datum {text!r} is not latitude,longitude,heading", hint=hint) from error
        if not (abs(latitude) <= 90 and abs(longitude) <= 180 and abs(heading) <= 360):
            raise ConfigError(f"--datum {text!r}: use degrees, latitude within 90, longitude within 180, heading within 360")
        return cls(latitude, longitude, heading)

    def geodetic(self, points: Floats) -> Floats:
        """Return longitude and latitude (N, 2), degrees, of points (N, 3) in map, m. The error is well below 1 mm.

        Points are converted to east, north and up at the datum, then to earth-centred and then to geodetic coordinates.
        """
        latitude, longitude, heading = np.radians([self.latitude, self.longitude, self.heading])
        sine, cosine = np.sin(latitude), np.cos(latitude)
        to_east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
        to_up = np.array([cosine * np.cos(longitude), cosine * np.sin(longitude), sine])
        origin = _SEMI_MAJOR / np.sqrt(1 - _E2 * sine**2) * to_up * [1.0, 1.0, 1 - _E2]
        earth_R_enu = np.stack([to_east, np.cross(to_up, to_east), to_up], axis=1)
        east = points[:, 0] * np.sin(heading) - points[:, 1] * np.cos(heading)
        north = points[:, 0] * np.cos(heading) + points[:, 1] * np.sin(heading)
        x, y, z = earth_R_enu @ np.stack([east, north, points[:, 2]]) + origin[:, None]
        across = np.hypot(x, y)
        found = np.arctan2(z, across * (1 - _E2))
        for _ in range(_ROUNDS):
            found = np.arctan2(z + _E2 * _SEMI_MAJOR / np.sqrt(1 - _E2 * np.sin(found) ** 2) * np.sin(found), across)
        return np.degrees(np.column_stack([np.arctan2(y, x), found]))


@dataclass(frozen=True)
class Content:
    """A result to export."""

    out: Path  # The result folder. Error messages name it.
    objects: ObjectMap
    path: Trajectory  # map_T_base at the stamp of each keyframe. The map of a site has no path.
    motions: Motions | None  # The odometry between consecutive poses of the path. None without odometry.
    datum: Datum | None = None  # The position of the map on the earth. None if unknown.


def load_content(out: Path, datum: Datum | None = None) -> Content:
    """Return the content of a result folder or of the map of a site, and `datum`.

    Raises OutputError, which names a missing or malformed file.
    """
    objects = load_map(out)
    path = Trajectory(np.zeros(0), np.zeros((0, 4, 4))) if is_site(out) else load_trajectory(out)
    return Content(out, objects, path, load_motions(out), datum)

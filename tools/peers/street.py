"""Simulate street furniture seen from a car with GPS: one label, few views each, bearings with rough depths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.simulation import make_camera

_BLOCK, _STEP = 100.0, 8.0
"""The side of the block of houses that the car drives around, and the distance between two of its places, m."""
_ASIDE = (4.0, 9.0)
"""How far from the car's way an object stands, m."""
_APART = 6.0
"""The least distance between two objects, m. A larger one makes the street easier."""
_REACH = 25.0
"""The distance up to which the detector finds an object, m."""
_OBJECTS, _MOST_VIEWS = 50, 6
_FALSE = 0.1
"""The number of false boxes as a share of the true ones. A false box has a random bearing and a random depth."""
_DEPTH = 0.15
"""The noise of a depth as a share of it."""
_FOCAL = 400.0
"""The focal length of the four fisheye cameras, px per rad."""
_TURNS = np.radians([0.0, 90.0, 180.0, 270.0])


@dataclass(frozen=True)
class Street:
    """A simulated street. gps: m. bearing: rad. log: as objslam maps it. origin: (R, 2) m, heading: (R,) rad, range: (R,) m,
    place: (R,), of each box as the peer takes them. whose: (R,) the true object, -1 for a false box. objects: (N, 2) m."""

    gps: float
    bearing: float
    log: Log
    origin: Floats
    heading: Floats
    range: Floats
    place: Ints
    whose: Ints
    objects: Floats

    @property
    def views(self) -> Ints:
        """The number (N,) of boxes of each object."""
        return np.bincount(self.whose[self.whose >= 0], minlength=len(self.objects))

    def settings(self, told: bool) -> Settings:
        """Return the settings of a run. told: whether they say the true noise. Else they say that of the defaults."""
        noise = {
            "localization": {"xy": self.gps, "yaw": 1e-3},
            "rays": {"pixel_sigma": self.bearing * _FOCAL, "box_sigma": 0.0},
            "depth": {"sigma": 1e-3, "sigma_per_m": _DEPTH, "bias": 0.0},
        }
        return Settings.model_validate({"output": {"recording": False}, **(noise if told else {})})


def simulate_street(seed: int) -> Street:
    """Simulate one street. The GPS noise is 0.5 to 3 m along each axis, that of bearings 1 to 3 degrees."""
    rng = np.random.default_rng(seed)
    gps, bearing = rng.uniform(0.5, 3.0), np.radians(rng.uniform(1.0, 3.0))
    at, yaw = _way(np.arange(0.0, 4 * _BLOCK, _STEP))
    objects = _stand(rng)
    box_place, box_object = [], []
    for number, position in enumerate(objects):
        near = np.flatnonzero(np.hypot(*(at - position).T) < _REACH)
        seen = rng.permutation(near)[: rng.integers(1, _MOST_VIEWS + 1)]
        box_place += seen.tolist()
        box_object += [number] * len(seen)
    place, whose = np.array(box_place), np.array(box_object)
    offset = objects[whose] - at[place]
    heading, distance = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(*offset.T)
    false = round(_FALSE * len(place))
    place, whose = np.append(place, rng.integers(len(at), size=false)), np.append(whose, np.full(false, -1))
    heading = np.append(heading, rng.uniform(-np.pi, np.pi, false)) + bearing * rng.standard_normal(len(place))
    distance = np.append(distance, rng.uniform(5.0, _REACH, false))
    distance = distance * np.maximum(1 + _DEPTH * rng.standard_normal(len(place)), 0.2)
    measured = at + gps * rng.standard_normal(at.shape)
    order = np.argsort(place, kind="stable")
    place, heading, distance, whose = place[order], heading[order], distance[order], whose[order]
    return Street(
        gps,
        bearing,
        _log(measured, yaw, place, heading - yaw[place], distance, objects),
        measured[place],
        heading,
        distance,
        place,
        whose,
        objects,
    )


def _way(driven: Floats) -> tuple[Floats, Floats]:
    """Return the position (n, 2) m and the heading (n,) rad after a way (n,) m around the block."""
    side = np.floor(driven / _BLOCK).astype(np.int64) % 4
    corner = np.array([[0.0, 0.0], [_BLOCK, 0.0], [_BLOCK, _BLOCK], [0.0, _BLOCK]])
    yaw = side * np.pi / 2
    along = (driven % _BLOCK)[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return corner[side] + along, yaw


def _stand(rng: np.random.Generator) -> Floats:
    """Return positions (N, 2) m on both sides of the way."""
    objects = np.zeros((0, 2))
    while len(objects) < _OBJECTS:
        at, yaw = _way(rng.uniform(0, 4 * _BLOCK, 1))
        aside = rng.choice([-1, 1]) * rng.uniform(*_ASIDE)
        position = at[0] + aside * np.array([-np.sin(yaw[0]), np.cos(yaw[0])])
        if not len(objects) or np.hypot(*(objects - position).T).min() >= _APART:
            objects = np.vstack([objects, position])
    return objects


def _log(measured: Floats, yaw: Floats, place: Ints, bearing: Floats, distance: Floats, objects: Floats) -> Log:
    """Return the log of four fisheye cameras that look around, with all objects at the height of the cameras."""
    stamps, name = np.arange(len(measured), dtype=np.float64), "pole"
    cameras = []
    nearest = np.round(bearing / (np.pi / 2)).astype(np.int64) % len(_TURNS)
    width = int(_FOCAL * np.pi / 2) + 4
    for number, turn in enumerate(_TURNS.tolist()):
        mine = np.flatnonzero(nearest == number)
        left = (bearing[mine] - turn + np.pi) % (2 * np.pi) - np.pi
        like = make_camera(
            f"camera{number}", width=width, height=200, focal=_FOCAL, position=(0.0, 0.0, 2.0), yaw=turn,
            distortion_model="equidistant", distortion=(0.0,) * 4,
        )  # fmt: skip
        camera = replace(like, sees_size=False)
        centre = np.column_stack([(width - 1) / 2 - _FOCAL * left, np.full(len(mine), 199 / 2)])
        found = Detections(
            stamps,
            place[mine],
            np.hstack([centre - 4, centre + 4]),
            np.zeros(len(mine), dtype=np.int64),
            np.full(len(mine), 0.9),
            distance[mine] * np.cos(left),
            np.full(len(mine), -1),
            (name,),
            whole=True,
        )
        cameras.append(CameraLog(camera, found))
    truth = Truth(tuple(TruthObject(i, name, np.append(p, 2.0)) for i, p in enumerate(objects)))
    path = Trajectory(stamps, lift_se2(np.column_stack([measured, yaw])))
    return Log("street", tuple(cameras), localization=path, truth=truth)

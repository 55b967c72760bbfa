"""The landmarks of a session: where they are, how well that is known, and how often they were seen where they should be."""

from __future__ import annotations

import numpy as np

from objslam.geometry import skew
from objslam.live.table import Table
from objslam.types import Bools, Camera, Floats, Ints

_FLOOR = 0.01  # m; landmarks are never taken to be known better than that
_KNOWN = _FLOOR**2 * np.eye(3)
_HELD = 1e-4 * np.eye(3)  # m^-2; rays that all run one way say nothing along it
_NOISE = (1.0, 3.0)  # times the noise that was promised
_POOLED = 20.0  # rays that weigh an object's own noise as much as the promised one
_INNER = 0.05  # share of the image along its edge where a box may be cut off
_NEAREST = 0.3  # m; nearer things do not fit into the image
HORIZON = 0.06  # rad of drift in heading since they were last seen: others may stand elsewhere than expected
_FURTHER = 1.1  # times the distance from which an object was seen, it should be seen from


def new_landmarks() -> Table:
    """No landmarks yet. id; position (3,) m; information (3, 3) m^-2 of its rays; label; drift (6, 6) gathered when it was
    last seen, and stamps first and last; seen and expected, frames; far, m, the greatest distance it was seen from; squared,
    the sum of squared deviations of its rays; rejected, rays that did not fit."""
    return Table(
        id=(np.int64, ()),
        position=(np.float64, (3,)),
        information=(np.float64, (3, 3)),
        label=(np.int64, ()),
        drift=(np.float64, (6, 6)),
        first=(np.float64, ()),
        last=(np.float64, ()),
        seen=(np.int64, ()),
        expected=(np.int64, ()),
        far=(np.float64, ()),
        squared=(np.float64, ()),
        rejected=(np.int64, ()),
    )


def noise(known: Table, rows: Ints) -> Floats:
    """By what factor (n,) the rays of landmarks are noisier than promised."""
    seen = known.seen[rows] + _POOLED
    least, most = _NOISE
    return np.asarray(np.minimum(np.maximum(np.sqrt((known.squared[rows] / 2 + _POOLED) / seen), least), most))


def covariances(known: Table, rows: Ints) -> Floats:
    """Covariances (n, 3, 3), m^2, of landmarks from their rays, as if the poses were known."""
    return np.linalg.inv(known.information[rows] + _HELD) + _KNOWN


def levers(to: Floats, map_T_camera: Floats) -> Floats:
    """What a small motion of the camera, in its own frame, does to how landmarks `to` (n, 3) away lie to it: (n, 3, 6)."""
    turn = map_T_camera[:3, :3]
    lever = np.empty((len(to), 3, 6))
    lever[:, :, :3] = skew(to) @ turn
    lever[:, :, 3:] = -turn
    return lever


def carried(to: Floats, covariance: Floats, map_T_camera: Floats) -> Floats:
    """What covariances (n, 6, 6) of the camera, or one (6, 6), in its own frame, make of landmarks `to` (n, 3) away:
    (n, 3, 3), m^2."""
    lever = levers(to, map_T_camera)
    return np.asarray(lever @ covariance @ np.swapaxes(lever, 1, 2))


def gathered(now: Floats, then: Floats) -> Floats:
    """What drift (6, 6) was gathered since it was `then` (n, 6, 6): nothing for a frame that comes late, from before."""
    since = now - then
    return np.where((np.trace(since, axis1=1, axis2=2) > 0)[:, None, None], since, 0.0)


def long_unseen(now: Floats, then: Floats) -> Bools:
    """Of which things (n,) that were last seen at the drift `then` (n, 6, 6) a robot with the drift now (6, 6) was away."""
    return np.asarray(now[2, 2] - then[:, 2, 2] > HORIZON**2)


def in_view(known: Table, camera: Camera, map_T_camera: Floats, margin: float = _INNER, reach: float = 0.0) -> Bools:
    """Which landmarks (N,) should be seen: well inside the image, and from no further than they were seen.

    margin: the share of the image along its edge that does not count; negative, one around it that does. reach: m,
    from how far all of them should be seen, even if they were not.
    """
    from objslam.rays import project

    local = (known.position - map_T_camera[:3, 3]) @ map_T_camera[:3, :3]
    distance = np.linalg.norm(local, axis=1)
    near = distance < _FURTHER * np.maximum(known.far, reach)
    ahead = np.flatnonzero(near & (local[:, 2] > _NEAREST) & (local[:, 2] > 0.3 * distance))
    seen = np.zeros(len(known), dtype=bool)
    pixels = project(camera, local[ahead])
    inside = (pixels > margin * camera.size) & (pixels < (1 - margin) * camera.size)
    seen[ahead] = inside.all(axis=1)
    return seen

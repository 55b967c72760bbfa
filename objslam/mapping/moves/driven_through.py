"""Objects that the robot drove through. Such an object has moved, or it is no thing.

Rays of things that are half hidden may cross at a place where nothing is, as in a doorway through which a robot saw parts of
a couch. Then the boxes hardly show the mistake, but the robot drove there.
"""

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.bodies.body import Body
from objslam.core.result import Doubt, RunResult

_SIGMAS = 1.0
"""The path must be inside the footprint of an object by this many standard deviations of its place. In simulated doorways,
the robot drove 2 to 5 cm from the middle of such objects, whose standard deviations were 4 to 12 cm. A larger number names
fewer objects."""
_OVERLAP = 0.1
"""The robot must overlap the body by at least this height (m). Mats and signs above the robot do not stop it. A larger
height names fewer objects."""
_LOWEST = 0.2
"""The least height (m) of a robot. If its camera is higher, the robot reaches up to the camera. A larger height names more
objects."""
_NAMED = 3
"""The most objects, or pairs of them, that a sentence of the assessment names. With a larger number, it is longer."""


def driven_through(result: RunResult) -> list[Doubt]:
    """Return a doubt for each object whose body contains a part of the robot's path."""
    path = result.path_after.poses[:, :3, 3]
    top = max(_LOWEST, *(float(one.base_T_camera[2, 3]) for one in result.cameras))
    found = []
    for o in result.map.resolved():
        if o.body is None or o.covariance is None:
            continue
        inside = _inside(o.body, o.position, o.covariance, path, top)
        if not inside.any():
            continue
        near = float(np.linalg.norm(path[inside, :2] - o.position[:2], axis=1).min())
        stamp = float(result.path_after.stamps[inside][0])
        found.append(
            Doubt(
                "split",
                "driven through",
                o.label,
                f"The robot drove through {o.label} #{o.id} (at stamp {stamp:.3f}, {near:.2f} m from its middle): it has "
                "moved, or it is no thing, and its rays are of several things or of hidden ones.",
                (o.id,),
                o.position,
                np.flatnonzero(result.association.object == o.id),
                {"distance_m": near, "stamp": stamp},
            )
        )
    return found


def _inside(body: Body, position: Floats, covariance: Floats, path: Floats, top: float) -> Bools:
    """Return where the path (N, 3), m, is inside a body at a position (3,) with a covariance (3, 3). top: m, the robot's
    height."""
    c, s = np.cos(body.yaw), np.sin(body.yaw)
    axes = np.array([[c, s], [-s, c]])
    off = np.abs((path[:, :2] - position[:2]) @ axes.T)
    half = body.size[:2] / 2 - _SIGMAS * np.sqrt(np.diagonal(axes @ covariance[:2, :2] @ axes.T))
    middle = position[2] - path[:, 2]
    low, high = middle - body.size[2] / 2, middle + body.size[2] / 2
    overlap = np.minimum(high, top) - np.maximum(low, 0.0)
    return np.asarray((off < half).all(axis=1) & (overlap >= _OVERLAP))


def in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentence about the objects for the assessment."""
    if not doubts:
        return []
    names = first_names([f"{one.label} #{one.objects[0]}" for one in doubts])
    return [f"The robot drove through {names}: what has moved, or is no thing, is at a wrong place."]


def first_names(names: list[str]) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more

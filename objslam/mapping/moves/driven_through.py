"""Find objects that the robot drove through. Such an object has moved, or is no thing.

Rays of things that are half hidden may cross at a place without a thing. An example is a doorway through which a robot saw
parts of a couch. The boxes hardly show this mistake, but the robot's path may lead through the place."""

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.bodies.body import Body
from objslam.core.result import Doubt, RunResult

_SIGMAS = 1.0
"""The number of standard deviations of an object's place by which the path must be inside the object's footprint. In
simulated doorways, the robot drove 2 to 5 cm from the middle of false objects, whose standard deviations were 4 to 12 cm.
With a larger number, fewer objects are named."""
_OVERLAP = 0.1
"""The least height (m) by which the robot must overlap the body. Mats, and signs above the robot, do not stop a robot. With
a larger height, fewer objects are named."""
_LOWEST = 0.2
"""The least assumed height (m) of a robot. If a camera is higher, the robot reaches up to this camera. With a larger height,
more objects are named."""
_NAMED = 3
"""The most objects, or pairs of objects, that a sentence of the assessment names. With a larger number, the sentence is
longer."""


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
    """Return a mask (N,) of the places of the path (N, 3), m, that are inside a body. position: (3,) m, and covariance: (3,
    3) m^2, of the body. top: m, the robot's height."""
    c, s = np.cos(body.yaw), np.sin(body.yaw)
    axes = np.array([[c, s], [-s, c]])
    off = np.abs((path[:, :2] - position[:2]) @ axes.T)
    half = body.size[:2] / 2 - _SIGMAS * np.sqrt(np.diagonal(axes @ covariance[:2, :2] @ axes.T))
    middle = position[2] - path[:, 2]
    low, high = middle - body.size[2] / 2, middle + body.size[2] / 2
    overlap = np.minimum(high, top) - np.maximum(low, 0.0)
    return np.asarray((off < half).all(axis=1) & (overlap >= _OVERLAP))


def in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentence of the assessment about these objects, as a list that is empty without doubts."""
    if not doubts:
        return []
    names = first_names([f"{one.label} #{one.objects[0]}" for one in doubts])
    return [f"The robot drove through {names}: what has moved, or is no thing, is at a wrong place."]


def first_names(names: list[str]) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more

"""Objects that have a position, but a wide sigma: a robot that drives to one of them may miss it."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.bodies.body import Body
from objslam.core.maps.shared_covariance import SIZE, jacobian, own_part, root_of
from objslam.core.object_map import MapObject
from objslam.core.result import Doubt, RunResult
from objslam.mapping.checks.assessment import untold_scale

_NAMED = 3
"""The most objects that the assessment names. A larger number makes the assessment longer."""
_WIDE = 30.0
"""The angle (deg) between rays from which more views hardly make the point of an object surer. A wide sigma then comes from
the poses or from the body. With a larger angle, more people are told to drive around the object."""
_BY_BODY = 0.7
"""A wide sigma comes from the body if half the sigma of the body's size in the same direction is at least this share of the
wide sigma. With a larger share, fewer people are told to look at another side of the object."""
_MOST = 0.5
"""A map is good only if at most this share of its objects with a position is unsure. With a larger share, more maps are
good."""


def unsure_objects(result: RunResult) -> list[Doubt]:
    """Return a doubt for each object with a position whose sigma exceeds `triangulation.sure_sigma`, the least sure first.

    The error that all objects share does not count, because it moves the whole map together with a robot in it. In the frame
    of the odometry, an unknown scale of the odometry also moves the whole map together with the robot. If the path bends
    with the scale, the covariance of the shared error contains only a part of the scale.
    """
    known = [o for o in result.map if o.covariance is not None and o.status == "ok"]
    if not known:
        return []
    covariance, by_odometry = np.array([o.covariance for o in known]), _in_odometry_frame(result)
    if result.map.shared_covariance is not None:
        shared = result.map.shared_covariance.copy()
        if by_odometry:
            shared[SIZE, SIZE] = max(shared[SIZE, SIZE], (untold_scale(result.summary) or 0.0) ** 2)
        covariance = own_part(covariance, jacobian(np.array([o.position for o in known])) @ root_of(shared))
    variance, axes = np.linalg.eigh(covariance)
    sigma, direction = np.sqrt(variance[:, -1]), axes[:, :, -1]
    most = result.settings.triangulation.sure_sigma
    found = []
    for i in np.argsort(-sigma, kind="stable").tolist():
        o = known[i]
        if sigma[i] <= most:
            break
        found.append(
            Doubt(
                "unsure",
                "wide sigma",
                o.label,
                f"{o.label} #{o.id} has a sigma of {sigma[i]:.2f} m in its least certain direction "
                f"(triangulation.sure_sigma {most:g} m): {_why(o, float(sigma[i]), direction[i], by_odometry)}",
                (o.id,),
                o.position,
                np.flatnonzero(result.association.object == o.id),
                {"sigma_m": float(sigma[i]), "rays": o.rays, "parallax_deg": o.parallax_deg},
            )
        )
    return found


def _in_odometry_frame(result: RunResult) -> bool:
    """Return whether nothing but the odometry tells where the robot is. `ObjectMap.frame` is only the name of the frame."""
    return bool(result.summary.get("map_frame") == "odometry")


def _why(o: MapObject, sigma: float, direction: Floats, by_odometry: bool) -> str:
    """Return the cause of a wide sigma (m), and what to do. direction: (3,) the unit direction of the sigma. by_odometry:
    whether the map lies in the frame of the odometry."""
    if o.body is not None and _sigma_by_size(o.body, direction) >= _BY_BODY * sigma:
        return (
            "its boxes do not show how far it goes on in this direction. Drive to where another side of it shows, or set "
            f"its size: bodies.sizes={{{o.label}: [length, width, height]}}."
        )
    span = f"its {o.rays} rays span {o.parallax_deg:.1f} deg"
    if o.parallax_deg < _WIDE:
        return f"{span}. Drive around it, or past it nearby."
    if by_odometry:
        return f"{span}, so it is the path that is not sure there. Come back from there to things that were seen before."
    return f"{span}, so it is the poses that are not sure there. A better localisation helps, and more views do not."


def _sigma_by_size(body: Body, direction: Floats) -> float:
    """Return the standard deviation (m) that the unknown size of a body gives to its centre in a direction (3,)."""
    cos, sin = np.cos(body.yaw), np.sin(body.yaw)
    along = np.array([cos, sin, 0.0]) @ direction, np.array([-sin, cos, 0.0]) @ direction, direction[2]
    return float(np.linalg.norm(body.size_sigma * np.array(along))) / 2


def in_assessment(doubts: list[Doubt], result: RunResult) -> list[str]:
    """Return the sentence about the objects for the assessment."""
    if not doubts:
        return []
    names = [f"{one.label} #{one.objects[0]} ({one.numbers['sigma_m']:.2f} m)" for one in doubts[:_NAMED]]
    more = f" and {len(doubts) - _NAMED} more" if len(doubts) > _NAMED else ""
    have = "1 position has a sigma" if len(doubts) == 1 else f"{len(doubts)} positions have a sigma"
    return [f"{have} above {result.settings.triangulation.sure_sigma:g} m: {', '.join(names)}{more}."]


def are_most(doubts: list[Doubt], result: RunResult) -> bool:
    """Return whether most objects with a position are unsure."""
    return len(doubts) > _MOST * len(result.map.resolved())

"""Find things that move along the view. Their ranges follow a trend that no thing at rest has.

A person who walks ahead of a robot stays near one direction, so the rays nearly meet in a point. Only the ranges grow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.camera import Camera
from objslam.core.estimate import Estimate
from objslam.core.geometry import lengths
from objslam.core.noise import range_noise
from objslam.core.statistics import grouped_median
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.surface_ranges import half_widths_of_rays
from objslam.mapping.moves.constant_velocity import FEWEST, Sights, Views, fit_point, noise_about_motions
from objslam.mapping.moves.ray_noise import noise_of_rays

_CLEAR = 20.0
"""The least gain of a moving point over a point at rest, in -2 ln of the likelihood. It is also the least square of the
velocity along the view over its variance. By noise alone, a share of 8e-6 of the views have such a velocity (chi-squared, 1
degree of freedom). In simulations, people had 32 to 160. Things seen in one visit had at most 5, and things seen in several
visits at most 24. With a larger value, fewer moving things are found."""
_WITHIN = 0.75
"""The largest distance by which a thing at rest may seem to move along the view, as a share of its width. A range ends
anywhere on a surface, so it changes with the side that is seen. People who walked for half a second had 1.0 and more. With a
share of 1, these people became objects. With a larger share, fewer moving things are found."""
_POSES = 4.2
"""The largest distance by which a thing at rest may seem to move because the poses err, in standard deviations of the
robot's places. The difference of two places has sqrt(2) times the standard deviation of one place, and 3 times that is 4.2.
With a larger number, fewer moving things are found."""
_MOST = 0.5
"""The share of a thing's rays that must be in views that move, so that the thing moves. It must be exceeded among all its
rays, and in each judged visit. With a larger share, fewer moving things are found."""
_OWN = 2.0
"""The weight of the label's noise in the scatter of one view about its moving point, as a number of ranges. With a larger
number, a view whose ranges jump to a background more often seems to move."""
_OTHERS = 2
"""The fewest things of a label that show how much things at rest of this label seem to move. Each was seen again at its
place. A single such thing may be a person who was there twice. With a larger number, fewer labels are judged by their own
things."""
_MEDIAN = 0.455  # The median of chi-squared with 1 degree of freedom.


def things_along_the_view(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    estimate: Estimate,
    map_T_camera: Floats,
    settings: Settings,
    cameras: Sequence[Camera],
) -> Bools:
    """Return a mask (N,) of the objects whose ranges show that their things move along the view (`moving_along`).

    Args: keyframes, rays, association, estimate: of the map. map_T_camera: (K, 4, 4). settings: of the run. cameras: of the
    log.
    """
    placed = np.append(np.isfinite(estimate.positions[:, 0]), False)  # The last entry is for rays without an object.
    held = np.flatnonzero((estimate.weight > 0) & placed[association.object])
    thing, noise = association.object[held], noise_of_rays(keyframes, rays, settings)
    origin, direction = (lines[held] for lines in rays.in_map(map_T_camera))
    distance = lengths(estimate.positions[thing] - origin)
    known = np.isfinite(rays.range[held]) & (rays.range[held] > 0)
    half, camera = half_widths_of_rays(rays, keyframes, cameras)[held], keyframes.camera[rays.keyframe[held]]
    sights = Sights(
        thing=thing,
        time=keyframes.stamps[rays.keyframe[held]],
        origin=origin,
        direction=direction,
        across=distance * noise.at(distance, held),
        range=np.where(known, rays.range[held], np.nan),
        nominal=range_noise(np.where(known, rays.range[held], 1.0), half, camera, cameras, settings)[0],
        bias=np.nan_to_num(rays.range_bias[held]),
        half=half,
        place=estimate.positions,
        label=association.label,
    )
    return moving_along(sights, noise.place)[0]


def moving_along(sights: Sights, place: float) -> tuple[Bools, Floats]:
    """Return a mask (N,) of the things that move along the view, and the longest way (N,), m, that each thing seems to move
    in one view.

    A view shows a motion under two conditions. A point with a constant velocity explains the rays and ranges of the view far
    better than a point at rest. The moving point moves along the view by more than the surface of a thing at rest can
    explain. A thing moves if most of its rays are in views that show a motion. A thing that rests in at least one of its
    visits does not move.

    Each label has its own noise of ranges: their scatter about the moving points. Some ranges pass through a table and end
    on the floor behind it. So the ranges of tables are noisy, and the ranges of people who walk are not. The fit allows an
    error that all ranges of a view share, and a few wrong ranges.

    place: m, the standard deviation of the places of the robot.
    """
    count = len(sights.label)
    if not len(sights.thing):
        return np.zeros(count, dtype=bool), np.zeros(count)
    views = Views.of(sights)
    judged = views.number >= FEWEST
    if not judged.any():
        return np.zeros(count, dtype=bool), np.zeros(count)
    level = noise_about_motions(views)
    rest, moves = (fit_point(views, level, moving=moving) for moving in (False, True))
    clear = np.where(judged, moves.speed**2 / moves.variance, 0.0)
    scatter = np.maximum((_OWN + moves.along) / (_OWN + np.maximum(views.number - 2, 0)), 1.0)
    way = np.where(judged, np.abs(moves.speed) * views.seconds, 0.0)
    moved = judged & (np.minimum(rest.cost - moves.cost, clear / _usual(views, clear)[views.label]) > _CLEAR * scatter)
    moved &= way > np.hypot(_WITHIN * views.width, _POSES * place)
    held, of_moving = (np.bincount(views.visit, number) for number in (views.rays, views.rays * moved))
    rests = (np.bincount(views.visit, judged) > 0) & (of_moving <= _MOST * held)
    thing = views.thing[np.unique(views.visit, return_index=True)[1]]
    stays = np.bincount(thing, rests, count) > 0
    all_held, all_moving = (np.bincount(thing, number, count) for number in (held, of_moving))
    far = np.zeros(count)
    np.maximum.at(far, views.thing, way)
    return np.asarray(~stays & (all_moving > _MOST * all_held)), far


def _usual(views: Views, clear: Floats) -> Floats:
    """Return the factors (L,), at least 1, by which things at rest of each label seem to move more clearly than noise
    explains.

    A thing that is seen again at its place is at rest. Its ranges may change all the same, as those to a sign seen from the
    side do while the robot drives past. clear: (V,) the square of the velocity along the view over its variance.
    """
    labels = int(views.label.max()) + 1
    judged, first = views.number >= FEWEST, np.unique(views.visit, return_index=True)[1]
    again = judged & (np.bincount(views.thing[first])[views.thing] > 1)
    things = np.unique(views.thing[again], return_index=True)[1]
    several = np.bincount(views.label[again][things], minlength=labels) >= _OTHERS
    every = max(float(np.median(clear[judged])) / _MEDIAN, 1.0)
    own = np.nan_to_num(grouped_median(clear[again], views.label[again], labels)) / _MEDIAN
    return np.where(several, np.maximum(own, every), every)

"""Drop objects of things that move. For example, people walk through a place again and again, and their rays seem to meet
there."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.geometry import angles_off, lengths
from objslam.core.statistics import BETWEEN_VISITS, grouped_visits
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.frontend.tracks import FEWEST, tracks_of_rays
from objslam.mapping.moves.ray_noise import RayNoise, noise_of_rays
from objslam.mapping.moves.receding_things import things_along_the_view

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.arrays import Bools, Floats, Ints
    from objslam.core.estimate import Estimate
    from objslam.core.types import Keyframes, Rays
    from objslam.mapping.joint.joint_alternation import JointState

_PURE = 0.95
"""The mean share of an object's rays in their tracks below which the object may be of a thing that moves. A track of a thing
at rest has all its rays at one object. A track that passes through an object has other rays too. Of 100 simulated things at
rest, two had 0.87 and 0.9, and the others 0.92 and more. With a larger share, more objects are dropped."""
_PASSED = 0.85
"""The same mean share for all objects of a label, below which the things of the label may move. People and carts that drive
around had 0.2 to 0.75 in simulations. With a larger share, more objects are dropped."""
_HELD = 0.93
"""The share of a label's rays in tracks that have an object, below which the things of the label may move. Rays to a thing
that moves meet at few of its places. Simulated carts had 0.56 to 0.86. Pallets in rows, whose tracks join neighbours, had
0.98. With a larger share, more objects are dropped."""
_SCATTER = 1.5
"""The multiple of the usual root mean square residual that the rays of a label must exceed, so that its things move. Tracks
also pass from one thing to the next where equal things stand close together, but then the rays fit. Single real landmarks in
groups had 0.8 to 2.0. All objects of people together had 3 and more, and all objects of carts together had 1.9 to 2.4. With
a larger multiple, fewer objects are dropped."""
_LONG = 6
"""The fewest rays of a track that can show that a thing of a moving label is at rest. The rays of a shorter track meet in a
point even if the thing moves. For example, a cart with four rays in tracks of three passed for a thing at rest. With a
larger number, more objects of such labels are dropped."""
_FOLLOWS = 0.3
"""The share of a label's rays in long tracks that must follow things that move, so that the label wanders. Recorded robots
had 0.3 to 1. With 0.25, a thing at rest was lost that has its label in common with two moving things. With 0.4, recorded
robots became two more objects in five minutes. With a larger share, fewer moving labels are found."""
_VISITS = 2
"""The fewest visits to an object that is kept although its label wanders. In one visit, the rays to a robot that drives on a
line often meet in a point. Only a second visit shows that this was chance. With a larger number, more objects are
dropped."""
_APART = 3.0
"""The multiple of the usual root mean square residual above which the rays of a track meet in no point. Recorded robots that
other robots saw had 0.4 to 60. With a larger multiple, fewer moving labels are found."""
_EXPLAINED = 0.8
"""The least share of a track's rays that have an object, at which the track is of things at rest. Recorded landmarks had
0.98 and more, and recorded robots 0.5 on average. With a larger share, more moving labels are found."""
_USUAL = 3
"""The fewest objects from which the usual scatter is measured. These are objects whose tracks have hardly any other rays,
and whose label does not seem to move. With a larger number, fewer maps are judged."""


def without_moving_things(state: JointState) -> JointState:
    """Return the state without objects of things that move (`things_at_rest`), else the state itself."""
    return _dropped(state, np.zeros(0, dtype=np.int64))[0]


def associated_at_rest(state: JointState) -> JointState:
    """Return the state without objects of things that move, after new rounds of association, else the state itself.

    The solve bent the path to rays that meet by chance. At a bent path, a thing at rest may have one object for each visit,
    and some of its rays are at no object or at a wrong one. So objects that appear twice are merged at the new path. Rounds
    of association follow, and count if they explain the log better. Objects of moving labels that these rounds find are
    dropped too. Things that move along the view are single objects, which hardly bend a path. If only such objects are
    dropped, no rounds follow.
    """
    left, labels = _dropped(state, np.zeros(0, dtype=np.int64))
    if left is state or not len(labels):
        return left
    left = left.merged()
    assert left.association is not None
    assert left.estimate is not None
    try:
        rounds = left.attempt().alternated(left.estimate.map_T_base, (left.association, left.estimate.positions))
        rounds = _dropped(rounds, labels)[0].merged()
    except SolveError:  # The map before the rounds is there.
        return left
    best, refuted = left.better(rounds), left.association.refuted
    if best is left or refuted is None:
        return best
    found = best.association
    assert found is not None
    refuted = refuted & (found.object < 0)
    return replace(best, association=replace(found, refuted=refuted if found.refuted is None else refuted | found.refuted))


def _dropped(state: JointState, known: Ints) -> tuple[JointState, Ints]:
    """Return the state without objects of things that move, and the labels whose things move. known: as in
    `things_at_rest`."""
    assert state.association is not None
    assert state.estimate is not None
    before = state.association
    given = state.keyframes, state.rays, before, state.estimate, state.solved_poses, state.settings
    along = things_along_the_view(*given, state.cameras)
    left = things_at_rest(*given, known, None if state.names is None else state.names.label, along)
    if left is before:
        return state, known
    gone = np.unique(before.object[(before.object >= 0) & (left.object < 0)])
    # One cart that is pushed away does not tell that the other things of its label move.
    return state.counted(left).solve("association", left, state.solved_poses), np.unique(before.label[gone[~along[gone]]])


def things_at_rest(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    estimate: Estimate,
    map_T_camera: Floats,
    settings: Settings,
    known: Ints | None = None,
    names: Ints | None = None,
    along: Bools | None = None,
) -> Association:
    """Return the association without objects of things that move, else the association itself.

    The rays of people who walk through a room meet by chance near some points, because there are many of them. A round of
    association takes each ray by itself. But boxes of images that follow each other show one thing. If it moves, its track
    passes through the object, and the rays before and after belong to no object or to another one. Whole labels are judged,
    because tracks of a few things at rest also pass on to equal things beside them. If nearly all rays of a label have an
    object, its things are at rest. An object of a moving label stays only if long tracks show that it is at rest. If all
    things have one label, the usual scatter is unknown, and all objects stay. estimate: the estimate of the association.
    map_T_camera: (K, 4, 4) the poses of the estimate. known: labels that are known to move. names: labels that are known to
    be names of things at rest. Their objects stay. along: (N,) a mask of the objects whose ranges show that their things
    move (`things_along_the_view`).
    """
    moving = _moving(keyframes, rays, association, estimate, map_T_camera, settings, known)
    if along is not None:
        moving |= along
    if names is not None:
        moving &= ~np.isin(association.label, names)
    return without_things(association, moving)


def without_things(association: Association, gone: Bools) -> Association:
    """Return the association without the objects in the mask `gone` (N,). Their rays become refuted. If the mask is empty,
    the association itself is returned."""
    if not gone.any():
        return association
    number = np.append(np.where(gone, -1, np.cumsum(~gone) - 1), -1)
    refuted = gone[association.object] & (association.object >= 0)
    return Association(
        number[association.object],
        association.label[~gone],
        label_weights=None if association.label_weights is None else association.label_weights[~gone],
        existence=None if association.existence is None else association.existence[~gone],
        refuted=refuted if association.refuted is None else refuted | association.refuted,
        few_rays=None if association.few_rays is None else association.few_rays[~gone],
    )


def _moving(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    estimate: Estimate,
    map_T_camera: Floats,
    settings: Settings,
    known: Ints | None,
) -> Bools:
    """Return a mask (N,) of the objects of things that move. The parameters are as in `things_at_rest`."""
    owner = np.where(estimate.weight > 0, association.object, -1)
    track, length = tracks_of_rays(keyframes, rays, map_T_camera)
    told = np.flatnonzero((owner >= 0) & (length[track] >= FEWEST))
    if not len(told):
        return np.zeros(association.count, dtype=bool)
    _, same, together = np.unique(track[told] * association.count + owner[told], return_inverse=True, return_counts=True)
    share = together[same.ravel()] / length[track[told]]
    many = np.bincount(owner[told], minlength=association.count)
    pure = np.bincount(owner[told], share, association.count) / np.maximum(many, 1)
    held = np.flatnonzero(owner >= 0)
    origins, directions = rays.in_map(map_T_camera)
    noise = noise_of_rays(keyframes, rays, settings)
    places = estimate.positions[owner[held]]
    off = angles_off(origins[held], directions[held], places) / noise.at(lengths(places - origins[held]), held)
    number = np.bincount(owner[held], minlength=association.count).astype(np.float64)
    squares = np.bincount(owner[held], np.nan_to_num(off) ** 2, association.count).astype(np.float64)
    label = association.label
    in_tracks = np.flatnonzero(length[track] >= FEWEST)
    unexplained = np.bincount(rays.label[in_tracks], owner[in_tracks] < 0, len(rays.label_names))
    sums = np.zeros((4, len(rays.label_names)))
    np.add.at(sums.T, label, np.stack([many, many * pure, squares, number], axis=1))
    all_told, all_pure, all_squares, all_rays = sums
    # Tracks also join neighbours in a row of things at rest. Then nearly all rays are of objects.
    passed = (all_pure < _PASSED * all_told) & (all_told < _HELD * (all_told + unexplained))
    rest = (many > 0) & (pure >= _PURE) & ~passed[label]
    moves = np.isin(np.arange(len(passed)), [] if known is None else known)
    long = length[track] >= _LONG
    wander, fits = np.zeros_like(moves), np.ones(association.count, dtype=bool)
    if rest.sum() >= _USUAL:
        usual = float(np.median(squares[rest] / number[rest]))
        moves |= passed & (all_squares > _SCATTER**2 * usual * all_rays)
        wander = _wander(keyframes, rays, np.where(long, track, -1), owner, map_T_camera, settings, usual, noise)
        fits = squares <= _SCATTER**2 * usual * number
    # An object without long tracks, such as one whose rays are all rejected, would take up rays of the dropped objects.
    shown = np.flatnonzero(long & (owner >= 0))
    visit = grouped_visits(keyframes.stamps[rays.keyframe[shown]], owner[shown], BETWEEN_VISITS)
    visits = np.bincount(owner[shown][np.unique(visit, return_index=True)[1]], minlength=association.count)
    of_moving = (moves | wander)[label] & ((pure < _PURE) | (visits == 0))
    return np.asarray(of_moving | (wander[label] & ((visits < _VISITS) | ~fits)))


def _wander(
    keyframes: Keyframes,
    rays: Rays,
    track: Ints,
    owner: Ints,
    map_T_camera: Floats,
    settings: Settings,
    usual: float,
    noise: RayNoise,
) -> Bools:
    """Return a mask (L,) of the labels whose boxes follow things that move.

    A track follows a thing that moves under three conditions. Its rays meet in no point. They are not parallel, as rays to a
    far thing are. And they have no objects. Tracks also pass on to equal things nearby, but then their rays have objects. A
    label wanders if more than the share `_FOLLOWS` of its rays in long tracks is in such tracks.

    Args: keyframes, rays: of the map. track: (R,) -1 for a ray without a long track. owner: (R,) the object of each ray that
    agrees, else -1. map_T_camera: (K, 4, 4). settings: of the run. usual: the mean square of the residuals of a thing at
    rest, in variances of a ray. noise: of the rays.
    """
    from objslam.graph.fixed_pose_triangulation import triangulate_at

    labels, held = len(rays.label_names), np.flatnonzero(track >= 0)
    number, first, inverse = np.unique(track[held], return_index=True, return_inverse=True)
    count, label = len(number), rays.label[held[first]]
    mine = np.full(len(rays), -1)
    mine[held] = inverse.ravel()
    found = triangulate_at(map_T_camera, keyframes, rays, Association(mine, label), settings)
    origins, directions = rays.in_map(map_T_camera)
    track, origins, directions = mine[held], origins[held], directions[held]
    length = np.bincount(track, minlength=count)
    middle = np.stack([np.bincount(track, way, count) for way in directions.T], axis=1).astype(np.float64)
    point = angles_off(origins, directions, found.positions[track])
    parallel = angles_off(np.zeros_like(origins), directions, middle[track])
    sigma = noise.at(lengths(found.positions[track] - origins), held)
    squares = np.minimum(*(np.bincount(track, np.nan_to_num(off / sigma) ** 2, count) for off in (point, parallel)))
    explained = np.bincount(track, owner[held] >= 0, count) >= _EXPLAINED * length
    follow = (squares > _APART**2 * usual * length) & ~explained
    return np.asarray(np.bincount(label, follow * length, labels) > _FOLLOWS * np.bincount(label, length, labels))

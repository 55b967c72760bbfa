"""A start where nobody says which ray belongs to which object, and odometry alone says where the robot is.

As in `grow`, keyframes are added a few at a time at the poses that the solved ones predict. Their rays are given to the
landmarks known so far by predicted bearing, with the odometry's drift in the gate; what is left over in the last stretch of
the drive, where poses still agree with each other, is searched for new landmarks. Only the poses are kept in the end: with
them a global association can begin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from objslam.association.assign import assign
from objslam.association.search import associate
from objslam.config import Settings
from objslam.geometry import adjoint, inverse, lift_se2
from objslam.graph import factors
from objslam.graph.grow import anchor, landmark_priors, range_factors, ray_factors
from objslam.graph.optimise import build_graph, levenberg_marquardt, make_values, read_points, read_poses
from objslam.triangulation import triangulate
from objslam.types import Bools, Camera, Floats, Ints, Keyframes, Rays

_STRETCH = 150  # keyframes in which new landmarks are looked for
_TURN, _PLACE = np.radians(1.5), 0.1  # rad, m; how finely headings are tried, and what they leave open
_FEWEST = 5  # rays that must agree on a new landmark: a wrong one pulls on every pose after it
_ITERATIONS = 3
_FLOOR = 0.02  # m; landmarks are never taken to be known better than that


@dataclass
class _Known:
    """The landmarks so far: position (N, 3), covariance (N, 3, 3), label (N,), the keyframe that saw them last (N,)."""

    position: Floats
    covariance: Floats
    label: Ints
    last: Ints


def explore(
    keyframes: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    progress: Callable[[int, int], None],
) -> Floats:
    """Camera poses (K, 4, 4) in map, which is the odometry's frame: its first keyframe is held.

    progress(done, total) is called in keyframes.
    """
    motion, covariance = factors.motions(keyframes, settings)
    map_T_camera = keyframes.map_T_camera.copy()
    first_ray = np.searchsorted(rays.keyframe, np.arange(len(keyframes) + 1))
    owner = np.full(len(rays), -1, dtype=np.int64)
    nobody = np.zeros(0, dtype=np.int64)
    known = _Known(np.zeros((0, 3)), np.zeros((0, 3, 3)), nobody, nobody)
    graph = build_graph([anchor(map_T_camera[0])])
    for begin in range(1, len(keyframes), settings.joint.explore_step):
        end = min(begin + settings.joint.explore_step, len(keyframes))
        follow = inverse(keyframes.map_T_camera[begin - 1]) @ keyframes.map_T_camera[begin:end]
        map_T_camera[begin:end] = map_T_camera[begin - 1] @ follow

        new = np.arange(first_ray[begin] if begin > 1 else 0, first_ray[end])
        owner[new], map_T_camera = _recognise(rays, new, known, keyframes, map_T_camera, begin, end)
        fresh = new[owner[new] >= 0]
        born = _discover(rays, owner, known, keyframes, map_T_camera, end, cameras, settings)
        fresh = np.concatenate([fresh, np.flatnonzero(owner >= len(known.label) - len(born))]) if len(born) else fresh
        known.last[owner[fresh]] = np.maximum(known.last[owner[fresh]], rays.keyframe[fresh])

        for group in (
            factors.betweens(motion[begin - 1 : end - 1], covariance[begin - 1 : end - 1], begin - 1),
            ray_factors(rays, owner, fresh, "huber", settings),
            range_factors(rays, owner, fresh),
            landmark_priors(born, known.position, settings),
        ):
            for factor in group:
                graph.push_back(factor)
        if len(known.label):
            landmarks = np.arange(len(known.label))
            values = make_values(map_T_camera[:end], known.position, landmarks)
            values = levenberg_marquardt(graph, values, _ITERATIONS, 1e-4).values
            map_T_camera[:end] = read_poses(values)
            known.position = read_points(values)
            known.covariance = _covariances(rays, owner, known.position, map_T_camera)
        progress(end, len(keyframes))
    return map_T_camera


def _recognise(
    rays: Rays, new: Ints, known: _Known, keyframes: Keyframes, map_T_camera: Floats, begin: int, end: int
) -> tuple[Ints, Floats]:
    """The known landmark of each of the new rays (n,), or -1, and the poses (K, 4, 4) that explain most of them.

    Within a step the odometry predicts well. Before it, out of sight of anything, the heading may have drifted far: then
    headings on both sides are tried for the whole step at once, and the one that most rays agree with is taken.
    """
    if len(new) == 0 or len(known.label) == 0:
        return np.full(len(new), -1, dtype=np.int64), map_T_camera
    some = rays.take(new)
    drifted = _drifted(keyframes, begin - 1)
    heading = float(np.sqrt(np.linalg.eigvalsh(drifted[begin, :3, :3])[-1]))
    turns = np.arange(1, int(3 * heading / _TURN) + 1) * _TURN
    spread = drifted if len(turns) == 0 else _drifted(keyframes, begin) + np.diag([_TURN] * 3 + [_PLACE] * 3) ** 2
    best, best_poses = np.full(len(new), -1, dtype=np.int64), map_T_camera
    best_score = -np.inf
    for turn in (0.0, *np.stack([turns, -turns], axis=1).ravel()):
        poses = map_T_camera if turn == 0 else _turned(map_T_camera, begin, end, turn)
        owner = assign(
            some,
            known.position,
            known.covariance,
            _accepts(known.label, len(rays.label_names)),
            poses,
            some.sigma,
            pose_covariance=spread,
        )
        owner = np.where(_in_range(some, owner, known, poses), owner, -1)
        seen = np.bincount(owner[owner >= 0], minlength=1)
        # a constellation that shows twice tells no more than once: each landmark counts up to three times
        score = np.minimum(seen, 3).sum() - 0.1 * (owner < 0).sum() - 0.5 * (turn / max(heading, _TURN)) ** 2
        if score > best_score:
            best, best_score, best_poses = owner, score, poses
    return best, best_poses


def _in_range(rays: Rays, owner: Ints, known: _Known, map_T_camera: Floats) -> Bools:
    """Which rays (n,) do not contradict their landmark by the range that came with them."""
    origins, _ = rays.in_map(map_T_camera)
    distance = np.linalg.norm(known.position[owner] - origins, axis=1)
    return ~(np.abs(rays.range - distance) > 4 * rays.range_sigma + _PLACE)


def _turned(map_T_camera: Floats, begin: int, end: int, angle: float) -> Floats:
    """The poses with those of a step turned about its first, around the vertical."""
    pivot = map_T_camera[begin, :3, 3]
    turn = lift_se2(np.array([0.0, 0.0, angle]))
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    poses = map_T_camera.copy()
    poses[begin:end] = turn @ poses[begin:end]
    return poses


def _discover(
    rays: Rays,
    owner: Ints,
    known: _Known,
    keyframes: Keyframes,
    map_T_camera: Floats,
    end: int,
    cameras: tuple[Camera, ...],
    settings: Settings,
) -> Ints:
    """New landmarks among the rays of the last stretch that have no owner; they become owners. Their indices."""
    begin = max(0, end - _STRETCH)
    free = np.flatnonzero((owner < 0) & (rays.keyframe >= begin) & (rays.keyframe < end))
    none = np.zeros(0, dtype=np.int64)
    if len(free) < _FEWEST:
        return none
    some = rays.take(free)
    found = associate(
        some, keyframes.take(np.arange(end)), cameras, settings, map_T_camera=map_T_camera[:end], sigma=some.sigma
    )
    if found.count == 0:
        return none
    origins, directions = some.in_map(map_T_camera)
    placed = triangulate(
        origins,
        directions,
        found.object,
        found.count,
        some.sigma,
        settings.triangulation,
        seed=settings.seed,
        ranges=some.range if np.isfinite(some.range).any() else None,
        range_sigma=some.range_sigma,
    )
    ranged = np.bincount(found.object[found.object >= 0], np.isfinite(some.range[found.object >= 0]), found.count) > 0
    ready = placed.ok & (placed.counts >= _FEWEST)
    ready &= ranged | (placed.parallax >= np.radians(settings.joint.min_parallax_deg))
    born = len(known.label) + np.arange(int(ready.sum()))
    number = np.full(found.count + 1, -1, dtype=np.int64)
    number[:-1][ready] = born
    owner[free] = np.where(placed.weight > 0, number[found.object], -1)
    known.position = np.concatenate([known.position, placed.positions[ready]])
    known.covariance = np.concatenate([known.covariance, placed.covariance[ready]])
    known.label = np.concatenate([known.label, found.label[ready]])
    known.last = np.concatenate([known.last, np.zeros(len(born), dtype=np.int64)])
    return born


def _drifted(keyframes: Keyframes, since: int) -> Floats:
    """Covariance (K, 6, 6) of the cameras that the odometry has gathered from keyframe `since` on, in their own frames."""
    odom_T_base, drift = keyframes.odom_T_base, keyframes.drift
    assert odom_T_base is not None
    assert drift is not None
    to_camera = adjoint(inverse(odom_T_base @ keyframes.base_T_camera))
    gathered = np.where((np.arange(len(drift)) >= since)[:, None, None], drift - drift[since], 0.0)
    return to_camera @ gathered @ np.swapaxes(to_camera, 1, 2)


def _accepts(label: Ints, labels: int) -> Bools:
    return label[:, None] == np.arange(labels)


def _covariances(rays: Rays, owner: Ints, position: Floats, map_T_camera: Floats) -> Floats:
    """Covariances (N, 3, 3) of landmarks from the rays that they own, at these poses."""
    held = np.flatnonzero(owner >= 0)
    origins, n = rays.take(held).in_map(map_T_camera)
    across = np.linalg.norm(position[owner[held]] - origins, axis=1) * rays.sigma[held]
    information = np.zeros((len(position), 3, 3))
    np.add.at(information, owner[held], (np.eye(3) - n[:, :, None] * n[:, None, :]) / across[:, None, None] ** 2)
    along = np.isfinite(rays.range[held])
    spread = rays.range_sigma[held][along] ** 2
    np.add.at(information, owner[held][along], n[along, :, None] * n[along, None, :] / spread[:, None, None])
    return np.linalg.inv(information + 1e-6 * np.eye(3)) + _FLOOR**2 * np.eye(3)

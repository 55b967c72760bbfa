"""A start where nobody says which ray belongs to which object, and odometry alone says where the robot is.

As in `grow`, keyframes are added a few at a time at the poses that the solved ones predict. Their rays are given to the
landmarks known so far by predicted bearing, with the odometry's drift in the gate; what is left over in the last stretch of
the drive, where poses still agree with each other, is searched for new landmarks. With the poses and landmarks that come of
it a global association can begin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from objslam.association.assign import assign
from objslam.association.lay import lay
from objslam.association.search import associate
from objslam.config import Settings
from objslam.geometry import adjoint, inverse
from objslam.graph import factors
from objslam.graph.closure import Closure, Known, bend, find_closure
from objslam.graph.cost import FLOOR, truncated_cost
from objslam.graph.grow import anchor, landmark_priors, range_factors, ray_factors
from objslam.graph.optimise import build_graph, levenberg_marquardt, make_values, read_points, read_poses
from objslam.triangulation import triangulate
from objslam.types import Association, Bools, Camera, Floats, Ints, Keyframes, Rays

_HORIZON = 0.1  # rad of drift in heading: landmarks not seen for longer are no longer expected where they were
_STRETCH = 150  # keyframes in which new landmarks are looked for, at the most
_PLACE = 0.1  # m
_LEFT, _TURN, _SHIFT = 0.1, np.radians(0.5), 0.02  # share of the drift, rad, m that laying a step leaves open
_FEWEST = 5  # rays that must agree on a new landmark: a wrong one pulls on every pose after it
_ITERATIONS, _ITERATIONS_OF_A_LOOP = 3, 20
_STRAIN = 200.0
"""Squared deviations by which a loop may raise the cost for each landmark that it joins: on MRCLAM right ones took up to
110, wrong ones 240 and more."""


@dataclass(frozen=True)
class Explored:
    """Camera poses (K, 4, 4) in map, which is the odometry's frame: its first keyframe is held; which ray is of which
    landmark, and where those are, (N, 3)."""

    map_T_camera: Floats
    association: Association
    positions: Floats


def explore(
    keyframes: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    progress: Callable[[int, int], None],
) -> Explored:
    """Poses and landmarks, a few keyframes at a time; progress(done, total) is called in keyframes."""
    motion, covariance = factors.motions(keyframes, settings)
    heading = _heading_drift(keyframes)
    map_T_camera = keyframes.map_T_camera.copy()
    first_ray = np.searchsorted(rays.keyframe, np.arange(len(keyframes) + 1))
    owner = np.full(len(rays), -1, dtype=np.int64)
    known = Known.nothing()
    refused: set[tuple[tuple[int, ...], tuple[int, ...]] | None] = set()
    graph = build_graph([anchor(map_T_camera[0])])
    for begin in range(1, len(keyframes), settings.joint.explore_step):
        end = min(begin + settings.joint.explore_step, len(keyframes))
        follow = inverse(keyframes.map_T_camera[begin - 1]) @ keyframes.map_T_camera[begin:end]
        map_T_camera[begin:end] = map_T_camera[begin - 1] @ follow

        new = np.arange(first_ray[begin] if begin > 1 else 0, first_ray[end])
        owner[new], map_T_camera = _recognise(
            rays, new, known, _active(known, heading, begin), keyframes, map_T_camera, begin, end
        )
        fresh = new[owner[new] >= 0]
        stretch = max(0, end - _STRETCH, int(np.searchsorted(heading, heading[end - 1] - _HORIZON**2)))
        born = _discover(rays, owner, known, keyframes, map_T_camera, stretch, end, cameras, settings)
        fresh = np.concatenate([fresh, np.flatnonzero(owner >= len(known) - len(born))]) if len(born) else fresh
        known.last[owner[fresh]] = np.maximum(known.last[owner[fresh]], rays.keyframe[fresh])

        for group in (
            factors.betweens(motion[begin - 1 : end - 1], covariance[begin - 1 : end - 1], begin - 1),
            ray_factors(rays, owner, fresh, "huber", settings),
            range_factors(rays, owner, fresh),
            landmark_priors(born, known.position, settings),
        ):
            for factor in group:
                graph.push_back(factor)
        if len(known):
            values = _solve(graph, map_T_camera[:end], known, _ITERATIONS)
            map_T_camera[:end] = read_poses(values)
            known.position = read_points(values)
            known.covariance = _covariances(rays, owner, known.position, map_T_camera)
            found = find_closure(known, _active(known, heading, end - 1), rays, owner, graph, values, map_T_camera, end - 1)
            pairs = None if found is None else (tuple(found.now), tuple(found.before))
            if found is not None and pairs not in refused:
                closed = _close(found, known, rays, owner, map_T_camera[:end], heading, motion, covariance, settings)
                if closed is None:
                    refused.add(pairs)
                else:
                    graph, known, owner, map_T_camera[:end] = closed
                    refused.clear()  # the landmarks have other numbers now
        progress(end, len(keyframes))
    return Explored(map_T_camera, Association(owner, known.label), known.position)


def _solve(graph: gtsam.NonlinearFactorGraph, map_T_camera: Floats, known: Known, iterations: int) -> gtsam.Values:
    values = make_values(map_T_camera, known.position, np.arange(len(known)))
    return levenberg_marquardt(graph, values, iterations, 1e-4).values


def _close(
    found: Closure,
    known: Known,
    rays: Rays,
    owner: Ints,
    map_T_camera: Floats,
    heading: Floats,
    motion: Floats,
    covariance: Floats,
    settings: Settings,
) -> tuple[gtsam.NonlinearFactorGraph, Known, Ints, Floats] | None:
    """The graph, landmarks, owners and poses with the loop closed, or None where it strains them."""
    now, old = found.now, found.before
    back = int(known.first[now].min())
    left = int(np.minimum(known.last[old], back).max())
    end = len(map_T_camera)
    poses = bend(map_T_camera, found.correction, min(left, max(back - 1, 0)), back, heading[:end])
    into = np.arange(len(known))
    into[now] = old
    kept = np.flatnonzero(into == np.arange(len(known)))
    number = np.searchsorted(kept, into)
    first, last = known.first.copy(), known.last.copy()
    np.minimum.at(first, into, known.first)
    np.maximum.at(last, into, known.last)
    # landmarks go along with the pose that saw them last
    carried = poses[known.last] @ inverse(map_T_camera[known.last])
    position = np.einsum("nij,nj->ni", carried[:, :3, :3], known.position) + carried[:, :3, 3]
    merged = Known(position[kept], known.covariance[kept], known.label[kept], first[kept], last[kept])
    owned = np.where(owner >= 0, number[owner], -1)
    held = np.flatnonzero((owned >= 0) & (rays.keyframe < end))
    graph = build_graph(
        [anchor(map_T_camera[0])],
        factors.betweens(motion[: end - 1], covariance[: end - 1], 0),
        ray_factors(rays, owned, held, "huber", settings),
        range_factors(rays, owned, held),
        landmark_priors(np.arange(len(merged)), merged.position, settings),
    )
    values = _solve(graph, poses, merged, _ITERATIONS_OF_A_LOOP)
    before = truncated_cost(rays, owner, known.position, map_T_camera, motion, covariance)
    poses, merged.position = read_poses(values), read_points(values)
    if truncated_cost(rays, owned, merged.position, poses, motion, covariance) > before + _STRAIN * len(now):
        return None
    merged.covariance = _covariances(rays, owned, merged.position, poses)
    return graph, merged, owned, poses


def _heading_drift(keyframes: Keyframes) -> Floats:
    """(K,) rad^2, the variance of the heading that the odometry has gathered by each keyframe."""
    assert keyframes.drift is not None
    return np.maximum.accumulate(np.linalg.eigvalsh(keyframes.drift[:, :3, :3])[:, -1])


def _active(known: Known, heading: Floats, now: int) -> Bools:
    """Which landmarks (N,) were seen so lately that they are expected where they are."""
    return np.sqrt(np.maximum(heading[now] - heading[known.last], 0.0)) < _HORIZON


def _recognise(
    rays: Rays, new: Ints, known: Known, active: Bools, keyframes: Keyframes, map_T_camera: Floats, begin: int, end: int
) -> tuple[Ints, Floats]:
    """The active landmark of each of the new rays (n,), or -1, and the poses (K, 4, 4) with which they fit.

    Landmarks may stand closer together than the odometry's heading is known: ray by ray each would take its nearest. So the
    step is first laid onto the landmarks as a whole.
    """
    if len(new) == 0 or not active.any():
        return np.full(len(new), -1, dtype=np.int64), map_T_camera
    some, which = rays.take(new), np.flatnonzero(active)
    drift = _drifted(keyframes, begin - 1)
    centre, spread = map_T_camera[begin, :3, 3], _planar_sigmas(drift[end - 1], map_T_camera[end - 1])
    correction = lay(some, known.position[which], known.label[which], map_T_camera, centre, spread)
    poses = map_T_camera.copy()
    poses[begin:end] = correction @ poses[begin:end]
    left = _LEFT * drift + np.diag([_TURN] * 3 + [_SHIFT] * 3) ** 2
    owner = assign(
        some,
        np.where(active[:, None], known.position, np.nan),
        known.covariance,
        _accepts(known.label, len(rays.label_names)),
        poses,
        some.sigma,
        pose_covariance=left,
    )
    return np.where(_in_range(some, owner, known, poses), owner, -1), poses


def _planar_sigmas(covariance: Floats, map_T_camera: Floats) -> Floats:
    """Standard deviations (3,) of x, y (m) and yaw (rad) in map, of a covariance (6, 6) in the camera's own frame."""
    turn = map_T_camera[:3, :3]
    place, rotation = (np.diag(turn @ block @ turn.T) for block in (covariance[3:, 3:], covariance[:3, :3]))
    return np.sqrt(np.maximum([place[0], place[1], rotation[2]], 0.0))


def _in_range(rays: Rays, owner: Ints, known: Known, map_T_camera: Floats) -> Bools:
    """Which rays (n,) do not contradict their landmark by the range that came with them."""
    origins, _ = rays.in_map(map_T_camera)
    distance = np.linalg.norm(known.position[owner] - origins, axis=1)
    return ~(np.abs(rays.range - distance) > 4 * rays.range_sigma + _PLACE)


def _discover(
    rays: Rays,
    owner: Ints,
    known: Known,
    keyframes: Keyframes,
    map_T_camera: Floats,
    begin: int,
    end: int,
    cameras: tuple[Camera, ...],
    settings: Settings,
) -> Ints:
    """New landmarks among the rays of the last stretch, from begin to end, that have no owner; they become owners."""
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
    mine = owner[free] >= born[0] if len(born) else np.zeros(len(free), dtype=bool)
    seen_first = np.full(len(known.label), len(keyframes), dtype=np.int64)
    np.minimum.at(seen_first, owner[free][mine], rays.keyframe[free][mine])
    known.first = np.concatenate([known.first, seen_first[born]])
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
    return np.linalg.inv(information + 1e-6 * np.eye(3)) + FLOOR**2 * np.eye(3)

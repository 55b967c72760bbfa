"""Initialise poses and landmarks without an association, from odometry alone.

As in `init_known_correspondences`, keyframes are added a few at a time, at poses that continue the solved path by odometry.
Each ray is assigned to the known landmark whose predicted bearing it fits, within a gate that allows for the odometry's
drift. Unassigned rays of recent keyframes give new landmarks, because the drift between these keyframes is small. The result
is the start of a global association.
"""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from objslam.association.appearance.cosine_ratio import CosineRatio
from objslam.association.appearance.evidence import Looks, learn_ratio
from objslam.association.correlative_alignment import align
from objslam.association.global_association import associate_globally
from objslam.association.nearest_neighbour import assign
from objslam.association.observations import PosedRays
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.geometry import adjoint, inverse
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.fixed_pose_triangulation import triangulate_landmarks
from objslam.graph.loop_closure import Closure, Landmarks, closed_path, covariances_at, find_closure
from objslam.graph.optimizers import build_graph, levenberg_marquardt
from objslam.graph.robust_cost import truncated_cost
from objslam.graph.variables import add_values, make_values, read_points, read_poses

HORIZON = 0.1
"""A landmark is expected at its position if the heading drifted by less than this (rad, one standard deviation) since the
landmark was observed. A larger value recognises landmarks after a longer absence, and confuses neighbours more often."""
_STRETCH = 150
"""The number of latest keyframes that are searched for new landmarks. A larger number is slower and includes more drift."""
_PLACE = 0.1
"""A measured range may err by this (m) in addition to 4 standard deviations of its noise. A larger value accepts more wrong
ranges."""
_LEFT, _TURN, _SHIFT = 0.1, np.radians(0.5), 0.02
"""The uncertainty of the poses in a step after their alignment with the landmarks. It is the share `_LEFT` of the drift's
covariance, plus the standard deviations `_TURN` (rad) and `_SHIFT` (m). Larger values widen the gate of every ray."""
_MORE_RAYS = 2
"""The number of agreeing rays beyond association.min_rays that a new landmark needs. With more rays, landmarks are added
later. With fewer rays, more wrong landmarks are added, and each of them disturbs all later poses."""
_ITERATIONS, _ITERATIONS_OF_A_LOOP = 3, 20
"""The most iterations of the solve after a step, and of the solve after a loop closure. The solve after a loop closure
starts farther from its optimum, so it needs more. Larger numbers are slower."""
_STRAIN = 200.0
"""A loop closure may raise the cost (a sum of squared deviations) by this amount for each joined landmark. A larger amount
closes more wrong loops. On MRCLAM, correct loops raised it by up to 110 for each landmark, wrong ones by 240 or more."""
_LESSON = 50
"""The likelihood ratio of appearances is learnt first when twice this number of rays have a landmark. It is learnt again
each time the number of rays has doubled. A larger number learns later."""
_PAIRS = 150
"""The mean number of pairs of landmarks that the search for loops may compare for each keyframe. After a larger search, the
next one waits for more keyframes. Without a limit, wrong input takes very long, because it gives new landmarks without end.
A larger number finds loops sooner in logs with many landmarks of one label, and takes longer. The unnamed posts of MRCLAM
need 45 pairs, and up to 330 pairs with mirrored images."""


@dataclass(frozen=True)
class InitialEstimate:
    """A start for the global association: camera poses (K, 4, 4), the landmark of each ray, and landmark positions (N, 3).

    The map frame is the odometry's frame, in which the first keyframe is fixed.
    """

    map_T_camera: Floats
    association: Association
    positions: Floats


def initialize_unknown(
    keyframes: Keyframes, rays: Rays, cameras: tuple[Camera, ...], settings: Settings, progress: Callable[[int, int], None]
) -> InitialEstimate:
    """Return initial poses and landmarks. The function progress(done, total) gets numbers of keyframes."""
    measured = Measurements.of(keyframes, rays, settings)
    assert keyframes.drift is not None
    heading = np.maximum.accumulate(np.linalg.eigvalsh(keyframes.drift[:, :3, :3])[:, -1])  # variance, rad^2
    map_T_camera = keyframes.map_T_camera.copy()
    first_ray = np.searchsorted(rays.keyframe, np.arange(len(keyframes) + 1))
    owner = np.full(len(rays), -1, dtype=np.int64)
    known = Landmarks.none()
    refused: set[tuple[tuple[int, ...], tuple[int, ...]]] = set()
    none, pairs_left = np.zeros(0, dtype=np.int64), 0
    ratio: CosineRatio | None = None
    taught = _LESSON  # The number of rays with a landmark from which the ratio was learnt last.
    graph, values, solved = build_graph(measured.factors(owner, none, none, known.position, end=1)), gtsam.Values(), (0, 0)
    for begin in range(1, len(keyframes), settings.joint.explore_step):
        end = min(begin + settings.joint.explore_step, len(keyframes))
        follow = inverse(keyframes.map_T_camera[begin - 1]) @ keyframes.map_T_camera[begin:end]
        map_T_camera[begin:end] = map_T_camera[begin - 1] @ follow

        new = np.arange(first_ray[begin] if begin > 1 else 0, first_ray[end])
        looks = None if ratio is None else Looks.of(rays, owner, len(known), ratio)
        owner[new], map_T_camera = _recognise(
            rays, new, known, _active(known, heading, begin), keyframes, map_T_camera, begin, end, looks
        )
        fresh = new[owner[new] >= 0]
        stretch = max(0, end - _STRETCH, int(np.searchsorted(heading, heading[end - 1] - HORIZON**2)))
        born = _discover(rays, owner, known, keyframes, map_T_camera, stretch, end, cameras, settings)
        fresh = np.concatenate([fresh, np.flatnonzero(owner >= len(known) - len(born))]) if len(born) else fresh
        known.last[owner[fresh]] = np.maximum(known.last[owner[fresh]], rays.keyframe[fresh])

        graph.push_back(build_graph(measured.factors(owner, fresh, born, known.position, begin=begin, end=end)))
        if len(known):
            # Most variables stay as the last solve left them. To make them all again would take a fifth of the solve.
            fresh_poses, fresh_landmarks = np.arange(solved[0], end), np.arange(solved[1], len(known))
            add_values(values, map_T_camera, known.position, fresh_poses, fresh_landmarks)
            values, solved = levenberg_marquardt(graph, values, _ITERATIONS, 1e-4).values, (end, len(known))
            map_T_camera[:end] = read_poses(values)
            known.position = read_points(values)
            known.covariance = covariances_at(rays, owner, known.position, map_T_camera)
        if (held := int((owner >= 0).sum())) >= 2 * taught:
            ratio, taught = learn_ratio(rays, rays.keyframe, rays.track_id, owner, len(rays.label_names)), held
        pairs_left += _PAIRS * (end - begin)
        if len(known) and pairs_left > 0:
            active, now = _active(known, heading, end - 1), end - 1
            of = settings.association
            looks = None if ratio is None else Looks.of(rays, owner, len(known), ratio)
            found, compared = find_closure(known, active, rays, owner, graph, values, map_T_camera, now, of, looks)
            pairs_left -= compared
            if found is not None and (pairs := (tuple(found.now), tuple(found.before))) not in refused:
                closed = _close(found, known, measured, owner, map_T_camera[:end], heading)
                if closed is None:
                    refused.add(pairs)
                else:
                    graph, known, owner, map_T_camera[:end] = closed
                    refused.clear()  # The numbers of the landmarks have changed.
                    values, solved = gtsam.Values(), (0, 0)
        progress(end, len(keyframes))
    return InitialEstimate(map_T_camera, Association(owner, known.label), known.position)


def _close(
    found: Closure, known: Landmarks, measured: Measurements, owner: Ints, map_T_camera: Floats, heading: Floats
) -> tuple[gtsam.NonlinearFactorGraph, Landmarks, Ints, Floats] | None:
    """Return graph, landmarks, landmark of each ray, and poses after a loop closure. None if the cost rises too much."""
    now, old, rays = found.now, found.before, measured.rays
    end = len(map_T_camera)
    poses = closed_path(found, known, map_T_camera, heading[:end])
    into = np.arange(len(known))
    into[now] = old
    kept = np.flatnonzero(into == np.arange(len(known)))
    number = np.searchsorted(kept, into)
    first, last = known.first.copy(), known.last.copy()
    np.minimum.at(first, into, known.first)
    np.maximum.at(last, into, known.last)
    # A landmark moves with the pose that observed it last.
    carried = poses[known.last] @ inverse(map_T_camera[known.last])
    position = np.einsum("nij,nj->ni", carried[:, :3, :3], known.position) + carried[:, :3, 3]
    merged = Landmarks(position[kept], known.covariance[kept], known.label[kept], first[kept], last[kept])
    owned = np.where(owner >= 0, number[owner], -1)
    held = np.flatnonzero((owned >= 0) & (rays.keyframe < end))
    graph = build_graph(measured.factors(owned, held, np.arange(len(merged)), merged.position, end=end))
    start = make_values(poses, merged.position, np.arange(len(merged)))
    values = levenberg_marquardt(graph, start, _ITERATIONS_OF_A_LOOP, 1e-4).values
    before = truncated_cost(rays, owner, known.position, map_T_camera, *measured.odometry())
    poses, merged.position = read_poses(values), read_points(values)
    if truncated_cost(rays, owned, merged.position, poses, *measured.odometry()) > before + _STRAIN * len(now):
        return None
    merged.covariance = covariances_at(rays, owned, merged.position, poses)
    return graph, merged, owned, poses


def _active(known: Landmarks, heading: Floats, now: int) -> Bools:
    """Return for each landmark (N,) whether the heading drifted by less than `HORIZON` since its last observation."""
    return np.sqrt(np.maximum(heading[now] - heading[known.last], 0.0)) < HORIZON


def _recognise(
    rays: Rays,
    new: Ints,
    known: Landmarks,
    active: Bools,
    keyframes: Keyframes,
    map_T_camera: Floats,
    begin: int,
    end: int,
    looks: Looks | None,
) -> tuple[Ints, Floats]:
    """Return the active landmark of each new ray (n,), or -1, and all poses (K, 4, 4). The poses from `begin` to `end` - 1
    are now aligned with the landmarks."""
    if len(new) == 0 or not active.any():
        return np.full(len(new), -1, dtype=np.int64), map_T_camera
    some, which = rays.take(new), np.flatnonzero(active)
    drift = _drifted(keyframes, begin - 1)
    centre, spread = map_T_camera[begin, :3, 3], _planar_sigmas(drift[end - 1], map_T_camera[end - 1])
    # The whole step is aligned first, because the heading may err by more than the angle between two landmarks.
    alike = None
    if looks is not None:
        each = np.repeat(np.arange(len(some)), len(which)), np.tile(which, len(some))
        alike = looks.ray_odds(some, *each, np.zeros(len(each[0]), dtype=bool)).reshape(len(some), len(which))
    correction = align(some, known.position[which], known.label[which], map_T_camera, centre, spread, alike)
    poses = map_T_camera.copy()
    poses[begin:end] = correction @ poses[begin:end]
    left = _LEFT * drift + np.diag([_TURN] * 3 + [_SHIFT] * 3) ** 2
    owner = assign(
        some,
        np.where(active[:, None], known.position, np.nan),
        known.covariance,
        known.label[:, None] == np.arange(len(rays.label_names)),
        poses,
        some.sigma,
        pose_covariance=left,
        looks=looks,
    )
    origins, _ = some.in_map(poses)
    distance = np.linalg.norm(known.position[owner] - origins, axis=1)
    wrong = np.abs(some.range - distance) > 4 * some.range_sigma + _PLACE
    return np.where(wrong, -1, owner), poses


def _planar_sigmas(covariance: Floats, map_T_camera: Floats) -> Floats:
    """Return the standard deviations of x, y (m) and yaw (rad) in map, from a covariance (6, 6) in the camera frame."""
    turn = map_T_camera[:3, :3]
    place, rotation = (np.diag(turn @ block @ turn.T) for block in (covariance[3:, 3:], covariance[:3, :3]))
    return np.sqrt(np.maximum([place[0], place[1], rotation[2]], 0.0))


def _discover(
    rays: Rays,
    owner: Ints,
    known: Landmarks,
    keyframes: Keyframes,
    map_T_camera: Floats,
    begin: int,
    end: int,
    cameras: tuple[Camera, ...],
    settings: Settings,
) -> Ints:
    """Add landmarks from unassigned rays of keyframes `begin` to `end` - 1 to `known` and `owner`. Return their numbers."""
    free = np.flatnonzero((owner < 0) & (rays.keyframe >= begin) & (rays.keyframe < end))
    none, fewest = np.zeros(0, dtype=np.int64), settings.association.min_rays + _MORE_RAYS
    if len(free) < fewest:
        return none
    some = rays.take(free)
    frames, poses = keyframes.take(np.arange(end)), map_T_camera[:end]
    found = associate_globally(PosedRays(some, frames, cameras, poses, some.sigma), settings)
    if found.count == 0:
        return none
    placed, ready = triangulate_landmarks(map_T_camera, some, found, fewest, settings)
    born = len(known.label) + np.arange(int(ready.sum()))
    number = np.full(found.count + 1, -1, dtype=np.int64)
    number[:-1][ready] = born
    owner[free] = np.where(placed.weight > 0, number[found.object], -1)
    known.position = np.concatenate([known.position, placed.positions[ready]])
    known.covariance = np.concatenate([known.covariance, placed.covariance[ready]])
    known.label = np.concatenate([known.label, found.label[ready]])
    mine = free[owner[free] >= 0]
    seen_first = np.full(len(known.label), len(keyframes), dtype=np.int64)
    np.minimum.at(seen_first, owner[mine], rays.keyframe[mine])
    known.first = np.concatenate([known.first, seen_first[born]])
    known.last = np.concatenate([known.last, np.zeros(len(born), dtype=np.int64)])
    return born


def _drifted(keyframes: Keyframes, since: int) -> Floats:
    """Return the covariances (K, 6, 6) that the odometry accumulated after keyframe `since`, each in its camera's frame."""
    odom_T_base, drift = keyframes.odom_T_base, keyframes.drift
    assert odom_T_base is not None
    assert drift is not None
    to_camera = adjoint(inverse(odom_T_base @ keyframes.base_T_camera))
    gathered = np.where((np.arange(len(drift)) >= since)[:, None, None], drift - drift[since], 0.0)
    return to_camera @ gathered @ np.swapaxes(to_camera, 1, 2)

"""Initialise poses and landmarks without an association, from odometry alone.

As in `init_known_correspondences`, keyframes are added a few at a time, and a sliding window is solved. Odometry continues
the solved path to the new keyframes. A ray is assigned to a known landmark if it fits the landmark's predicted bearing. The
gate of this test allows for the odometry's drift. Unassigned rays of recent keyframes give new landmarks, because the drift
between these keyframes is small. Recent landmarks that are the same as old landmarks close a loop. Then the whole graph is
solved. The result is the start of a global association.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

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
from objslam.graph.loop_closure import Closure, Landmarks, closed_path, covariances_at, find_closure, heading_variance
from objslam.graph.robust_cost import truncated_cost
from objslam.graph.sliding_window import SlidingWindow

HORIZON = 0.1
"""The largest drift of the heading (rad, one standard deviation) at which a landmark is expected at its position. The drift
counts since the last observation of the landmark, or of a landmark beside it. A larger value recognises landmarks after a
longer absence, and confuses neighbours more often."""
_STRETCH = 150
"""The number of latest keyframes that are searched for new landmarks. A larger number is slower and includes more drift."""
_TURNED = np.radians(4.0)
"""The drift of the heading (rad, one standard deviation) at which a step ends. One correction aligns all poses of a step, so
the drift within the step blurs its rays. With a larger value, more steps with turns are aligned wrongly. Without a limit, a
simulated robot lost its way within an hour. With 3 and with 4 degrees, the robot kept its way."""
_PLACE = 0.1
"""The error (m) of a measured range that is accepted in addition to 4 standard deviations of its noise. A larger value
accepts more wrong ranges."""
_LEFT, _TURN, _SHIFT = 0.1, np.radians(0.5), 0.02
"""The uncertainty of the poses of a step after their alignment with the landmarks. Its covariance is the share `_LEFT` of
the drift's covariance, plus the squares of `_TURN` (rad) and `_SHIFT` (m). Larger values widen the gate of every ray."""
_MORE_RAYS = 2
"""The number of agreeing rays beyond association.min_rays that a new landmark needs. With more rays, landmarks are added
later. With fewer rays, more wrong landmarks are added, and each of them disturbs all later poses."""
_ITERATIONS, _ITERATIONS_OF_A_LOOP = 3, 20
"""The largest numbers of iterations of the solve after a step, and of the solve after a loop closure. The solve after a loop
closure starts farther from its optimum, so it needs more iterations. Larger numbers are slower."""
_STRAIN = 200.0
"""The amount by which a loop closure may raise the cost (a sum of squared deviations) for each joined landmark. A larger
amount closes more wrong loops. On MRCLAM, correct loops raised the cost by up to 110 for each landmark. Wrong loops raised
it by 240 or more."""
_LESSON = 50
"""The likelihood ratio of appearances is first learnt when the number of rays with a landmark is twice this number. The
ratio is learnt again each time the number of rays with a landmark has doubled. With a larger number, it is learnt later."""
_AGAIN = 1.05
"""The factor by which the number of rays of a landmark grows before its covariance is computed again. A larger factor is
faster, and gates stay wider. With a factor of 1, the time grows with the square of the number of rays."""
_PAIRS = 150
"""The mean number of pairs of landmarks that the search for loops may compare for each keyframe. After a larger search, the
next one waits for more keyframes. Without a limit, a log with wrong data takes very long, because it gives new landmarks
without end. A larger number finds loops sooner in logs with many landmarks of one label, and takes longer. The unnamed posts
of MRCLAM need 45 pairs, and up to 330 pairs with mirrored images."""


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
    return _Exploration(keyframes, rays, cameras, settings).run(progress)


class _Exploration:
    """The exploration at the present keyframe.

    way: (K, 4, 4) map_T_camera by odometry. owner: (R,) the landmark of each ray, or -1. heading: (K,) the variance of the
    odometry's heading, rad^2. counted: (N,) the number of rays of each landmark when its covariance was computed. refused:
    loops that raise the cost too much.
    """

    def __init__(self, keyframes: Keyframes, rays: Rays, cameras: tuple[Camera, ...], settings: Settings) -> None:
        assert keyframes.drift is not None
        self.keyframes, self.rays, self.cameras, self.settings = keyframes, rays, cameras, settings
        self.measured, self.way = Measurements.of(keyframes, rays, settings), keyframes.map_T_camera
        self.heading = heading_variance(keyframes.drift)
        self.first_ray = np.searchsorted(rays.keyframe, np.arange(len(keyframes) + 1))
        self.owner = np.full(len(rays), -1, dtype=np.int64)
        self.known, self.counted = Landmarks.none(), np.zeros(0, dtype=np.int64)
        self.window = SlidingWindow(self.measured, self.owner, 0)
        self.refused: set[tuple[tuple[int, ...], tuple[int, ...]]] = set()
        self.pairs_left = 0
        self.ratio: CosineRatio | None = None
        self.taught = _LESSON  # How many rays with a landmark there were when the ratio was last learnt.

    def run(self, progress: Callable[[int, int], None]) -> InitialEstimate:
        """Explore all keyframes, and return the initial estimate. progress(done, total): gets numbers of keyframes."""
        end = 1
        while end < len(self.keyframes):
            begin, end = end, self._end(end)
            self._add(begin, end)
            if (held := int((self.owner >= 0).sum())) >= 2 * self.taught:
                rays = self.rays
                self.ratio = learn_ratio(rays, rays.keyframe, rays.track_id, self.owner, len(rays.label_names))
                self.taught = held
            self.pairs_left += _PAIRS * (end - begin)
            if len(self.known) and self.pairs_left > 0:
                self._find_loop(end - 1)
            progress(end, len(self.keyframes))
        return InitialEstimate(self.window.map_T_camera, Association(self.owner, self.known.label), self.known.position)

    def _end(self, begin: int) -> int:
        """Return the end of the step that begins at a keyframe. A step with turns is shorter."""
        turned = int(np.searchsorted(self.heading, self.heading[begin - 1] + _TURNED**2))
        return min(begin + self.settings.joint.explore_step, max(turned, begin + 1), len(self.keyframes))

    def _add(self, begin: int, end: int) -> None:
        """Add the keyframes from `begin` to `end` - 1 and their rays, find new landmarks, and solve."""
        map_T_camera, way = self.window.map_T_camera, self.way
        map_T_camera[begin:end] = map_T_camera[begin - 1] @ inverse(way[begin - 1]) @ way[begin:end]
        new = np.arange(self.first_ray[begin] if begin > 1 else 0, self.first_ray[end])
        self._recognise(new, begin, end)
        fresh = new[self.owner[new] >= 0]
        stretch = max(0, end - _STRETCH, int(np.searchsorted(self.heading, self.heading[end - 1] - HORIZON**2)))
        before = len(self.known)
        self._discover(stretch, end)
        born = np.arange(before, len(self.known))
        self.counted = np.append(self.counted, np.zeros(len(born), dtype=np.int64))
        if len(born):
            fresh = np.concatenate([fresh, np.flatnonzero(self.owner >= before)])
        self.known.see(self.rays.keyframe, self.owner, fresh, self.first_ray)
        self.window.positions = self.known.position
        self.window.extend(end, fresh, born, self.known.covariance[born])
        if len(self.known):
            self._solve()

    def _solve(self, whole: bool = False) -> None:
        """Solve the window or the whole graph. If landmarks end at a camera, make the graph again without them."""
        self.window.solve(_ITERATIONS, whole)
        kept = np.isfinite(self.window.positions[:, 0])
        if kept.all():
            self._settle(self.window.solved == self.window.end)
        else:
            into = np.where(kept, np.cumsum(kept) - 1, -1)
            self._renumber(into, self.window.positions[kept], self.window.map_T_camera)
            self._solve()

    def _settle(self, whole: bool) -> None:
        """Compute the covariances of landmarks whose number of rays has grown by `_AGAIN`. After a solve of the whole graph,
        compute all covariances."""
        number = np.bincount(self.owner[self.owner >= 0], minlength=len(self.known))
        due = (number >= _AGAIN * self.counted) | whole
        which = np.flatnonzero(np.append(due, False)[self.owner])
        index = np.cumsum(due) - 1
        self.known.covariance[due] = covariances_at(
            self.rays.take(which), index[self.owner[which]], self.known.position[due], self.window.map_T_camera
        )
        self.counted = np.where(due, number, self.counted)

    def _looks(self) -> Looks | None:
        return None if self.ratio is None else Looks.of(self.rays, self.owner, len(self.known), self.ratio)

    def _active(self, now: int) -> Bools:
        """Return for each landmark (N,) whether the heading drifted by less than `HORIZON` since the landmark, or a landmark
        beside it, was last observed."""
        return np.sqrt(self.known.turned(self.heading, now)) < HORIZON

    def _recognise(self, new: Ints, begin: int, end: int) -> None:
        """Find the landmark of each new ray (n,), and align the poses from `begin` to `end` - 1 with the landmarks."""
        active, known = self._active(begin), self.known
        if len(new) == 0 or not active.any():
            return
        some, which, looks = self._some(new, begin), np.flatnonzero(active), self._looks()
        poses = self.window.map_T_camera[begin:end]
        drift = _drifted(self.keyframes, begin - 1, end)
        # The step is aligned first, because the error of the heading may be larger than the angle between two landmarks.
        alike = None
        if looks is not None:
            each = np.repeat(np.arange(len(some)), len(which)), np.tile(which, len(some))
            alike = looks.ray_odds(some, *each, np.zeros(len(each[0]), dtype=bool)).reshape(len(some), len(which))
        spread = _planar_sigmas(drift[-1], poses[-1])
        share = (self.heading[begin:end] - self.heading[begin - 1]) / max(
            self.heading[end - 1] - self.heading[begin - 1], 1e-12
        )
        landmarks = known.position[which], known.label[which]
        poses[:] = align(some, *landmarks, poses, poses[0, :3, 3], spread, share, alike) @ poses
        left = _LEFT * drift + np.diag([_TURN] * 3 + [_SHIFT] * 3) ** 2
        owner = assign(
            some,
            np.where(active[:, None], known.position, np.nan),
            known.covariance,
            known.label[:, None] == np.arange(len(self.rays.label_names)),
            poses,
            some.sigma,
            pose_covariance=left,
            looks=looks,
        )
        origins, _ = some.in_map(poses)
        distance = np.linalg.norm(known.position[owner] - origins, axis=1)
        wrong = np.abs(some.range - distance) > 4 * some.range_sigma + _PLACE
        self.owner[new] = np.where(wrong, -1, owner)

    def _discover(self, begin: int, end: int) -> None:
        """Make landmarks of unassigned rays of the keyframes from `begin` to `end` - 1."""
        part = np.arange(self.first_ray[begin], self.first_ray[end])
        free, fewest = part[self.owner[part] < 0], self.settings.association.min_rays + _MORE_RAYS
        if len(free) < fewest:
            return
        some, frames = self._some(free, begin), self.keyframes.take(np.arange(begin, end))
        poses = self.window.map_T_camera[begin:end]
        found = associate_globally(PosedRays(some, frames, self.cameras, poses, some.sigma), self.settings)
        if found.count == 0:
            return
        placed, ready = triangulate_landmarks(poses, some, found, fewest, self.settings)
        number = np.full(found.count + 1, -1, dtype=np.int64)
        number[:-1][ready] = len(self.known) + np.arange(int(ready.sum()))
        self.owner[free] = np.where(placed.weight > 0, number[found.object], -1)
        self.known = self.known.and_also(placed.positions[ready], placed.covariance[ready], found.label[ready])

    def _some(self, rays: Ints, begin: int) -> Rays:
        """Return rays (n,) whose keyframes count from `begin`."""
        some = self.rays.take(rays)
        return replace(some, keyframe=some.keyframe - begin)

    def _find_loop(self, now: int) -> None:
        """Close a loop that ends at keyframe `now`, if one is certain."""
        active, of = self._active(now), self.settings.association
        found, compared = find_closure(self.known, active, self.window, now, of, self._looks())
        self.pairs_left -= compared
        if found is None or (pairs := (tuple(found.now), tuple(found.before))) in self.refused:
            return
        if self._close(found):
            self.refused.clear()  # The numbers of the landmarks have changed.
        else:
            self.refused.add(pairs)

    def _close(self, found: Closure) -> bool:
        """Close a loop, unless the cost rises too much. Return whether it is closed."""
        known, owner, window, counted = self.known, self.owner, self.window, self.counted
        now, old, end, poses = found.now, found.before, window.end, window.map_T_camera.copy()
        before = self._cost()
        poses[:end] = closed_path(found, known, poses[:end], self.heading[:end])
        into = np.arange(len(known))
        into[now] = old
        kept = np.flatnonzero(into == np.arange(len(known)))
        # A landmark moves with the pose that observed it last.
        last = self.known.renumbered(np.searchsorted(kept, into), known.position[kept]).last
        carried = poses[last] @ inverse(window.map_T_camera[last])
        position = np.einsum("nij,nj->ni", carried[:, :3, :3], known.position[kept]) + carried[:, :3, 3]
        self._renumber(np.searchsorted(kept, into), position, poses)
        self.window.solve(_ITERATIONS_OF_A_LOOP)
        if self._cost() <= before + _STRAIN * len(now):
            self._settle(True)
            return True
        self.known, self.owner, self.window, self.counted = known, owner, window, counted
        return False

    def _cost(self) -> float:
        """Return the cost of the present map, NaN if a landmark has left the graph."""
        poses = self.window.map_T_camera[: self.window.end]
        return truncated_cost(self.rays, self.owner, self.known.position, poses, *self.measured.odometry())

    def _renumber(self, into: Ints, positions: Floats, map_T_camera: Floats) -> None:
        """Make the graph again after landmarks were joined or dropped. The rays of landmark j go to landmark into[j] (N,).
        If into[j] is -1, they go to no landmark.

        positions: (M, 3) m, the positions of the new landmarks. map_T_camera: (K, 4, 4).
        """
        self.known = self.known.renumbered(into, positions)
        self.owner = np.append(into, -1)[self.owner]
        self.window = self.window.regrown(self.owner, positions, map_T_camera)
        self.counted = np.zeros(len(positions), dtype=np.int64)


def _planar_sigmas(covariance: Floats, map_T_camera: Floats) -> Floats:
    """Return the standard deviations of x, y (m) and yaw (rad) in map, from a covariance (6, 6) in the camera frame."""
    turn = map_T_camera[:3, :3]
    place, rotation = (np.diag(turn @ block @ turn.T) for block in (covariance[3:, 3:], covariance[:3, :3]))
    return np.sqrt(np.maximum([place[0], place[1], rotation[2]], 0.0))


def _drifted(keyframes: Keyframes, since: int, end: int) -> Floats:
    """Return the covariances (n, 6, 6) that the odometry accumulated from keyframe `since` to each later keyframe before
    `end`. Each is in the camera frame of the later keyframe."""
    odom_T_base, drift = keyframes.odom_T_base, keyframes.drift
    assert odom_T_base is not None
    assert drift is not None
    to_camera = adjoint(inverse(odom_T_base[since + 1 : end] @ keyframes.base_T_camera[since + 1 : end]))
    return to_camera @ (drift[since + 1 : end] - drift[since]) @ np.swapaxes(to_camera, 1, 2)

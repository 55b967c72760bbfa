"""Find poses, landmarks, and the landmark of each ray by an extended Kalman filter, from odometry and rays.

The state is the pose, all landmarks, and errors that all motions share, such as a clock offset. The covariance of the state
predicts where in a frame each landmark may appear. The rays of a frame are assigned together, because an error of the pose
shifts all of them. A ray with a range that fits no landmark makes a new landmark. After a long way, drift makes an old
landmark look new. So recent landmarks are tied to old landmarks if one drift explains all pairs much better than chance. The
time for a frame depends on the number of landmarks, and hardly on the number of frames.
"""

from collections.abc import Callable

import numpy as np

from objslam.association import ekf
from objslam.association.joint_assignment import Pairings, assign_jointly
from objslam.association.place_recognition import MIN_LANDMARKS, label_densities
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements
from objslam.core.geometry import inverse
from objslam.core.statistics import SAME_POINT_WIDE
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.init_unknown_correspondences import HORIZON, InitialEstimate
from objslam.graph.loop_closure import seen_together
from objslam.graph.multiframes import Multiframes
from objslam.graph.planar_motion import motions_by_shared_errors, planar_noise

_STRETCH = 150
"""The number of frames without a ray after which a landmark with too few rays is dropped. It is dropped sooner if the
heading drifted by `HORIZON`. The search for ties pauses after this number of frames without a new landmark or a tie. A
larger number keeps false landmarks longer."""
_RECENT = 300
"""The number of frames after its first ray during which a landmark can be tied to an older landmark. A larger number is
slower."""
_SURE = 4.0
"""The least log odds of a sure match. The odds compare the best assignment with the match and the best assignment without
the match. A larger value matches fewer rays."""
_NEW = 0.2
"""The prior probability that a ray belongs to no known landmark. A larger value accepts fewer matches."""
_PAIRS = 40
"""The largest number of pairs that are assigned together. A larger number finds rarer assignments, and is slower."""
_BENT = 0.07
"""The standard deviation (m), along each axis, of the difference between two estimates of one landmark. It is added to the
deviation that the filter expects. A larger value ties more landmarks, and confuses neighbours more often."""
_TIED = 0.02
"""The standard deviation (m) of the measurement that two tied landmarks are one point. With a larger value, a closed loop
corrects the path less."""
_EXPLAINED = 0.8
"""The least share of rays with a landmark in a reliable exploration. With ranges, the share is 0.86 to 1 in simulated rooms
and on the log Lost in the Woods. It is 0.4 to 0.65 on the MRCLAM logs, whose landmarks stand 0.18 m apart. With a larger
limit, fewer explorations are used."""
_GAIN, _MOST, _LARGEST = 0.05, 100.0, 10.0
"""Factors on the variances of motions grow if corrections are larger than expected. A correction multiplies a factor by 1 +
`_GAIN` (r - 1), where r is the ratio of the squared correction to its expectation. `_MOST` is the largest factor, and
`_LARGEST` the largest r. With larger values, the factors adapt sooner to rough odometry, and also to outliers."""


def explore(
    keyframes: Keyframes,
    rays: Rays,
    settings: Settings,
    progress: Callable[[int, int], None],
    errors: CalibratedMeasurements | None = None,
    surface: float = 0.0,
) -> InitialEstimate:
    """Return poses, landmarks and an association. A ray without a sure match has no landmark.

    The exploration ends as soon as `is_sure` can no longer be true. The remaining rays then have no landmark.

    errors: the keyframes and rays as a function of the shared errors. The filter estimates the shared errors, starting from
    their mean. surface: the value of the shared error named surface, which the filter does not estimate. progress: called
    as progress(done, total) with numbers of keyframes.
    """
    if errors is not None:
        of_surface = np.array([name == "surface" for name in errors.names], dtype=bool)
        keyframes, rays, settings = errors.at(np.where(of_surface, surface, errors.mean))
    return _Exploration(keyframes, rays, settings, errors).run(progress)


def is_sure(start: InitialEstimate) -> bool:
    """Return whether an exploration explains enough rays for a solve to start from it.

    If the result is False, landmarks of one label are probably closer together than the error of the odometry.
    """
    return bool((start.association.object >= 0).mean() >= _EXPLAINED)


class _Exploration:
    """The filter at the present frame. label, first, last, hits: (N,) the label, the first and last frame, and the number of
    rays of each landmark. owner: (R,) the landmark of each ray. doubtful: (R,) whether a ray may belong to a known landmark,
    so that it makes no new landmark. path: (P, 4, 4) map_T_base at each frame."""

    def __init__(
        self,
        keyframes: Keyframes,
        rays: Rays,
        settings: Settings,
        errors: CalibratedMeasurements | None,
    ) -> None:
        assert keyframes.odom_T_base is not None
        assert keyframes.drift is not None
        self.keyframes, self.rays, self.settings = keyframes, rays, settings
        self.frames = Multiframes.of(keyframes)
        self.frame = self.frames.number[rays.keyframe]
        first, base = self.frames.first, keyframes.odom_T_base
        self.base_T_camera = inverse(base[first][self.frames.number]) @ base @ keyframes.base_T_camera
        self.sight = ekf.Sight.of(rays, self.base_T_camera)
        self.motion = inverse(base[first[:-1]]) @ base[first[1:]]
        self.noise = planar_noise(keyframes.drift[first], base[first], settings)
        self.by_shared, prior = motions_by_shared_errors(errors, first, self.motion)
        self.heading = np.maximum.accumulate(np.linalg.eigvalsh(keyframes.drift[first][:, :3, :3])[:, -1])  # rad^2
        self.filter = ekf.Filter.start(keyframes.map_T_base[0], prior)
        self.roughness = np.ones(ekf.POSE)  # The factors on the variances of the motion's yaw, x and y.
        self.path = np.tile(np.eye(4), (len(first), 1, 1))
        self.owner, self.doubtful = np.full(len(rays), -1, dtype=np.int64), np.zeros(len(rays), dtype=bool)
        self.label, self.first, self.last, self.hits = np.zeros((4, 0), dtype=np.int64)
        self.rarity = -np.log(_NEW) + _log_spread(self.sight)
        self.birth = -_STRETCH  # The last frame with a new landmark or a tie.

    def run(self, progress: Callable[[int, int], None]) -> InitialEstimate:
        """Explore all frames."""
        begin = np.searchsorted(self.frame, np.arange(len(self.path) + 1))
        for k in range(len(self.path)):
            if k:
                scale = np.sqrt(self.roughness)
                noise = self.noise[k - 1] * scale[:, None] * scale
                ekf.predict(self.filter, self.motion[k - 1], self.by_shared[k - 1], noise)
            self._see(np.arange(begin[k], begin[k + 1]), k)
            self.path[k] = self.filter.map_T_base
            if (k + 1) % self.settings.joint.explore_step == 0 or k + 1 == len(self.path):
                self._forget(k)
                self._close(k)
                progress(int(self.frames.first[k]) + 1, len(self.keyframes))
                # A ray that has no landmark after its frame never gets one.
                if (self.owner[: begin[k + 1]] < 0).sum() > (1 - _EXPLAINED) * len(self.rays):
                    break
        map_T_camera = self.path[self.frames.number] @ self.base_T_camera
        return InitialEstimate(map_T_camera, Association(self.owner, self.label), self.filter.position)

    def _see(self, rays: Ints, now: int) -> None:
        """Assign the rays of a frame, and correct the filter. A ray with a range and no match makes a landmark."""
        if len(self.filter) and len(rays):
            self._match(rays)
        free = rays[(self.owner[rays] < 0) & ~self.doubtful[rays] & np.isfinite(self.rays.range[rays])]
        if len(free):
            self.owner[free] = len(self.label) + np.arange(len(free))
            self._add(*ekf.ends(self.filter, self.sight, free), self.rays.label[free], np.full(len(free), now), now)
        mine = self.owner[rays[self.owner[rays] >= 0]]
        self.last[mine] = now
        self.hits[mine] += 1

    def _match(self, rays: Ints) -> None:
        f = self.filter
        reach = ekf.within_reach(f, self.sight, rays, SAME_POINT_WIDE)
        row, column = np.nonzero(reach & (self.rays.label[rays][:, None] == self.label))
        expected = ekf.Expected.of(f, self.sight, rays[row], column)
        alone = ekf.individual_covariances(f, expected)
        squared = np.einsum("pi,pi->p", expected.residual, np.linalg.solve(alone, expected.residual[..., None])[..., 0])
        near = _likeliest(squared)
        if len(near) == 0:
            return
        row, column, expected = row[near], column[near], expected.take(near)
        rarity = self.rarity[rays[row]]
        total = ekf.joint_covariance(f, expected)
        found = assign_jointly(Pairings(row, column, expected.residual, total, rarity, SAME_POINT_WIDE))
        sure = found.margin >= _SURE
        chosen = found.chosen[sure]
        # A ray is doubtful if two landmarks compete for it. It is also doubtful if, taken alone, it would surely match a
        # landmark without a ray.
        could = rarity - 0.5 * np.linalg.slogdet(2 * np.pi * alone[near])[1] >= _SURE
        could &= ~np.isin(column, column[chosen]) & ~np.isin(row, row[chosen])
        self.doubtful[rays[np.concatenate([row[found.chosen[~sure & found.rival]], row[could]])]] = True
        if len(chosen):
            self.owner[rays[row[chosen]]] = column[chosen]
            self._learn(*ekf.update(f, expected.take(chosen)))

    def _learn(self, step: Floats, expected: Floats) -> None:
        """Adapt `roughness` to a correction `step` (3,) of yaw, x and y, with its expected covariance (3, 3)."""
        turn = np.eye(ekf.POSE)
        turn[1:, 1:] = self.filter.map_T_base[:2, :2]
        ratio = (turn.T @ step) ** 2 / np.maximum(np.diagonal(turn.T @ expected @ turn), 1e-12)
        self.roughness = np.clip(self.roughness * (1 + _GAIN * (np.minimum(ratio, _LARGEST) - 1)), 1.0, _MOST)

    def _stretch(self, now: int) -> int:
        """Return the first frame of the recent stretch. Since this frame, the heading has drifted by less than `HORIZON`.
        The stretch has at most `_STRETCH` frames."""
        return max(0, now + 1 - _STRETCH, int(np.searchsorted(self.heading, self.heading[now] - HORIZON**2)))

    def _add(self, position: Floats, covariance: Floats, label: Ints, first: Ints, now: int) -> None:
        ekf.add(self.filter, position, covariance)
        self.label, self.first = np.concatenate([self.label, label]), np.concatenate([self.first, first])
        self.last = np.concatenate([self.last, np.full(len(label), now)])
        self.hits = np.concatenate([self.hits, np.zeros(len(label), dtype=np.int64)])
        self.birth = now

    def _forget(self, now: int) -> None:
        """Drop landmarks that have too few rays and were not seen recently."""
        kept = (self.hits >= self.settings.association.min_rays) | (self.last >= self._stretch(now))
        self._keep(kept, np.arange(len(kept)))

    def _keep(self, kept: Bools, into: Ints) -> None:
        """Keep the landmarks `kept` (N,). into: (N,) the landmark that gets the rays of each landmark."""
        if not kept.all():
            number = np.append(np.where(kept, np.cumsum(kept) - 1, -1)[into], -1)
            self.owner = number[self.owner]
            ekf.keep(self.filter, kept)
            self.label, self.first, self.last, self.hits = (a[kept] for a in (self.label, self.first, self.last, self.hits))

    def _close(self, now: int) -> None:
        """Close loops: tie recent landmarks to older ones if they are certainly the same."""
        if now - self.birth > _STRETCH:
            return
        f, recent = self.filter, self.first >= now - _RECENT
        possible = recent[:, None] & (self.first[:, None] > self.first) & (self.label[:, None] == self.label)
        row, column = np.nonzero(possible & ~seen_together(self.frame, self.owner, len(f)))
        apart, total = ekf.differences(f, row, column)
        total += _BENT**2 * np.eye(3)
        squared = np.einsum("pi,pi->p", apart, np.linalg.solve(total, apart[..., None])[..., 0])
        near = _likeliest(squared)
        if len(near) < MIN_LANDMARKS:
            return
        row, column = row[near], column[near]
        apart, joint = ekf.joint_differences(f, row, column, _BENT)
        height = 0.5 * np.log(12 * np.var(f.position[:, 2]) + 2 * np.pi * _BENT**2)
        rarity = height - np.log(label_densities(f.position, self.label)[row])
        found = assign_jointly(Pairings(row, column, apart, joint, rarity, SAME_POINT_WIDE))
        chosen = found.chosen[found.margin >= self.settings.association.loop_lead]
        if len(chosen) < MIN_LANDMARKS or found.odds < self.settings.association.loop_evidence:
            return
        one, two, before = row[chosen], column[chosen], f.map_T_base
        begin = int(self.first[one].min())
        ekf.tie(f, one, two, _TIED)
        self.path[begin : now + 1] = f.map_T_base @ inverse(before) @ self.path[begin : now + 1]
        into = np.arange(len(f))
        into[one] = two
        while (into[into] != into).any():  # If a tie leads to a tied landmark, take the end of the chain.
            into = into[into]
        np.add.at(self.hits, into[one], self.hits[one])
        np.maximum.at(self.last, into[one], self.last[one])
        self.birth = now
        self._keep(into == np.arange(len(f)), into)


def _likeliest(squared: Floats) -> Ints:
    """Return the sorted indices (p,) of the smallest squared deviations (P,) below the gate, at most `_PAIRS` indices."""
    near = np.flatnonzero(squared <= SAME_POINT_WIDE)
    return np.sort(near[np.argsort(squared[near], kind="stable")[:_PAIRS]])


def _log_spread(sight: ekf.Sight) -> Floats:
    """Return the log (R,) of the area (rad^2) over which rays to new landmarks spread. For a ray with a range, return the
    log of a volume (rad^2 m). The area and the volume are estimated from all rays."""
    n, noise = sight.direction, np.median(sight.sigma)
    angles = np.arctan2(n[:, 1], n[:, 0]), np.arcsin(np.clip(n[:, 2], -1.0, 1.0))
    extent = sum(0.5 * np.log(12 * np.var(angle) + 2 * np.pi * noise**2) for angle in angles)
    ranged = np.isfinite(sight.range)
    result = np.full(len(n), extent)
    if ranged.any():
        result[ranged] += 0.5 * np.log(
            12 * np.var(sight.range[ranged]) + 2 * np.pi * np.median(sight.range_sigma[ranged]) ** 2
        )
    return result

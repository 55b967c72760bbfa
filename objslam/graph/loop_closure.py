"""Close loops: find landmarks that are the same as older landmarks, and correct the path."""

from dataclasses import dataclass
from typing import Self

import gtsam
import numpy as np

from objslam.association.appearance.evidence import Looks
from objslam.association.place_recognition import (
    MIN_LANDMARKS,
    POSE_FLOOR,
    Constellation,
    label_densities,
    neighbourhood,
    recognise_place,
    repetition,
)
from objslam.config import AssociationSettings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint, exp_se3, inverse, log_se3
from objslam.core.types import Rays
from objslam.graph.robust_cost import FLOOR, ray_information
from objslam.graph.sliding_window import SlidingWindow
from objslam.graph.variables import X0

_EPOCHS = 8
"""The number of latest epochs (`_EPOCH`) in which a loop is searched. A larger number is slower and closes longer loops."""
_SLIPS = (1.0, 3.0, 10.0)
"""Factors on the standard deviations of the drift. A loop is searched once with each factor, because wheels can slip more
than a Gaussian allows. Larger factors find loops after a slip, and more wrong candidates."""
_BESIDE = 0.03
"""The standard deviation (rad) that a step from a landmark to another landmark adds to the heading, if some frame showed
both. Landmarks about 1 m apart have relative errors of 2 or 3 cm. With a smaller value, landmarks are recognised after
longer ways through the map, even if parts of the map are bent."""
_STEPS = 10
"""The largest number of landmarks on a way through the map from a known landmark to another. With more than ten landmarks,
the variance is larger than an exploration accepts."""
_MORE = 1.5
"""The factor by which the rays of the recent landmark of a pair grow before the pair is compared again. A larger factor is
faster, and finds loops later. With 1, two landmarks that never match are compared at each step."""
_EPOCH = 40
"""The number of consecutive keyframes in an epoch. Only one keyframe of an epoch gives the drift since the epoch, so a
larger number is faster and less exact. A landmark counts as new for this number of keyframes."""

_BENDS = ((0.5, 0.5, 0.1), (2.0, 2.0, 0.5))
"""Standard deviations, in x, y (m) and yaw (rad), of the bends of a solved path that missed a loop. They are chosen, not
measured. The first bend is that of a slip. The second is that of a path with confused landmarks (25 degrees and 2 m in a
simulated drive). Larger values propose more loops, and a solve judges each loop."""
_CUTS = 20
"""The largest number of keyframes that divide a path into parts before and after a missed loop. Most keyframes near a loop
show it, so few are enough. A larger number takes longer."""
SEARCHES = _CUTS * len(_BENDS)
"""The largest number of searches for a missed loop in a solved path. Each search may find a loop by chance."""


@dataclass
class Landmarks:
    """N landmarks: position (N, 3) m, covariance (N, 3, 3) m^2, label (N,), and first and last keyframe (N,) that saw each.

    rays: (N,) the number of rays of each landmark. together: (N, N) whether some frame shows both landmarks. compared:
    (N, N) the number of rays of the first landmark when it was last compared with the second one.
    """

    position: Floats
    covariance: Floats
    label: Ints
    first: Ints
    last: Ints
    rays: Ints
    together: Bools
    compared: Ints

    @classmethod
    def none(cls) -> Self:
        """Return an empty table."""
        nobody = np.zeros(0, dtype=np.int64)
        pairs = np.zeros((0, 0), dtype=bool), np.zeros((0, 0), dtype=np.int64)
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), nobody, nobody, nobody, nobody, *pairs)

    def __len__(self) -> int:
        return len(self.label)

    def around(self, which: Ints, pivot: Floats) -> Constellation:
        """Return landmarks `which` (n,) as a neighbourhood of a point (2,) m."""
        return neighbourhood(self.position[which], self.covariance[which], self.label[which], pivot)

    def and_also(self, position: Floats, covariance: Floats, label: Ints) -> Self:
        """Return the landmarks and n further ones that no frame has seen yet. position: (n, 3) m. label: (n,)."""
        return type(self)(
            np.concatenate([self.position, position]),
            np.concatenate([self.covariance, covariance]),
            np.concatenate([self.label, label]),
            np.append(self.first, np.full(len(label), np.iinfo(np.int64).max)),
            np.append(self.last, np.full(len(label), -1)),
            np.append(self.rays, np.zeros(len(label), dtype=np.int64)),
            np.pad(self.together, (0, len(label))),
            np.pad(self.compared, (0, len(label))),
        )

    def renumbered(self, into: Ints, position: Floats) -> Self:
        """Return M landmarks. Landmark i replaces all landmarks j with into[j] = i (N,). If into[j] is -1, landmark j is
        dropped.

        position: (M, 3) m. The covariances are NaN.
        """
        count, kept = len(position), np.flatnonzero(into >= 0)
        to = into[kept]
        label, last, rays = np.zeros((3, count), dtype=np.int64)
        label[to] = self.label[kept]
        np.add.at(rays, to, self.rays[kept])
        first = np.full(count, np.iinfo(np.int64).max)
        np.minimum.at(first, to, self.first[kept])
        np.maximum.at(last, to, self.last[kept])
        together = np.zeros((count, count), dtype=bool)
        np.logical_or.at(together, (to[:, None], to), self.together[np.ix_(kept, kept)])
        compared = np.zeros((count, count), dtype=np.int64)
        return type(self)(position, np.full((count, 3, 3), np.nan), label, first, last, rays, together, compared)

    def see(self, keyframe: Ints, owner: Ints, which: Ints, first_ray: Ints) -> None:
        """Note that the landmarks own new rays `which` (n,). Rays are sorted by keyframe.

        keyframe, owner: (R,) the keyframe of each ray, and its landmark, or -1. first_ray: (K+1,) the first ray of each
        keyframe.
        """
        if not len(which):
            return
        np.add.at(self.rays, owner[which], 1)
        np.minimum.at(self.first, owner[which], keyframe[which])
        np.maximum.at(self.last, owner[which], keyframe[which])
        seen = np.unique(keyframe[which]).tolist()
        beside = np.concatenate([np.arange(first_ray[k], first_ray[k + 1]) for k in seen])
        self.together |= seen_together(keyframe[beside] - seen[0], owner[beside], len(self))

    def turned(self, heading: Floats, now: int) -> Floats:
        """Return the variance (N,), rad^2, of the heading at keyframe `now` in the part of the map around each landmark.

        The drift counts since the last observation of the landmark. If some frame showed another landmark beside it, the
        other landmark fixes its place. So if the other landmark was observed later, the drift counts only since that time.

        heading: (K,) the variance of the odometry's heading.
        """
        variance = np.maximum(heading[now] - heading[self.last], 0.0)
        for _ in range(_STEPS if len(self) else 0):
            beside = np.where(self.together, variance, np.inf)
            np.fill_diagonal(beside, np.inf)
            fewer = np.minimum(variance, beside.min(axis=1) + _BESIDE**2)
            if (fewer == variance).all():
                break
            variance = fewer
        return variance


@dataclass(frozen=True)
class Closure:
    """A loop: recent landmarks that are the same as old landmarks.

    correction: (4, 4) moves the later poses in map to where they should be. now: (P,) the recent landmarks. before: (P,) the
    old landmark of each. evidence: the log odds of the loop. repeated: the log odds of a match of the recent landmarks with
    landmarks that a frame shows beside them. Such a match is false. It shows that such places repeat (`repetition`).
    """

    correction: Floats
    now: Ints
    before: Ints
    evidence: float
    repeated: float = 0.0


def find_closure(
    landmarks: Landmarks,
    active: Bools,
    window: SlidingWindow,
    now: int,
    settings: AssociationSettings,
    looks: Looks | None = None,
) -> tuple[Closure | None, int]:
    """Return the loop with the most evidence, None if no loop is certain, and the number of compared pairs.

    There are two searches. For a long drift, the recently seen landmarks (`active`, (N,)) are matched with all others. For a
    slip or a push, only the new landmarks (first seen in the last `_EPOCH` keyframes) are matched with all others.

    A pair is a recent and an old landmark of one label. A search is made only if it has a new pair, or if the recent
    landmark of a pair has many more rays than at the last search (`_MORE`). A pair counts once for each tried drift.

    Where things repeat, such as doors in a corridor, recent landmarks also match landmarks that a frame shows beside them.
    Such matches are certainly false. So a loop also needs a lead over the best false match (`repetition`).

    window: the solved graph. now: the newest keyframe. looks: what the landmarks look like, None if this is not known.
    """
    map_T_camera = window.map_T_camera
    density = label_densities(landmarks.position, landmarks.label)
    pivot = map_T_camera[now, :2, 3]
    due = landmarks.rays[:, None] >= _MORE * landmarks.compared
    born = active & (landmarks.first >= now - _EPOCH)
    best: Closure | None = None
    compared = 0
    marginals: gtsam.Marginals | None = None
    for here, there in ((active, ~active), (born, ~born)):
        possible = here[:, None] & there & (landmarks.label[:, None] == landmarks.label) & ~landmarks.together
        if not (possible & due).any():
            continue
        one, two = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
        if len(one) < MIN_LANDMARKS or len(two) < MIN_LANDMARKS:
            continue
        try:
            marginals = marginals or gtsam.Marginals(*window.whole())
        except RuntimeError:  # The system is indeterminate, so no loop can be tested.
            return None, compared
        landmarks.compared = np.where(possible, landmarks.rays[:, None], landmarks.compared)
        before = np.minimum(landmarks.last[two], landmarks.first[one].min())
        epochs = np.unique(before // _EPOCH)[::-1][:_EPOCHS]
        anchors = [int(before[before // _EPOCH == e].max()) for e in epochs]
        a, b = landmarks.around(one, pivot), landmarks.around(two, pivot)
        alike: Floats | float = 0.0
        if looks is not None:
            each = np.repeat(one, len(two)), np.tile(two, len(one))
            alike = looks.landmark_odds(*each, landmarks.label[each[0]]).reshape(len(one), len(two))
        for prior in relative_covariances(marginals, map_T_camera, anchors, now):
            compared += int(possible.sum())
            found = recognise_place(a, b, pivot, prior, density[one], possible[np.ix_(one, two)], alike)
            if found is None or not found.is_sure(settings) or (best is not None and found.evidence <= best.evidence):
                continue
            table = landmarks.position, landmarks.covariance, landmarks.label
            if found.against(repetition(*table, here, landmarks.together, pivot, prior, density)).is_sure(settings):
                best = Closure(found.correction, one[found.pairs[:, 0]], two[found.pairs[:, 1]], found.evidence)
    return best, compared


def find_missed_closures(landmarks: Landmarks, middle: Floats, map_T_camera: Floats, sure: float = np.inf) -> list[Closure]:
    """Return loops that a whole solved path may have missed, with the most evidence first.

    A search during initialisation allows only for drift by the noise of the odometry. An unlikely slip bends the path by
    more, and landmarks may be confused after it. So this search allows for large bends (`_BENDS`) at keyframes where a
    landmark is first seen. Landmarks seen mostly after such a keyframe are matched with landmarks seen mostly before it. The
    loops are proposals, and a solve must judge them.

    middle: (N,) the median keyframe of the rays of each landmark, NaN for landmarks that do not count. map_T_camera: (K, 4,
    4) the solved poses. sure: only closures with at least this evidence get `repeated`. For the others, `repeated` is 0.
    """
    counts = np.flatnonzero(np.isfinite(middle))
    if len(counts) < 2 * MIN_LANDMARKS:
        return []
    possible = (landmarks.label[:, None] == landmarks.label) & ~landmarks.together
    density = np.zeros(len(landmarks))
    density[counts] = label_densities(landmarks.position[counts], landmarks.label[counts])
    table = landmarks.position, landmarks.covariance, landmarks.label
    together = landmarks.together & np.isfinite(middle) & np.isfinite(middle)[:, None]
    found: dict[tuple[tuple[int, ...], tuple[int, ...]], Closure] = {}
    begins = np.unique(landmarks.first[counts])
    for cut in begins[np.unique(np.linspace(0, len(begins) - 1, _CUTS).round().astype(int))]:
        pairs = possible & (middle >= cut)[:, None] & (middle < cut)
        one, two = np.flatnonzero(pairs.any(axis=1)), np.flatnonzero(pairs.any(axis=0))
        if len(one) < MIN_LANDMARKS or len(two) < MIN_LANDMARKS:
            continue
        pivot = map_T_camera[cut, :2, 3]
        a, b = landmarks.around(one, pivot), landmarks.around(two, pivot)
        for prior in np.square(_BENDS)[:, None] * np.eye(3):
            loop = recognise_place(a, b, pivot, prior, density[one], pairs[np.ix_(one, two)])
            if loop is None or loop.evidence <= 0:
                continue
            now, before = one[loop.pairs[:, 0]], two[loop.pairs[:, 1]]
            same = tuple(now.tolist()), tuple(before.tolist())
            if same in found and found[same].evidence >= loop.evidence:
                continue
            here = np.isin(np.arange(len(landmarks)), now)
            again = repetition(*table, here, together, pivot, prior, density) if loop.evidence >= sure else None
            repeated = 0.0 if again is None else again.evidence
            found[same] = Closure(loop.correction, now, before, loop.evidence, repeated)
    return sorted(found.values(), key=lambda closure: -closure.evidence)


def closed_path(closure: Closure, landmarks: Landmarks, map_T_camera: Floats, drift: Floats) -> Floats:
    """Return the path (K, 4, 4) after a loop closure.

    The correction is spread over the keyframes from the last one that saw an old landmark to the first one that saw a recent
    landmark. drift: (K,) as for `distribute_correction`."""
    back = int(landmarks.first[closure.now].min())
    left = int(np.minimum(landmarks.last[closure.before], back).max())
    return distribute_correction(map_T_camera, closure.correction, min(left, max(back - 1, 0)), back, drift)


def heading_variance(drift: Floats) -> Floats:
    """Return the variance (K,), rad^2, of the heading at each keyframe, from the drift (K, 6, 6) of the odometry. The
    variance never falls. Its increase between two keyframes shows how far the heading drifted."""
    return np.maximum.accumulate(np.linalg.eigvalsh(drift[:, :3, :3])[:, -1])


def covariances_at(rays: Rays, owner: Ints, position: Floats, map_T_camera: Floats) -> Floats:
    """Return the covariances (N, 3, 3), m^2, of landmarks from their rays, at fixed poses (K, 4, 4).

    owner: (R,) the landmark of each ray, or -1. position: (N, 3) m."""
    held = np.flatnonzero(owner >= 0)
    origins, n = rays.take(held).in_map(map_T_camera)
    across = np.linalg.norm(position[owner[held]] - origins, axis=1) * rays.sigma[held]
    along = np.where(np.isfinite(rays.range[held]), rays.range_sigma[held] ** -2, 0.0)
    information = ray_information(n, across**-2, along, owner[held], len(position))
    return np.linalg.inv(information + 1e-6 * np.eye(3)) + FLOOR**2 * np.eye(3)


def seen_together(frame: Ints, owner: Ints, count: int) -> Bools:
    """Return for each pair of landmarks (N, N) whether some frame shows both.

    frame, owner: (R,) the frame of each ray and its landmark, or -1. count: the number of landmarks, N.
    """
    from scipy.sparse import csr_array

    held = np.flatnonzero(owner >= 0)
    frames = int(frame.max(initial=0)) + 1
    table = csr_array((np.ones(len(held)), (owner[held], frame[held])), shape=(count, frames))
    return np.asarray((table @ table.T).toarray() > 0)


def relative_covariances(marginals: gtsam.Marginals, map_T_camera: Floats, anchors: list[int], now: int) -> list[Floats]:
    """Return covariances (3, 3) of the x, y (m) and yaw (rad) of keyframe `now` relative to each anchor, in the axes of map.

    anchors: keyframes. Each anchor before `now` with a finite covariance gives one covariance for each factor in `_SLIPS`.
    The covariances include `POSE_FLOOR`. An anchor whose covariance cannot be computed gives none.
    """
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = map_T_camera[now, :3, :3]
    result = []
    for anchor in (a for a in anchors if a < now):
        try:
            joint = marginals.jointMarginalCovariance([X0 + anchor, X0 + now]).fullMatrix()
        except RuntimeError:
            # Each pair has its own order of elimination, and the system may be indeterminate in it.
            continue
        relative = inverse(map_T_camera[anchor]) @ map_T_camera[now]
        jacobian = np.hstack([-adjoint(inverse(relative)), np.eye(6)])
        planar = (turn @ jacobian @ joint @ jacobian.T @ turn.T)[np.ix_([3, 4, 2], [3, 4, 2])]
        if np.isfinite(planar).all():
            result += [slip**2 * (planar + np.diag(POSE_FLOOR) ** 2) for slip in _SLIPS]
    return result


def distribute_correction(map_T_camera: Floats, correction: Floats, begin: int, end: int, drift: Floats) -> Floats:
    """Return a path (K, 4, 4) with a correction (4, 4) spread over the keyframes from `begin` to `end`.

    drift: (K,) accumulated along the path. A keyframe gets a share of the correction in proportion to its drift since
    `begin`: nothing before `begin`, all of it after `end`.
    """
    gathered = drift - drift[begin]
    share = np.clip(gathered / max(float(gathered[end]), 1e-12), 0.0, 1.0)
    share[:begin] = 0.0
    # The twist is relative to the position of keyframe `begin`, so that the path does not swing out.
    centre = np.eye(4)
    centre[:3, 3] = map_T_camera[begin, :3, 3]
    twist = log_se3(inverse(centre) @ correction @ centre)
    return np.asarray(centre @ exp_se3(share[:, None] * twist) @ inverse(centre) @ map_T_camera)

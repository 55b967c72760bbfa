"""Solve the normal equations of a chain of poses that see landmarks, by cyclic reduction (Golub and Hockney 1965).

If every motion leads from one pose to the next, the poses form a chain. One step eliminates every second pose, and leaves a
chain of half the length. A step consists of products of small dense matrices. This elimination takes half the time of a
general sparse factorisation. The landmarks are eliminated last, as one dense block.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import sparse

from objslam.core.arrays import Bools, Floats, Ints

Blocks = tuple[Floats, Floats, Floats, Floats]
"""The blocks of J^T J, as `_gram` returns them."""
_MOST = 30
"""The largest number of landmarks of a chain. The time grows with the square of the number, because all landmarks are
coupled with all poses. With 15 landmarks, a factorisation takes half the time of a general one. With 40 landmarks, it takes
as long, unless all poses see all landmarks."""


def is_chain(landmarks: int, before: Ints, after: Ints) -> bool:
    """Return whether motions (s,) between poses are a chain that is solved faster than other graphs.

    In a chain, a motion leads from a pose to the next. Some motions, the ties, may lead farther, if they do not overlap
    along the path. No two motions have the same ends. landmarks: the number of landmarks.
    """
    far = after > before + 1
    first, last = np.sort(before[far]), np.sort(after[far])
    alone = len(np.unique(before[~far])) == np.count_nonzero(~far)
    return 0 < landmarks <= _MOST and alone and bool((after > before).all() and (last[:-1] <= first[1:]).all())


@dataclass(frozen=True)
class ChainRows:
    """The rows of the Jacobian of P poses in a chain and m landmarks, by the kind of the measurement.

    landmarks, poses: m and P. landmark, pose: (n,) the landmark and the pose of each ray. ranged: (q,) the rays with a
    range. before, after: (s,) the poses of each motion, as `is_chain` asks for. The other fields are derivatives. bearings:
    (n, 2, 9) and ranges: (q, 1, 9), by the landmark, then by the pose. weak: (3 m,) of the weak priors, by the landmarks.
    moves: (s, 6, 12) by the pose before, then by the pose after. absolute: (a, 6, 6) by the first a poses.
    """

    landmarks: int
    poses: int
    landmark: Ints
    pose: Ints
    ranged: Ints
    before: Ints
    after: Ints
    bearings: Floats
    ranges: Floats
    weak: Floats
    moves: Floats
    absolute: Floats

    def rescaled(self, bearings: float, ranges: Floats, moves: Floats) -> Self:
        """Return the rows for another noise. bearings: the factor on the rows of bearings. ranges: (q,) the factors on the
        rows of ranges. moves: (s, 6, 6) the matrices that multiply the rows of motions."""
        return replace(
            self,
            bearings=bearings * self.bearings,
            ranges=ranges[:, None, None] * self.ranges,
            moves=moves @ self.moves,
        )


@dataclass(frozen=True)
class _Step:
    """The elimination of k poses, which are every second pose of a chain.

    inner: (k, 6, 6) the inverse Cholesky factors of the eliminated poses. sides: (k, 6, 12) `inner` times the coupling with
    the pose before and the pose after. border: (k, 6, 3 m) `inner` times the coupling with the landmarks. after: the number
    of eliminated poses that have a pose after them, k or k - 1.
    """

    inner: Floats
    sides: Floats
    border: Floats
    after: int


@dataclass(frozen=True)
class _Between:
    """The elimination of one pose below each of k ties (`is_chain`). A pose below a tie is between the two ends of the tie.

    pose: (k,) the eliminated poses. before: (k,) the first pose of each tie. The pose after an eliminated pose is number
    `pose` + 1. inner, sides, border: as in `_Step`.
    """

    pose: Ints
    before: Ints
    inner: Floats
    sides: Floats
    border: Floats


@dataclass(frozen=True)
class BelowTies:
    """The elimination of all poses below ties. The poses that are left are a chain, because each tie joins two neighbours.

    rounds: the eliminations. A round eliminates one pose of each tie. left: (P,) which poses are left.
    """

    rounds: tuple[_Between, ...]
    left: Bools

    @classmethod
    def of(cls, gram: Blocks, before: Ints, after: Ints, coupling: Floats) -> tuple[Self, Blocks]:
        """Eliminate the poses below ties, and return the blocks that are left. gram: the blocks from `_gram`. before, after,
        coupling: the ties from `_ties`."""
        diagonal, beside, border, dense = gram
        left = np.ones(len(diagonal), dtype=bool)
        if not len(before):
            return cls((), left), gram
        rounds, links = list[_Between](), beside[before]
        for ahead in range(1, int((after - before).max())):
            some = np.flatnonzero(before + ahead < after)
            first, pose = before[some], before[some] + ahead
            inner = np.linalg.inv(np.linalg.cholesky(diagonal[pose]))
            sides = inner @ np.concatenate([links[some], np.swapaxes(beside[pose], 1, 2)], axis=2)
            landmarks, across = inner @ border[pose], np.swapaxes(sides, 1, 2)
            taken, shared = across @ sides, across @ landmarks
            for at, part in ((first, slice(0, 6)), (pose + 1, slice(6, 12))):
                diagonal[at] -= taken[:, part, part]
                border[at] -= shared[:, part]
            links[some] = -taken[:, 6:, :6]
            flat = landmarks.reshape(6 * len(pose), -1)
            dense -= flat.T @ flat
            left[pose] = False
            rounds.append(_Between(pose, first, inner, sides, landmarks))
        beside[before] = links + coupling
        return cls(tuple(rounds), left), (diagonal[left], beside[left[:-1]], border[left], dense)

    def forward(self, poses: Floats, landmarks: Floats) -> Floats:
        """Eliminate the poses from a right-hand side, and return its part for the poses that are left. The right-hand sides
        of all poses (P, 6, n) and of the landmarks (3 m, n) change in place."""
        if not self.rounds:
            return poses
        for one in self.rounds:
            own = one.inner @ poses[one.pose]
            taken = np.swapaxes(one.sides, 1, 2) @ own
            poses[one.pose] = own
            poses[one.before] -= taken[:, :6]
            poses[one.pose + 1] -= taken[:, 6:]
            landmarks -= one.border.reshape(-1, len(landmarks)).T @ own.reshape(-1, own.shape[2])
        return poses[self.left]

    def back(self, poses: Floats, found: Floats, landmarks: Floats) -> Floats:
        """Return the solution of all poses (P, 6, n). poses: the array that `forward` changed. found: the solution of the
        poses that are left. landmarks: (3 m, n) the solution of the landmarks."""
        if not self.rounds:
            return found
        poses[self.left] = found
        for one in reversed(self.rounds):
            beside = np.concatenate([poses[one.before], poses[one.pose + 1]], axis=1)
            own = poses[one.pose] - one.sides @ beside - one.border @ landmarks
            poses[one.pose] = np.swapaxes(one.inner, 1, 2) @ own
        return poses


@dataclass(frozen=True)
class ChainEquations:
    """The factorised normal equations J^T J of a chain. The columns are those of the landmarks, then those of the poses.

    below: the eliminations of the poses below ties. steps: the eliminations of every second pose. last: the inverse Cholesky
    factor (6, 6) of the pose that is left, and this factor times its coupling (6, 3 m) with the landmarks. dense: (3 m, 3 m)
    the inverse Cholesky factor of the landmarks.
    """

    below: BelowTies
    steps: tuple[_Step, ...]
    last: tuple[Floats, Floats]
    dense: Floats
    order: None = None

    @classmethod
    def of(cls, rows: ChainRows) -> Self:
        """Factor the normal equations. LinAlgError if they are not positive definite."""
        below, (diagonal, beside, border, dense) = BelowTies.of(_gram(rows), *_ties(rows))
        steps = list[_Step]()
        while len(diagonal) > 1:
            inner = np.linalg.inv(np.linalg.cholesky(diagonal[1::2]))
            count, after = len(inner), len(beside[1::2])
            sides = np.zeros((count, 6, 12))
            np.matmul(inner, beside[::2], out=sides[:, :, :6])
            np.matmul(inner[:after], np.swapaxes(beside[1::2], 1, 2), out=sides[:after, :, 6:])
            landmarks, across = inner @ border[1::2], np.swapaxes(sides, 1, 2)
            taken, shared = across @ sides, across @ landmarks
            diagonal, border, beside = diagonal[::2], border[::2], -taken[:after, 6:, :6]
            diagonal[:count] -= taken[:, :6, :6]
            border[:count] -= shared[:, :6]
            diagonal[1 : 1 + after] -= taken[:after, 6:, 6:]
            border[1 : 1 + after] -= shared[:after, 6:]
            flat = landmarks.reshape(6 * count, -1)
            dense -= flat.T @ flat
            steps.append(_Step(inner, sides, landmarks, after))
        inner = np.linalg.inv(np.linalg.cholesky(diagonal[0]))
        coupled = inner @ border[0]
        dense = np.linalg.inv(np.linalg.cholesky(dense - coupled.T @ coupled))
        return cls(below, tuple(steps), (inner, coupled), dense)

    def solve(self, right: Floats) -> Floats:
        """Return the solution (D,) or (D, n) for a right-hand side (D,) or (D, n)."""
        size, columns = len(self.dense), right.reshape(len(right), -1)
        landmarks, kept = columns[:size].copy(), list[Floats]()
        all_poses = columns[size:].reshape(-1, 6, columns.shape[1]).copy()
        poses = self.below.forward(all_poses, landmarks)
        for step in self.steps:
            own = step.inner @ poses[1::2]
            taken = np.swapaxes(step.sides, 1, 2) @ own
            poses = poses[::2].copy()
            poses[: len(own)] -= taken[:, :6]
            poses[1 : 1 + step.after] -= taken[: step.after, 6:]
            landmarks -= step.border.reshape(-1, size).T @ own.reshape(-1, own.shape[2])
            kept.append(own)
        inner, coupled = self.last
        own = inner @ poses[0]
        landmarks = self.dense.T @ (self.dense @ (landmarks - coupled.T @ own))
        poses = (inner.T @ (own - coupled @ landmarks))[None]
        for step, own in zip(reversed(self.steps), reversed(kept), strict=True):
            own -= step.sides[:, :, :6] @ poses[: len(own)] + step.border @ landmarks
            own[: step.after] -= step.sides[: step.after, :, 6:] @ poses[1 : 1 + step.after]
            both = np.empty((len(poses) + len(own), *own.shape[1:]))
            both[::2], both[1::2] = poses, np.swapaxes(step.inner, 1, 2) @ own
            poses = both
        poses = self.below.back(all_poses, poses, landmarks)
        return np.concatenate([landmarks, poses.reshape(-1, columns.shape[1])]).reshape(right.shape)


def _gram(rows: ChainRows) -> Blocks:
    """Return the blocks of J^T J: of each pose (P, 6, 6), of each pose with the one before it (P - 1, 6, 6), of each pose
    with the landmarks (P, 6, 3 m), and of the landmarks (3 m, 3 m)."""
    by_ray = np.swapaxes(rows.bearings, 1, 2) @ rows.bearings
    by_ray[rows.ranged] += np.swapaxes(rows.ranges, 1, 2) @ rows.ranges
    size, count = 3 * rows.landmarks, len(rows.pose)
    first = np.searchsorted(rows.pose, np.arange(rows.poses + 1))
    on_pose = sparse.csr_matrix((np.ones(count), np.arange(count), first), shape=(rows.poses, count))
    diagonal = np.asarray(on_pose @ by_ray[:, 3:, 3:].reshape(count, 36)).reshape(-1, 6, 6)
    landmark = 3 * rows.landmark[:, None] + np.arange(3)
    pose = 6 * rows.pose[:, None] + np.arange(6)
    border = _sums(pose, landmark, by_ray[:, 3:, :3], (6 * rows.poses, size)).reshape(-1, 6, size)
    dense = _sums(landmark, landmark, by_ray[:, :3, :3], (size, size)) + np.diag(rows.weak**2)
    by_move = np.swapaxes(rows.moves, 1, 2) @ rows.moves
    far = rows.after > rows.before + 1
    for some in (~far, far):
        diagonal[rows.before[some]] += by_move[some, :6, :6]
        diagonal[rows.after[some]] += by_move[some, 6:, 6:]
    beside = np.zeros((rows.poses - 1, 6, 6))
    beside[rows.before[~far]] = by_move[~far, 6:, :6]
    diagonal[: len(rows.absolute)] += np.swapaxes(rows.absolute, 1, 2) @ rows.absolute
    return diagonal, beside, border, dense


def _ties(rows: ChainRows) -> tuple[Ints, Ints, Floats]:
    """Return the poses before and after each tie (t,), along the path, and the coupling (t, 6, 6) of the two by the tie."""
    far = np.flatnonzero(rows.after > rows.before + 1)
    far = far[np.argsort(rows.before[far])]
    return rows.before[far], rows.after[far], np.swapaxes(rows.moves[far, :, 6:], 1, 2) @ rows.moves[far, :, :6]


def _sums(row: Ints, column: Ints, blocks: Floats, shape: tuple[int, int]) -> Floats:
    """Return a matrix to which blocks (n, i, j) are added at their rows (n, i) and columns (n, j)."""
    place = row[:, :, None] * shape[1] + column[:, None]
    return np.bincount(place.ravel(), blocks.ravel(), shape[0] * shape[1]).reshape(shape).astype(np.float64, copy=False)

"""The linear system of a least-squares problem in which each measurement ties one object to one map.

The matrix is an arrow: a block of 3 x 3 for each object, a block of w x w for each map, and blocks between an object and the
maps that measured it. The unknowns of the objects or those of the maps can be eliminated first (Schur complement). The
result is the same. This module eliminates the kind with more unknowns. With few maps, the time grows with the number of
objects. With few objects, the time grows with the number of maps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints

_RIDGE = 1e-12
"""The share of the trace of the linear system that is added to its diagonal. Unknowns that no measurement determines then
stay where they are. A larger share slows the solve down."""
_DETERMINED = 1e14
"""The largest condition number of a system whose inverse is a covariance. A larger number accepts systems that are nearer to
singular."""


@dataclass(frozen=True)
class ArrowSystem:
    """The normal equations of N objects and S maps with w unknowns each, from R measurements.

    objects: (N, 3, 3) and maps: (S, w, w), the blocks on the diagonal. object, map: (R,) the object and the map of each
    measurement. pull: (R, 3, w) the block between them, with the sign of the derivative of the map's prediction. The matrix
    itself has -pull. A map measures an object once at most.
    """

    objects: Floats
    maps: Floats
    pull: Floats
    object: Ints
    map: Ints

    def step(self, gradient: Floats) -> Floats:
        """Return the step (S, w) of the maps. gradient: (S, w) the right side of the maps. The right side of the objects is
        0."""
        count, width = gradient.shape
        if self._by_map():
            system, _ = self._of_maps()
            found = np.linalg.solve(_held(system), gradient.reshape(-1)).reshape(count, width)
            return np.asarray(found)
        system, back = self._of_objects()
        own = _times(back, gradient)
        shift = np.asarray(np.linalg.solve(_held(system), self._to_objects(own)), dtype=np.float64)
        return np.asarray(own + _times(back, self._to_maps(shift.reshape(-1, 3))))

    def covariances(self) -> tuple[Floats, Floats, Floats]:
        """Return the covariances of objects and maps, from the inverse of the matrix.

        The first array is the part (N, 3, 3) that each object has alone. The second one is the part that is correlated
        between objects, as a factor (N, 3, m). The third one has the blocks (S, w, w) of the maps. If the system is
        indeterminate, the second array is 0 and the third is NaN.
        """
        inverse = np.linalg.inv(self.objects)
        own = np.asarray((inverse + np.swapaxes(inverse, 1, 2)) / 2, dtype=np.float64)
        if self._by_map():
            return own, *self._covariances_of_maps(own)
        return own, *self._covariances_of_objects(own)

    def _by_map(self) -> bool:
        return self.maps.shape[0] * self.maps.shape[1] <= 3 * len(self.objects)

    def _of_maps(self) -> tuple[Floats, Floats]:
        """Return the matrix (S w, S w) of the maps alone, and the blocks (N, S, 3, w) between objects and maps."""
        (maps, width), count = self.maps.shape[:2], len(self.objects)
        half = np.zeros((count, maps, 3, width))
        half[self.object, self.map] = self.pull
        flat = np.swapaxes(half, 1, 2).reshape(3 * count, maps * width)
        carried = np.swapaxes(np.linalg.inv(self.objects)[:, None] @ half, 1, 2).reshape(3 * count, maps * width)
        system = -flat.T @ carried
        for s in range(maps):
            system[width * s : width * (s + 1), width * s : width * (s + 1)] += self.maps[s]
        return system, half

    def _of_objects(self) -> tuple[Floats, Floats]:
        """Return the matrix (3 N, 3 N) of the objects alone, and the inverses (S, w, w) of the blocks of the maps."""
        ridge = _RIDGE * np.trace(self.maps, axis1=1, axis2=2).sum()
        back = np.linalg.inv(self.maps + ridge * np.eye(self.maps.shape[1]))
        count = len(self.objects)
        system = np.zeros((3 * count, 3 * count))
        system.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count), :] = self.objects
        for s in range(len(self.maps)):
            at, pull = self._rows(s)
            system[np.ix_(at, at)] -= pull @ back[s] @ pull.T
        return system, back

    def _rows(self, s: int) -> tuple[Ints, Floats]:
        """Return the rows (3 n,) of the n objects that map `s` measured, and the parts of `pull` (3 n, w) in these rows.

        A row is an index into the 3 N coordinates of all objects.
        """
        mine = np.flatnonzero(self.map == s)
        at = (3 * self.object[mine, None] + np.arange(3)).reshape(-1)
        return at, self.pull[mine].reshape(len(at), self.maps.shape[1])

    def _to_objects(self, of_maps: Floats) -> Floats:
        """Return the products (3 N,) of the blocks between objects and maps with a vector (S, w) of the maps."""
        found = np.zeros((len(self.objects), 3))
        np.add.at(found, self.object, _times(self.pull, of_maps[self.map]))
        return found.reshape(-1)

    def _to_maps(self, of_objects: Floats) -> Floats:
        """Return the products (S, w) of the blocks between maps and objects with a vector (N, 3) of the objects."""
        found = np.zeros(self.maps.shape[:2])
        np.add.at(found, self.map, _times(np.swapaxes(self.pull, 1, 2), of_objects[self.object]))
        return found

    def _covariances_of_maps(self, own: Floats) -> tuple[Floats, Floats]:
        maps, width = self.maps.shape[:2]
        system, half = self._of_maps()
        spread = _inverse(system)
        size, axes = np.linalg.eigh(np.nan_to_num((spread + spread.T) / 2))
        gain = np.swapaxes(own[:, None] @ half, 1, 2).reshape(len(own), 3, maps * width)  # The derivatives of the objects.
        blocks = spread.reshape(maps, width, maps, width)[np.arange(maps), :, np.arange(maps), :]
        return np.asarray(gain @ (axes * np.sqrt(np.maximum(size, 0.0)))), np.asarray(blocks)

    def _covariances_of_objects(self, own: Floats) -> tuple[Floats, Floats]:
        count, (maps, width) = len(own), self.maps.shape[:2]
        system, back = self._of_objects()
        joint = _inverse(system)
        if not np.isfinite(joint).all():
            return np.zeros((count, 3, 0)), np.full((maps, width, width), np.nan)
        blocks = back.copy()
        for s in range(maps):
            at, pull = self._rows(s)
            reach = pull @ back[s]
            blocks[s] += reach.T @ joint[np.ix_(at, at)] @ reach
        between = joint.reshape(count, 3, count, 3).copy()
        between[np.arange(count), :, np.arange(count), :] -= own
        size, axes = np.linalg.eigh(between.reshape(3 * count, 3 * count))
        good = size > 0
        return (axes[:, good] * np.sqrt(size[good])).reshape(count, 3, good.sum()), blocks


def _times(blocks: Floats, vectors: Floats) -> Floats:
    return np.asarray((blocks @ vectors[..., None])[..., 0])


def _held(system: Floats) -> Floats:
    return system + _RIDGE * np.trace(system) * np.eye(len(system))


def _inverse(system: Floats) -> Floats:
    """Return the inverse of a matrix, NaN if it is indeterminate."""
    if not system.size or np.linalg.cond(system) < _DETERMINED:
        return np.asarray(np.linalg.inv(system))
    return np.full_like(system, np.nan)

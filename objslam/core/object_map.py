"""The map of objects: what is asked of it, and how two of them become one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from objslam.core.arrays import Bools, Floats
from objslam.core.statistics import SAME_POINT

Status = Literal["ok", "unresolved"]

_FLOOR = 1e-6
"""m; no two positions are taken to be known better than this relative to each other."""


@dataclass(frozen=True)
class MapObject:
    """One object of the map, as objects.json holds it.

    position: (3,) m. covariance: (3, 3) m^2, None where unresolved. extent: width and height in m. A ray (origin,
    direction) stands for an unresolved object: its best guess lies on it. labels: the share of each label among its boxes,
    None where one label is taken for one object. existence: the probability that there is such an object, likewise.
    """

    id: int
    label: str
    position: Floats
    covariance: Floats | None
    status: Status
    rays: int
    frames: int
    parallax_deg: float
    rms_deg: float
    first_seen: float
    last_seen: float
    extent: tuple[float, float] | None = None
    ray: tuple[Floats, Floats] | None = None
    labels: dict[str, float] | None = None
    existence: float | None = None

    @property
    def sigma(self) -> float | None:
        """Standard deviation of the position along its least certain direction, m; None without a covariance."""
        return None if self.covariance is None else float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


@dataclass(frozen=True)
class ObjectMap:
    """The objects of one map, in `frame`.

    Questions about places are answered from the resolved objects, for the others have none; a point is x, y, z in m, or x, y
    alone where heights do not matter.
    """

    objects: tuple[MapObject, ...]
    frame: str = "map"

    def __len__(self) -> int:
        return len(self.objects)

    def resolved(self) -> tuple[MapObject, ...]:
        """The objects that have a position to rely on."""
        return tuple(o for o in self.objects if o.status == "ok")

    def nearest(self, point: ArrayLike, label: str | None = None) -> MapObject | None:
        """The object of a label (of any, if None) that is nearest to a point; None if there is none."""
        found = self._by_distance(point, label)
        return found[0][1] if found else None

    def in_radius(self, point: ArrayLike, radius: float, label: str | None = None) -> tuple[MapObject, ...]:
        """The objects at most `radius` m from a point, the nearest first."""
        return tuple(o for distance, o in self._by_distance(point, label) if distance <= radius)

    def in_box(self, low: ArrayLike, high: ArrayLike, label: str | None = None) -> tuple[MapObject, ...]:
        """The objects between two corners of a box along the map's axes, its faces included."""
        lower, upper = _point(low), _point(high)
        if lower.shape != upper.shape:
            raise ValueError("both corners must have two coordinates, or both three")
        objects, positions = self._placed(label)
        inside = ((positions[:, : len(lower)] >= lower) & (positions[:, : len(lower)] <= upper)).all(axis=1)
        return tuple(objects[i] for i in np.flatnonzero(inside))

    def merge(self, other: ObjectMap) -> Self:
        """Both maps as one: what is the same object in both is fused, all else is kept.

        Both must be in one frame (ValueError if their names of it differ). Objects of one label are the same where their
        positions agree within their covariances: Mahalanobis distance below the 99 % quantile, one-to-one, with the least
        sum of squares (Hungarian method). Fused positions are weighted by their information, as two independent measurements
        are. Objects keep the numbers of this map; those that only the other one has are numbered on.
        """
        if self.frame != other.frame:
            raise ValueError(f"the maps are in two frames, {self.frame!r} and {other.frame!r}: bring them into one first")
        pairs = dict(_same_objects(self.objects, other.objects))
        objects = [_fuse(o, other.objects[pairs[i]]) if i in pairs else o for i, o in enumerate(self.objects)]
        taken, number = set(pairs.values()), max((o.id for o in self.objects), default=-1) + 1
        rest = [o for k, o in enumerate(other.objects) if k not in taken]
        return replace(self, objects=(*objects, *(replace(o, id=number + k) for k, o in enumerate(rest))))

    def _placed(self, label: str | None) -> tuple[list[MapObject], Floats]:
        objects = [o for o in self.resolved() if label in (None, o.label)]
        return objects, np.array([o.position for o in objects], dtype=np.float64).reshape(-1, 3)

    def _by_distance(self, point: ArrayLike, label: str | None) -> list[tuple[float, MapObject]]:
        at = _point(point)
        objects, positions = self._placed(label)
        distance = np.linalg.norm(positions[:, : len(at)] - at, axis=1)
        return [(float(distance[i]), objects[i]) for i in np.argsort(distance, kind="stable")]


def _point(values: ArrayLike) -> Floats:
    point = np.asarray(values, dtype=np.float64)
    if point.shape not in ((2,), (3,)) or np.isnan(point).any():
        raise ValueError(f"a point is x, y or x, y, z in metres, got {values!r}")
    return point


def _same_objects(ours: tuple[MapObject, ...], theirs: tuple[MapObject, ...]) -> list[tuple[int, int]]:
    """Pairs of indices of objects that are one."""
    from scipy.optimize import linear_sum_assignment

    mine, its = _placed_indices(ours), _placed_indices(theirs)
    squared = np.full((len(mine), len(its)), np.inf)
    for label in {ours[i].label for i in mine}:
        rows = [row for row, i in enumerate(mine) if ours[i].label == label]
        columns = [column for column, k in enumerate(its) if theirs[k].label == label]
        if rows and columns:
            a, b = [ours[mine[row]] for row in rows], [theirs[its[column]] for column in columns]
            squared[np.ix_(rows, columns)] = _mahalanobis(a, b)
    allowed: Bools = squared <= SAME_POINT
    cost = np.where(
        allowed, squared, SAME_POINT * (min(squared.shape) + 1)
    )  # one that is not allowed costs more than all that are
    pairs = np.column_stack(linear_sum_assignment(cost)).tolist() if allowed.any() else []
    return [(mine[row], its[column]) for row, column in pairs if allowed[row, column]]


def _placed_indices(objects: tuple[MapObject, ...]) -> list[int]:
    return [i for i, o in enumerate(objects) if o.status == "ok" and o.covariance is not None]


def _mahalanobis(ours: list[MapObject], theirs: list[MapObject]) -> Floats:
    """Squared Mahalanobis distances (N, M) between the positions of objects."""
    apart = np.array([o.position for o in ours])[:, None] - np.array([o.position for o in theirs])
    spread = (
        np.array([o.covariance for o in ours])[:, None] + np.array([o.covariance for o in theirs]) + _FLOOR**2 * np.eye(3)
    )
    squared: Floats = np.einsum("nmi,nmi->nm", apart, np.linalg.solve(spread, apart[..., None])[..., 0])
    return squared


def _fuse(a: MapObject, b: MapObject) -> MapObject:
    """Two measurements of one object; its number and label are those of the first."""
    assert a.covariance is not None  # only objects with one are paired
    assert b.covariance is not None
    # C_a (C_a + C_b)^-1 weighs the other: the same as adding information, and it holds where a covariance is singular
    gain = a.covariance @ np.linalg.inv(a.covariance + b.covariance + _FLOOR**2 * np.eye(3))
    covariance = (np.eye(3) - gain) @ a.covariance
    share = a.rays / max(a.rays + b.rays, 1)
    extents = [(e, w) for e, w in ((a.extent, share), (b.extent, 1 - share)) if e is not None]
    extent = np.average([e for e, _ in extents], axis=0, weights=[w + 1e-9 for _, w in extents]) if extents else None
    shares = None
    if a.labels is not None and b.labels is not None:
        both = {
            name: share * a.labels.get(name, 0.0) + (1 - share) * b.labels.get(name, 0.0) for name in a.labels | b.labels
        }
        shares = dict(sorted(both.items(), key=lambda item: -item[1]))
    return replace(
        a,
        position=a.position + gain @ (b.position - a.position),
        covariance=(covariance + covariance.T) / 2,
        rays=a.rays + b.rays,
        frames=a.frames + b.frames,
        parallax_deg=float(np.fmax(a.parallax_deg, b.parallax_deg)),
        rms_deg=float(np.sqrt(share * a.rms_deg**2 + (1 - share) * b.rms_deg**2)),
        first_seen=float(np.fmin(a.first_seen, b.first_seen)),
        last_seen=float(np.fmax(a.last_seen, b.last_seen)),
        extent=None if extent is None else (float(extent[0]), float(extent[1])),
        labels=shares,
        existence=None if a.existence is None or b.existence is None else float(np.fmax(a.existence, b.existence)),
    )

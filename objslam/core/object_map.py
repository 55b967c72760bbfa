"""The map of objects, with spatial queries and the merge of two maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike

from objslam.core.appearance.features import ranked
from objslam.core.arrays import Bools, Floats, Floats32
from objslam.core.bodies.body import Body, surer_body
from objslam.core.bodies.body_entry import BODY_COLUMNS, body_row
from objslam.core.bodies.tag_pose import TAG_COLUMNS, TagPose, tag_row
from objslam.core.maps.spatial_index import SpatialIndex, corners_of, place_of
from objslam.core.statistics import SAME_POINT

Status = Literal["ok", "unresolved"]
Fate = Literal["confirmed", "moved", "gone", "new", "unconfirmed"]
FATES: tuple[Fate, ...] = ("confirmed", "moved", "gone", "new", "unconfirmed")
"""The possible fates of an object over several sessions. Outputs show the words in this order. A comparison of two maps uses
the same words."""

_FLOOR = 1e-6  # The least standard deviation (m) between two positions. It keeps singular covariances invertible.
_SHOWN = 20  # The most objects in the text of a map. A larger number makes the text longer.
_UPPER_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # Entries of the covariance in a table row.

COLUMNS: dict[str, str] = {
    **{"id": "int64", "label": "string", "status": "string"},
    **dict.fromkeys(("x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"), "float64"),
    **{"rays": "int64", "frames": "int64"},
    **dict.fromkeys(("parallax_deg", "rms_deg", "width", "height", "first_seen", "last_seen", "existence"), "float64"),
    **BODY_COLUMNS,
    **TAG_COLUMNS,
    **{"state": "string", "probability": "float64", "sessions_expected": "int64", "sessions_seen": "int64"},
    **dict.fromkeys(("updated", "moved_from_x", "moved_from_y", "moved_from_z"), "float64"),
}
"""The columns of a table of objects, with their types. Positions and sizes are in m, covariances in m^2, stamps in s, yaws
in rad. size_l, size_w and size_h are length, width and height of the body. width and height are the `extent` of the object.
tag_qx to tag_qw are the unit quaternion of map_R_tag of a fiducial. The columns from state on are from `Life`. They are
empty except in the map of a site."""


@dataclass(frozen=True)
class SeenFrom:
    """From where an object was detected.

    near, far: the least and the greatest distance, m. sides: (S, 3) unit directions from the object to the cameras, in the
    frame of the map, about 20 degrees apart.
    """

    near: float
    far: float
    sides: Floats


@dataclass(frozen=True)
class Life:
    """The history of one object over several sessions.

    state: `unconfirmed` if one session found the object, and no other session had its place in view. `new` if one session
    found it, and an earlier session should have found it there, or has no record of its view. `confirmed` if a later session
    found it again. `moved` if a later session found it at another position. `gone` if later sessions show that it has left.
    probability: the probability that the object is still at its position. sessions_expected, sessions_seen: the number of
    sessions with the object in view, and of sessions that found it. looks, detections: the number of camera frames of all
    sessions with the object in view, and of frames with a detection of it. updated: the time of the last session, s.
    moved_from: (3,) m, the position before it moved, None if it did not move.
    """

    state: Fate
    probability: float
    sessions_expected: int
    sessions_seen: int
    looks: int
    detections: int
    updated: float
    moved_from: Floats | None = None


@dataclass(frozen=True)
class MapObject:
    """One object of the map, with the fields of objects.json.

    position: (3,) m. covariance: (3, 3) m^2, None for an unresolved object. rays, frames: how many rays and frames support
    the object. parallax_deg: the widest angle between two such rays. rms_deg: the root mean square of the angles between
    these rays and the object. first_seen, last_seen: stamps, s. extent: width and height, m, None if unknown. ray: the
    origin (3,), m, and the direction (3,) of one ray of an unresolved object. labels: the share of each label among the
    boxes. existence: the probability that the object exists. labels and existence are None if the run treated all boxes of a
    label as one object. seen_from: from where it was detected, None if unknown. life: its history over several sessions,
    None in the map of a single run. tag: the rotation and size of a fiducial, None for an object that is no fiducial. body:
    its size and heading around the position, None for a point. ray_point: (3,) m, where the rays through the centres of its
    boxes meet, None if they meet at the position. features: (D,) the unit appearance vector of its best view, which is its
    largest box that lies inside the image. None if its boxes have none.
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
    seen_from: SeenFrom | None = None
    life: Life | None = None
    body: Body | None = None
    ray_point: Floats | None = None
    tag: TagPose | None = None
    features: Floats32 | None = None

    def at(self, position: Floats) -> Self:
        """Return the object at another position (3,), m. This takes a tenth of the time of `dataclasses.replace`. The time
        matters, because a snapshot moves all objects."""
        moved = object.__new__(type(self))
        vars(moved).update(vars(self), position=position)
        return moved

    @property
    def sigma(self) -> float | None:
        """Standard deviation of the position along its least certain direction, m. None without a covariance."""
        return None if self.covariance is None else float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    def row(self) -> dict[str, Any]:
        """Return the values of the object by the names of `COLUMNS`. An unknown value is None."""
        covariance = [None] * 6 if self.covariance is None else [float(self.covariance[at]) for at in _UPPER_TRIANGLE]
        values = (
            *(self.id, self.label, self.status, *self.position.tolist(), *covariance, self.rays, self.frames),
            *(
                self.parallax_deg,
                self.rms_deg,
                *(self.extent or (None, None)),
                self.first_seen,
                self.last_seen,
                self.existence,
            ),
            *body_row(self.body),
            *tag_row(self.tag),
            *_life_row(self.life),
        )
        known = (None if isinstance(value, float) and not np.isfinite(value) else value for value in values)
        return dict(zip(COLUMNS, known, strict=True))

    def __str__(self) -> str:
        x, y, z = self.position
        place = f"at ({x:.3f}, {y:.3f}, {z:.3f}) m" if self.sigma is not None else self.status
        sigma = "" if self.sigma is None else f", sigma {self.sigma:.3f} m"
        return f"{self.label} #{self.id} {place}{sigma}, {self.rays} rays"


def _life_row(life: Life | None) -> tuple[str | float | None, ...]:
    if life is None:
        return (None,) * 8
    before = (None,) * 3 if life.moved_from is None else life.moved_from.tolist()
    return (life.state, life.probability, life.sessions_expected, life.sessions_seen, life.updated, *before)


@dataclass(frozen=True)
class ObjectMap:
    """The objects of one map, in the coordinate frame that `frame` names.

    A map is a sequence of its objects. Spatial queries return resolved objects only. The first query makes an index, so that
    later queries are also quick in large maps. A point is x, y, z in m, or x, y to ignore heights. gone: objects of earlier
    sessions that have left. shared_covariance: (7, 7) of the error that all objects share (`core.maps.shared_covariance`),
    None if unknown. The covariances of the objects contain it.
    """

    objects: tuple[MapObject, ...]
    frame: str = "map"
    gone: tuple[MapObject, ...] = ()
    shared_covariance: Floats | None = None

    @classmethod
    def of(cls, other: ObjectMap) -> Self:
        """Return the same map as an object of this class."""
        return cls(**{field.name: getattr(other, field.name) for field in fields(ObjectMap)})

    def __len__(self) -> int:
        return len(self.objects)

    def __iter__(self) -> Iterator[MapObject]:
        return iter(self.objects)

    @overload
    def __getitem__(self, index: int) -> MapObject: ...
    @overload
    def __getitem__(self, index: slice) -> Self: ...
    def __getitem__(self, index: int | slice) -> MapObject | Self:
        """Return the object with an index, or a map of the objects of a slice. `by_id` finds an object by its id."""
        return replace(self, objects=self.objects[index]) if isinstance(index, slice) else self.objects[index]

    def __repr__(self) -> str:
        lost, plural = len(self) - len(self.resolved()), "" if len(self) == 1 else "s"
        head = f"ObjectMap of {len(self)} object{plural} ({lost} unresolved) in the frame {self.frame!r}"
        more = [f"  ... and {len(self) - _SHOWN} more"] if len(self) > _SHOWN else []
        return "\n".join([head, *(f"  {o}" for o in self.objects[:_SHOWN]), *more])

    def by_id(self, number: int) -> MapObject:
        """Return the object with an id. KeyError if no object has the id."""
        for one in self.objects:
            if one.id == number:
                return one
        raise KeyError(f"the map has no object with the id {number}")

    @property
    def positions(self) -> Floats:
        """(N, 3) m, the positions of all objects. The position of an unresolved object is a guess on its ray, or NaN."""
        return np.array([o.position for o in self.objects], dtype=np.float64).reshape(-1, 3)

    @property
    def covariances(self) -> Floats:
        """(N, 3, 3) m^2, the covariances of all objects, NaN for unresolved ones."""
        unknown = np.full((3, 3), np.nan)
        found = [unknown if o.covariance is None else o.covariance for o in self.objects]
        return np.array(found, dtype=np.float64).reshape(-1, 3, 3)

    def resolved(self) -> tuple[MapObject, ...]:
        """Return the objects with a reliable position."""
        return tuple(o for o in self.objects if o.status == "ok")

    def nearest(self, point: ArrayLike, label: str | None = None) -> MapObject | None:
        """Return the nearest object to a point, among those with `label` or among all. None if there is no such object."""
        objects, index = self._placed(label)
        found = index.nearest(place_of(point))
        return None if found is None else objects[found]

    def in_radius(self, point: ArrayLike, radius: float, label: str | None = None) -> tuple[MapObject, ...]:
        """Return the objects at most `radius` m from a point, the nearest first. ValueError for a negative radius."""
        if not radius >= 0:
            raise ValueError(f"a radius is 0 m or more, got {radius!r}")
        objects, index = self._placed(label)
        return tuple(objects[i] for i in index.within(place_of(point), radius).tolist())

    def in_box(self, low: ArrayLike, high: ArrayLike, label: str | None = None) -> tuple[MapObject, ...]:
        """Return the objects inside or on the box with sides along the axes and the opposite corners `low` and `high`."""
        corners = corners_of(low, high)
        objects, index = self._placed(label)
        return tuple(objects[i] for i in index.inside(*corners).tolist())

    def search(self, vector: ArrayLike, k: int = 5) -> tuple[tuple[MapObject, float], ...]:
        """Return the k objects that look most like an appearance vector (D,), and their cosines to it, the largest first.

        Unresolved objects are also found. Objects without a vector are not. The vector must come from the encoder that made
        the vectors of the map. ValueError if it has another length, or is zero or not finite.
        """
        seen = [(o, o.features) for o in self.objects if o.features is not None]
        return tuple((seen[i][0], cosine) for i, cosine in ranked([look for _, look in seen], vector, k))

    def merge(self, other: ObjectMap) -> Self:
        """Merge another map into this one, and fuse the objects that both maps have.

        Two resolved objects of one label may be the same if the Mahalanobis distance of their positions is below the 99 %
        quantile. The Hungarian method makes the most one-to-one pairs, with the least sum of squared distances. The two
        positions of a pair are fused like two independent measurements, weighted by their information. Objects of this map
        keep their ids, and its `gone` stays as it is. Objects that only the other map has get new ids. ValueError if the two
        coordinate frames have different names.
        """
        if self.frame != other.frame:
            raise ValueError(f"the maps are in two frames, {self.frame!r} and {other.frame!r}: transform one map first")
        pairs = dict(_same_objects(self.objects, other.objects))
        objects = [_fuse(o, other.objects[pairs[i]]) if i in pairs else o for i, o in enumerate(self.objects)]
        taken, number = set(pairs.values()), max((o.id for o in self.objects), default=-1) + 1
        rest = [o for k, o in enumerate(other.objects) if k not in taken]
        both = (*objects, *(replace(o, id=number + k) for k, o in enumerate(rest)))
        return replace(self, objects=both, shared_covariance=None)

    def _placed(self, label: str | None) -> tuple[tuple[MapObject, ...], SpatialIndex]:
        """Return the resolved objects with a label, and the index of their positions, made by the first query."""
        if label not in self._indices:
            objects = tuple(o for o in self.resolved() if label in (None, o.label))
            points = np.array([o.position for o in objects], dtype=np.float64).reshape(-1, 3)
            self._indices[label] = objects, SpatialIndex(points)
        return self._indices[label]

    @cached_property
    def _indices(self) -> dict[str | None, tuple[tuple[MapObject, ...], SpatialIndex]]:
        return {}


def _same_objects(ours: tuple[MapObject, ...], theirs: tuple[MapObject, ...]) -> list[tuple[int, int]]:
    """Return a pair for each object that both maps have: its index in `ours` and its index in `theirs`."""
    from scipy.optimize import linear_sum_assignment

    mine, its = (
        [i for i, o in enumerate(objects) if o.status == "ok" and o.covariance is not None] for objects in (ours, theirs)
    )
    squared = np.full((len(mine), len(its)), np.inf)
    for label in {ours[i].label for i in mine} & {theirs[k].label for k in its}:
        rows = [row for row, i in enumerate(mine) if ours[i].label == label]
        columns = [column for column, k in enumerate(its) if theirs[k].label == label]
        squared[np.ix_(rows, columns)] = _mahalanobis([ours[mine[r]] for r in rows], [theirs[its[c]] for c in columns])
    allowed: Bools = squared <= SAME_POINT
    # A pair that is not allowed costs more than all allowed pairs together, so it replaces no allowed pair.
    cost = np.where(allowed, squared, SAME_POINT * (min(squared.shape) + 1))
    pairs = np.column_stack(linear_sum_assignment(cost)).tolist() if allowed.any() else []
    return [(mine[row], its[column]) for row, column in pairs if allowed[row, column]]


def _mahalanobis(ours: list[MapObject], theirs: list[MapObject]) -> Floats:
    """Return the squared Mahalanobis distances (N, M) between the positions of our objects and their objects."""
    apart = np.array([o.position for o in ours])[:, None] - np.array([o.position for o in theirs])
    own, their = (np.array([o.covariance for o in objects]) for objects in (ours, theirs))
    spread = own[:, None] + their + _FLOOR**2 * np.eye(3)
    squared: Floats = np.einsum("nmi,nmi->nm", apart, np.linalg.solve(spread, apart[..., None])[..., 0])
    return squared


def _fuse(a: MapObject, b: MapObject) -> MapObject:
    """Fuse two measurements of one object. The result has the id and the label of the first."""
    assert a.covariance is not None
    assert b.covariance is not None
    # A Kalman gain gives the same result as a sum of information matrices, and also works with a singular covariance.
    gain = a.covariance @ np.linalg.inv(a.covariance + b.covariance + _FLOOR**2 * np.eye(3))
    covariance = (np.eye(3) - gain) @ a.covariance
    share = a.rays / max(a.rays + b.rays, 1)
    extents = [(e, w) for e, w in ((a.extent, share), (b.extent, 1 - share)) if e is not None]
    extent = np.average([e for e, _ in extents], axis=0, weights=[w + 1e-9 for _, w in extents]) if extents else None
    labels = None
    if a.labels is not None and b.labels is not None:
        both = {n: share * a.labels.get(n, 0.0) + (1 - share) * b.labels.get(n, 0.0) for n in a.labels | b.labels}
        labels = dict(sorted(both.items(), key=lambda item: -item[1]))
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
        labels=labels,
        existence=None if a.existence is None or b.existence is None else float(np.fmax(a.existence, b.existence)),
        body=surer_body(a.body, b.body),
        ray_point=None,
        features=b.features if a.features is None else a.features,
    )

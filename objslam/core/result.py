"""The result of a run, from which every output is made. It has the map, the doubts about the map, and the surface of the
room."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import Calibration
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.trace import Round
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, Images, Keyframes, Rays

DoubtKind = Literal["pair", "split", "moved", "unresolved", "unsure", "boxes", "label"]
DOUBT_KINDS: tuple[DoubtKind, ...] = ("pair", "split", "moved", "unresolved", "unsure", "boxes", "label")
"""The kinds of doubts: two objects that may be one, an object that may be two, an object that was present for a part of the
drive, an object without a position, an object with a large sigma, boxes that belong to no object, and a label without an
object."""


LIKELY = 0.5
"""The least probability of a likely doubt. With a larger value, fewer objects are doubtful, and more maps are good."""


@dataclass(frozen=True, eq=False)
class Doubt:
    """One doubt about a map.

    reason: short and fixed, for programs. label: the label of the objects or boxes in doubt. text: one sentence, for people.
    objects: the ids of the objects in doubt. position: (3,) m in map, where the doubt is, None if it belongs to no place.
    rays: the rows of the boxes in doubt in rays.parquet. numbers: the measured numbers behind the sentence, with units in
    their names.
    """

    kind: DoubtKind
    reason: str
    label: str
    text: str
    objects: tuple[int, ...]
    position: Floats | None
    rays: Ints
    numbers: dict[str, float]

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Self:
        """Return the doubt of an entry of doubts.json. The entry must be valid."""
        position = None if entry["position"] is None else np.array(entry["position"], dtype=np.float64)
        numbers = {name: np.nan if value is None else float(value) for name, value in entry["numbers"].items()}
        kind, reason, label, text = (entry[name] for name in ("kind", "reason", "label", "text"))
        return cls(
            kind, reason, label, text, tuple(entry["objects"]), position, np.array(entry["rays"], dtype=np.int64), numbers
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of doubts.json. `from_dict` returns the same doubt, with numbers rounded to 6 digits."""
        numbers = {name: round(float(value), 6) if np.isfinite(value) else None for name, value in self.numbers.items()}
        position = None if self.position is None else [round(float(x), 6) for x in self.position]
        return {
            **{"kind": self.kind, "reason": self.reason, "label": self.label, "text": self.text},
            **{"objects": list(self.objects), "position": position, "numbers": numbers, "rays": self.rays.tolist()},
        }


def doubtful_ids(doubts: Iterable[Doubt], kinds: Collection[DoubtKind]) -> set[int]:
    """Return the ids of the objects that doubts of some kinds are about. Doubts that are not likely do not count."""
    likely = (one for one in doubts if one.kind in kinds and one.numbers.get("probability", 1.0) >= LIKELY)
    return {j for one in likely for j in one.objects}


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in map.

    vertices: (V, 3) m. normals: (V, 3). colours: (V, 3) RGB, None if unknown. triangles: (T, 3) indices into vertices.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    colours: NDArray[np.uint8] | None
    triangles: NDArray[np.int32]


@dataclass(frozen=True)
class RunResult:
    """The result of a run with K keyframes and R rays.

    keyframes: the keyframes with their poses before the estimation. map_T_base: (K, 4, 4) their poses after the estimation.
    The mode `fixed` does not change them. association: the object of each ray, as an index into map.objects. origins,
    directions: (R, 3) the rays in map at the solved poses. residual: (R,) rad, the angle between each ray and its object,
    NaN without an object. weight: (R,) robust weight in [0, 1]. summary: the content of summary.json. path, path_after: the
    path of the log at its full rate, before and after the estimation. trace: the rounds of the estimation. images: the image
    files of each camera. surface: the surroundings, None without depth images. surface_before: the surroundings at the poses
    before the estimation, None unless the settings ask for it. calibration: the shared errors that were estimated, None if
    none were. residual_before: (R,) rad, the residual before the correction of the shared errors, None if none were
    estimated. views: all camera frames on the path, also frames without a box, at the solved poses. None if they were not
    asked for. doubts: what is doubtful in the result, in words. The rays of a doubt are indices into `rays`.
    """

    map: ObjectMap
    keyframes: Keyframes
    map_T_base: Floats
    rays: Rays
    association: Association
    origins: Floats
    directions: Floats
    residual: Floats
    weight: Floats
    summary: dict[str, Any]
    settings: Settings
    cameras: tuple[Camera, ...]
    path: Trajectory
    path_after: Trajectory
    trace: tuple[Round, ...] = ()
    images: tuple[Images | None, ...] = ()
    surface: Surface | None = None
    surface_before: Surface | None = None
    calibration: Calibration | None = None
    residual_before: Floats | None = None
    views: Keyframes | None = None
    doubts: tuple[Doubt, ...] = ()

"""Read and write objects.json, the file format of object maps and of ground truth."""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from objslam.core.appearance.features import short_numbers, vector_of_entry
from objslam.core.arrays import Floats
from objslam.core.bodies.body_entry import body_entry, body_of_entry, size_of
from objslam.core.bodies.tag_pose import TagPose, tag_entry
from objslam.core.maps.shared_covariance import NUMBERS
from objslam.core.object_map import FATES, Life, MapObject, ObjectMap, SeenFrom
from objslam.core.types import TruthObject
from objslam.core.validity import MAX_POSITION, MAX_STAMP, covariance_fault, lengths, valid_positions
from objslam.errors import LogError, ObjslamError, OutputError

FORMAT = "objslam.objects/2"  # The value of the key "format", which is the file type and its version.
_READ = ("objslam.objects/1", FORMAT)  # The formats that can be read. Format 1 lacks the keys that format 2 added.
_UNIT = 1e-3  # The largest difference between the length of a unit vector and 1. A larger value accepts worse vectors.
_T = TypeVar("_T")


class _Malformed(OutputError):
    """An entry is malformed. The public functions convert this error to an error with the file name."""


def dump_objects(objects: ObjectMap) -> str:
    """Return the text of objects.json for a map. `read_objects` restores each finite number exactly. NaN and infinity
    become null."""
    shared = objects.shared_covariance
    more = {} if shared is None else {"shared_covariance": shared.tolist()}
    return _dump([_entry(o) for o in objects.objects], objects.frame, [_entry(o) for o in objects.gone], more)


def dump_truth_objects(objects: tuple[TruthObject, ...]) -> str:
    """Return the text of a ground truth file. `read_truth_objects` restores the same objects."""
    return _dump([_truth_entry(o) for o in objects], "map", [], {})


def _truth_entry(o: TruthObject) -> dict[str, Any]:
    entry: dict[str, Any] = {"id": o.id, "label": o.label, "position": o.position.tolist()}
    if o.size is not None:
        entry["size"] = o.size.tolist()
    if o.yaw is not None:
        entry["yaw"] = o.yaw
    if o.tag_xyzw is not None:
        entry["tag"] = {"rotation_xyzw": o.tag_xyzw.tolist()}
    return entry


def read_objects(file: Path) -> ObjectMap:
    """Return the map in an objects.json. Raises OutputError, which names the file and the malformed object."""
    try:
        return parse_objects(_load(file))
    except _Malformed as malformed:
        raise OutputError(str(malformed), where=str(file)) from malformed


def parse_objects(data: dict[str, Any]) -> ObjectMap:
    """Return the map from the decoded JSON data of an objects.json. Raises OutputError if the data are malformed."""
    if data.get("format") not in _READ:
        raise _Malformed(f"format is {data.get('format')!r}, not {FORMAT!r}")
    gone = data.get("gone", [])
    if not isinstance(gone, list):
        raise _Malformed("gone must be a list of objects")
    name = "shared_covariance"
    return ObjectMap(
        _each(data["objects"], _map_object, "objects"),
        _text(data.get("frame", "map"), "frame"),
        _each(gone, _map_object, "gone"),
        None if data.get(name) is None else _covariance(data[name], name, NUMBERS),
    )


def read_truth_objects(file: Path, error: type[ObjslamError] = LogError) -> tuple[TruthObject, ...]:
    """Return the objects of a ground truth file. It is an objects.json with at least id, label and position (m, in map).

    Objects with the status "unresolved" are skipped. A malformed file raises `error`, which names the file and the object.
    """
    try:
        data = _load(file)
        if data.get("format", FORMAT) not in _READ:
            raise _Malformed(f"format is {data['format']!r}, not {FORMAT!r}")
        return tuple(o for o in _each(data["objects"], _truth_object, "objects") if o is not None)
    except _Malformed as malformed:
        raise error(str(malformed), where=str(file)) from malformed


def _dump(entries: list[dict[str, Any]], frame: str, gone: list[dict[str, Any]], more: dict[str, Any]) -> str:
    """Return the text of objects.json. Each object has its own line, so that two files can be compared line by line."""
    first = {"format": FORMAT, "frame": frame, **more}
    head = json.dumps(first, allow_nan=False)[:-1] + ', "objects": '
    return head + _lines(entries) + (f', "gone": {_lines(gone)}' if gone else "") + "}\n"


def _lines(entries: list[dict[str, Any]]) -> str:
    lines = [json.dumps(entry, ensure_ascii=False, allow_nan=False) for entry in entries]
    return "[" + ("\n  " + ",\n  ".join(lines) + "\n" if lines else "") + "]"


def _entry(o: MapObject) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "id": int(o.id),
        "label": o.label,
        "position": [_null(x) for x in o.position.tolist()],
        "covariance": None if o.covariance is None or not np.isfinite(o.covariance).all() else o.covariance.tolist(),
        "status": o.status,
        "rays": int(o.rays),
        "frames": int(o.frames),
        "parallax_deg": _null(o.parallax_deg),
        "rms_deg": _null(o.rms_deg),
        "extent": None if o.extent is None or not np.isfinite(o.extent).all() else [float(x) for x in o.extent],
        "first_seen": _null(o.first_seen),
        "last_seen": _null(o.last_seen),
    }
    if o.labels is not None:
        entry["labels"] = {name: float(share) for name, share in o.labels.items()}
    if o.existence is not None:
        entry["existence"] = float(o.existence)
    if o.seen_from is not None:
        entry["seen_from"] = {**vars(o.seen_from), "sides": o.seen_from.sides.tolist()}
    if o.life is not None:
        moved = o.life.moved_from
        entry["life"] = {**vars(o.life), "moved_from": None if moved is None else moved.tolist()}
    if o.body is not None:
        entry |= body_entry(o.body)
    if o.ray_point is not None:
        entry["ray_point"] = o.ray_point.tolist()
    if o.tag is not None:
        entry["tag"] = tag_entry(o.tag)
    entry |= {} if o.features is None else {"features": short_numbers(o.features)}
    if o.ray is not None:
        entry["ray"] = {name: part.tolist() for name, part in zip(("origin", "direction"), o.ray, strict=True)}
    return entry


def _null(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def _load(file: Path) -> dict[str, Any]:
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise _Malformed(f"cannot read the objects: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise _Malformed(f"not UTF-8 text (byte {error.start})") from error
    except json.JSONDecodeError as error:
        raise _Malformed(f"not JSON: {error.msg} in line {error.lineno}, column {error.colno}") from error
    except (ValueError, RecursionError) as error:  # Integers of thousands of digits and deeply nested brackets raise these.
        raise _Malformed(f"not JSON that can be read: {error}") from error
    if not isinstance(data, dict) or not isinstance(data.get("objects"), list):
        raise _Malformed('not an objects file: a mapping with a list under "objects" is needed')
    return data


def _each(entries: list[Any], parse: Callable[[dict[str, Any]], _T], name: str) -> tuple[_T, ...]:
    parsed: list[_T] = []
    seen: set[int] = set()
    for i, entry in enumerate(entries):
        try:
            if not isinstance(entry, dict):
                raise _Malformed("not a mapping")
            number = _integer(entry, "id")
            if number in seen:
                raise _Malformed(f"id {number} occurs twice")
            seen.add(number)
            parsed.append(parse(entry))
        except _Malformed as malformed:
            raise _Malformed(f"{name}[{i}]: {malformed}") from malformed
    return tuple(parsed)


def _stamp(entry: dict[str, Any], name: str) -> float:
    stamp = _number(entry.get(name), name, null=True)
    if abs(stamp) > MAX_STAMP:
        raise _Malformed(f"{name} must be a stamp in seconds")
    return stamp


def _truth_object(entry: dict[str, Any]) -> TruthObject | None:
    if entry.get("status") == "unresolved":
        return None
    size = None if entry.get("size") is None else _converted(lambda: size_of(entry, "size"))
    yaw = None if entry.get("yaw") is None else _number(entry["yaw"], "yaw")
    place = _vector(entry.get("position"), "position")
    tag: Any = entry.get("tag")
    if tag is not None and not isinstance(tag, dict):
        raise _Malformed("tag must be a mapping")
    xyzw = None if tag is None else _quaternion(tag.get("rotation_xyzw"), "tag.rotation_xyzw")
    return TruthObject(_integer(entry, "id"), _text(entry.get("label"), "label"), place, size, yaw, xyzw)


def _map_object(entry: dict[str, Any]) -> MapObject:
    status = entry.get("status")
    if status not in ("ok", "unresolved"):
        raise _Malformed(f'status must be "ok" or "unresolved", got {status!r}')
    covariance, extent, ray, labels = (entry.get(name) for name in ("covariance", "extent", "ray", "labels"))
    if extent is not None:
        extent = tuple(_vector(extent, "extent", 2).tolist())
        if not all(0 <= side < MAX_POSITION for side in extent):
            raise _Malformed("extent must be a width and a height in metres")
    if ray is not None:
        if not isinstance(ray, dict):
            raise _Malformed("ray must have an origin and a direction")
        ray = (_vector(ray.get("origin"), "ray.origin"), _vector(ray.get("direction"), "ray.direction"))
        if not valid_positions(ray[0]) or not abs(float(lengths(ray[1])) - 1) < _UNIT:
            raise _Malformed(f"ray must have an origin within {MAX_POSITION:g} m of 0 and a direction of length 1")
    if labels is not None:
        if not isinstance(labels, dict):
            raise _Malformed("labels must be a mapping of labels to shares")
        labels = {_text(name, "a name in labels"): _number(share, "a share in labels") for name, share in labels.items()}
    position = _vector(entry.get("position"), "position", null=status == "unresolved")
    if status == "ok" and not valid_positions(position):
        raise _Malformed(f"position is not within {MAX_POSITION:g} m of 0")
    return MapObject(
        id=_integer(entry, "id"),
        label=_text(entry.get("label"), "label"),
        position=position,
        covariance=None if covariance is None else _covariance(covariance, "covariance"),
        status=status,
        rays=_integer(entry, "rays"),
        frames=_integer(entry, "frames"),
        parallax_deg=_number(entry.get("parallax_deg"), "parallax_deg", null=True),
        rms_deg=_number(entry.get("rms_deg"), "rms_deg", null=True),
        first_seen=_stamp(entry, "first_seen"),
        last_seen=_stamp(entry, "last_seen"),
        extent=extent,
        ray=ray,
        labels=labels,
        existence=None if entry.get("existence") is None else _number(entry["existence"], "existence"),
        seen_from=None if entry.get("seen_from") is None else _seen_from(entry["seen_from"]),
        life=None if entry.get("life") is None else _life(entry["life"]),
        body=_converted(lambda: body_of_entry(entry)),
        ray_point=None if entry.get("ray_point") is None else _vector(entry["ray_point"], "ray_point"),
        tag=None if entry.get("tag") is None else _tag(entry["tag"]),
        features=_converted(lambda: vector_of_entry(entry)),
    )


def _converted(read: Callable[[], _T]) -> _T:
    try:
        return read()
    except ValueError as error:
        raise _Malformed(str(error)) from error


def _seen_from(value: Any) -> SeenFrom:
    if not isinstance(value, dict) or not isinstance(value.get("sides"), list):
        raise _Malformed("seen_from must have near, far and a list of sides")
    near, far = (_number(value.get(name), f"seen_from.{name}") for name in ("near", "far"))
    if not 0 <= near <= far < MAX_POSITION:
        raise _Malformed("near and far of seen_from must be distances in metres, near not above far")
    sides = np.array([_vector(side, "a side of seen_from") for side in value["sides"]]).reshape(-1, 3)
    if not (np.abs(lengths(sides) - 1) < _UNIT).all():
        raise _Malformed("a side of seen_from must have the length 1")
    return SeenFrom(near, far, sides)


def _tag(value: Any) -> TagPose:
    if not isinstance(value, dict):
        raise _Malformed("tag must be a mapping")
    covariance = _covariance(value.get("rotation_covariance"), "tag.rotation_covariance")
    size, sigma = (_number(value.get(name), f"tag.{name}") for name in ("size", "size_sigma"))
    if not (0 < size < MAX_POSITION and 0 <= sigma < MAX_POSITION):
        raise _Malformed("tag.size must be above 0 m, and tag.size_sigma at least 0 m")
    rotation, other, probability = _quaternion(value.get("rotation_xyzw"), "tag.rotation_xyzw"), None, 0.0
    if value.get("other_rotation_xyzw") is not None:
        other = _quaternion(value["other_rotation_xyzw"], "tag.other_rotation_xyzw")
        probability = _number(value.get("other_probability"), "tag.other_probability")
        if not 0 <= probability <= 1:
            raise _Malformed("tag.other_probability must be from 0 to 1")
    return TagPose(rotation, covariance, size, sigma, other, probability)


def _covariance(value: Any, name: str, size: int = 3) -> Floats:
    if not isinstance(value, list) or len(value) != size:
        raise _Malformed(f"{name} must be {size} rows of {size} numbers")
    covariance = np.stack([_vector(row, f"a row of {name}", size) for row in value])
    if (fault := covariance_fault(covariance)) is not None:
        raise _Malformed(f"{name} {fault}")
    if not (np.diagonal(covariance) < MAX_POSITION**2).all():
        raise _Malformed(f"{name} has a standard deviation beyond {MAX_POSITION:g}")
    return covariance


def _quaternion(value: Any, name: str) -> Floats:
    xyzw = _vector(value, name, 4)
    if not abs(float(lengths(xyzw)) - 1) < _UNIT:
        raise _Malformed(f"{name} must have the length 1")
    return xyzw


def _life(value: Any) -> Life:
    if not isinstance(value, dict):
        raise _Malformed("life must be a mapping")
    moved, state = value.get("moved_from"), next((fate for fate in FATES if fate == value.get("state")), None)
    if state is None:
        raise _Malformed(f"life.state must be one of {', '.join(FATES)}, got {_short(value.get('state'))}")
    probability = _number(value.get("probability"), "life.probability")
    if not 0 <= probability <= 1:
        raise _Malformed("life.probability must be from 0 to 1")
    counts = {name: _integer(value, name) for name in ("sessions_expected", "sessions_seen", "looks", "detections")}
    if min(counts.values()) < 0:
        raise _Malformed("the counts of life must not be below 0")
    place = None if moved is None else _vector(moved, "life.moved_from")
    if place is not None and not valid_positions(place):
        raise _Malformed(f"life.moved_from is not within {MAX_POSITION:g} m of 0")
    return Life(state, probability, **counts, updated=_stamp(value, "updated"), moved_from=place)


def _integer(entry: dict[str, Any], name: str) -> int:
    value = entry.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not -(2**63) <= value < 2**63:
        raise _Malformed(f"{name} must be an integer, got {_short(value)}")
    return value


def _text(value: Any, name: str) -> str:
    # An unpaired surrogate is valid JSON, but cannot be written to a file.
    if not isinstance(value, str) or not value or any("\ud800" <= c <= "\udfff" for c in value):
        raise _Malformed(f"{name} must be text, got {_short(value)}")
    return value


def _number(value: Any, name: str, null: bool = False) -> float:
    if value is None and null:
        return math.nan
    good = isinstance(value, int | float) and not isinstance(value, bool)
    # This check precedes float(), because an integer can exceed the largest float.
    if not good or not -sys.float_info.max <= value <= sys.float_info.max:
        raise _Malformed(f"{name} must be a finite number, got {_short(value)}")
    return float(value)


def _vector(value: Any, name: str, size: int = 3, null: bool = False) -> Floats:
    if not isinstance(value, list) or len(value) != size:
        raise _Malformed(f"{name} must be {size} numbers, got {_short(value)}")
    return np.array([_number(x, name, null) for x in value], dtype=np.float64)


def _short(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."

"""The fields of known message types that objslam reads. A bag may define other fields under the name of a known type."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from objslam.ros.messages.topic_types import CAMERA_INFO, COMPRESSED, IMAGE, ODOMETRY, POSES, TRANSFORMS

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_CAPITALS = {"d": "D", "k": "K", "r": "R", "p": "P"}  # The ROS 1 names of fields of CameraInfo, by their ROS 2 names.
_INTEGERS = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32)}
_TIMES = {"int32", "uint32"}  # The types of seconds and nanoseconds. A time with wider seconds does not fit 64 bits of ns.
_NUMBERS = {*_INTEGERS, "int64", "uint64", "float32", "float64"}
_KINDS = {
    "text": {"string"},
    "flag": {*_INTEGERS, "bool", "octet"},
    "integer": _INTEGERS,
    "time": _TIMES,
    "number": _NUMBERS,
    "bytes": {"uint8", "octet", "char"},
}
"""The base types that a field of each kind may have."""
_HEADER = {"header.stamp.sec": "time", "header.stamp.nanosec": "time", "header.frame_id": "text"}


def _pose(at: str, place: str = "position", turn: str = "orientation") -> dict[str, str]:
    return {f"{at}.{place}.{axis}": "number" for axis in "xyz"} | {f"{at}.{turn}.{axis}": "number" for axis in "xyzw"}


_SIZE = {"width": "integer", "height": "integer"}
_TRANSFORM = {"child_frame_id": "text", **_HEADER, **_pose("transform", "translation", "rotation")}
_REGION = {f"roi.{name}": "integer" for name in ("x_offset", "y_offset", "width", "height")}
_FIELDS: dict[str, dict[str, str]] = {
    ODOMETRY: _HEADER | {"child_frame_id": "text"} | _pose("pose.pose"),
    POSES[0]: _HEADER | _pose("pose"),
    POSES[1]: _HEADER | _pose("pose.pose"),
    IMAGE: _HEADER | _SIZE | {"encoding": "text", "is_bigendian": "flag", "step": "integer", "data[]": "bytes"},
    COMPRESSED: _HEADER | {"format": "text", "data[]": "bytes"},
    CAMERA_INFO: _HEADER | _SIZE | _REGION | {"distortion_model": "text", "binning_x": "integer", "binning_y": "integer"}
    | {"d[]": "number", "k[9]": "number", "r[9]": "number", "p[12]": "number"},
    **{name: {f"transforms[].{path}": kind for path, kind in _TRANSFORM.items()} for name in TRANSFORMS},
}  # fmt: skip
"""The fields of each message type: the kind of each field by its path. [] marks a list of any length. [9] marks an array of
9 elements."""


def missing_field(store: Typestore, type_: str) -> str | None:
    """Return the first field of a type that objslam reads but the definition in a store lacks, or None if none is missing.

    A field of a wrong kind counts as missing. For types of boxes, and for types that objslam does not read, nothing is
    checked, and the result is None.
    """
    return next((path for path, kind in _FIELDS.get(type_, {}).items() if not _has(store, type_, path, kind)), None)


def _has(store: Typestore, type_: str, path: str, kind: str) -> bool:
    from rosbags.interfaces import Nodetype

    described: Any = (Nodetype.NAME, type_)
    for part in path.split("."):
        if described[0] != Nodetype.NAME or described[1] not in store.fielddefs:
            return False
        name, _, count = part.partition("[")
        fields = dict(store.fielddefs[described[1]][1])
        described = fields.get(name, fields.get(_CAPITALS.get(name, "")))
        if described is None:
            return False
        if count:
            lists = (Nodetype.ARRAY,) if count != "]" else (Nodetype.ARRAY, Nodetype.SEQUENCE)
            if described[0] not in lists or (count != "]" and described[1][1] != int(count[:-1])):
                return False
            described = described[1][0]
    return bool(described[0] == Nodetype.BASE and described[1][0] in _KINDS[kind])

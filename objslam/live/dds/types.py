"""DDS types of ROS 2 messages. Their payloads stay bytes in CDR, which rosbags encodes and decodes."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

from objslam.ros.bag.records import type_name
from objslam.ros.messages.decode import DecodeError, typestores

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_BASES = {"bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"}
_PREFIX, _PARTS = "rt/", ("::msg::dds_::", "_")


def dds_topic(topic: str) -> str:
    """Return the DDS name of a ROS topic: /odom becomes rt/odom."""
    return _PREFIX + topic.lstrip("/")


def ros_topic(name: str) -> str | None:
    """Return the ROS topic of a DDS topic's name, or None if the name is not of a ROS topic, but for example of a
    service."""
    return "/" + name.removeprefix(_PREFIX) if name.startswith(_PREFIX) else None


def dds_type(type_: str) -> str:
    """Return the DDS name of a ROS type: nav_msgs/msg/Odometry becomes nav_msgs::msg::dds_::Odometry_."""
    package, _, name = type_.partition("/msg/")
    return f"{package}{_PARTS[0]}{name}{_PARTS[1]}"


def ros_type(name: str) -> str | None:
    """Return the ROS type of a DDS type's name, or None if the name is not of a ROS type."""
    package, middle, rest = name.partition(_PARTS[0])
    return type_name(f"{package}/msg/{rest.removesuffix(_PARTS[1])}") if middle and rest.endswith(_PARTS[1]) else None


@lru_cache(maxsize=1024)
def layouts_of(type_: str) -> tuple[type, ...]:
    """Return the DDS types of a ROS type, one per known layout.

    An instance holds a serialised message in `data`. A received instance also has the `sample_info` of DDS.
    """
    try:
        stores = typestores(type_, "cdr", "", "msg")
    except DecodeError:
        return ()
    return tuple(_make_type(store, type_) for store in stores)


def _make_type(store: Typestore, type_: str) -> type:
    """Make a DDS type that declares fields but passes bytes, because cyclonedds would process each field in Python."""
    made = _make_struct(store, type_, {})

    def serialize(self: Any, *args: Any, **kwargs: Any) -> bytes:
        return bytes(self.data)

    def deserialize(cls: Any, data: bytes, *args: Any, **kwargs: Any) -> Any:
        sample = cls.__new__(cls)
        sample.data = data
        return sample

    def init(self: Any, data: bytes) -> None:
        self.data = data

    incoming = dict.fromkeys(("deserialize", "deserialize_key"), classmethod(deserialize))
    for name, method in {"serialize": serialize, "__init__": init, **incoming}.items():
        setattr(made, name, method)
    return made


def _make_struct(store: Typestore, type_: str, made: dict[str, type]) -> type:
    from cyclonedds.idl import make_idl_struct

    if type_ not in made:
        fields = {name: _make_field(store, description, made) for name, description in store.fielddefs[type_][1]}
        made[type_] = make_idl_struct(type_.rpartition("/")[2], dds_type(type_).replace("::", "."), fields)
    return made[type_]


def _make_field(store: Typestore, description: Any, made: dict[str, type]) -> Any:
    from cyclonedds import idl
    from rosbags.interfaces import Nodetype

    types: Any = idl.types  # Untyped, because its generics are made at run time.
    kind, detail = description
    if kind == Nodetype.NAME:
        return _make_struct(store, detail, made)
    if kind == Nodetype.BASE:
        name, bound = detail
        if name == "string":
            return types.bounded_str[bound] if bound else str
        if name == "bool":
            return bool
        return getattr(types, name) if name in _BASES else types.byte
    element = _make_field(store, detail[0], made)
    if kind == Nodetype.ARRAY:
        return types.array[element, int(detail[1])]
    return types.sequence[element, int(detail[1])] if detail[1] else types.sequence[element]

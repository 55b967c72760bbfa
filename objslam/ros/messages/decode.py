"""Decode serialised messages, or only read their headers."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from objslam.ros.bag.records import Connection
from objslam.ros.messages import definitions
from objslam.ros.messages.layouts import missing_field

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_MAX_DEFINITION = 1 << 18  # The length limit of a definition, characters. The limit bounds the parsing time.
_MAX_TYPES, _MAX_FIELDS, _MAX_ELEMENTS = 200, 2000, 50_000
"""The largest numbers of types, fields and array elements in a definition. They bound the size of the generated code."""
_WRONG = (ValueError, LookupError, ArithmeticError, AssertionError, RecursionError, TypeError, AttributeError, struct.error)
"""The errors that the type library raises for malformed definitions and messages, besides its own errors."""


class DecodeError(ValueError):
    """The error for a message, or for a message type, that cannot be decoded. The text of the error gives the reason."""


def read_head(data: bytes, encoding: str) -> tuple[int, str, int]:
    """Return timestamp (ns) and frame_id of the std_msgs/Header at the start of a message, and the next unsigned integer.

    The integer has 32 bits. If an array follows the header, the integer is the length of the array. If the message ends
    after the header, the integer is 0. encoding: "ros1" or "cdr". Raises DecodeError if the header is cut off.
    """
    order = ">" if encoding == "cdr" and data[1:2] == b"\0" else "<"
    try:
        seconds, nanoseconds, size = struct.unpack_from(order + "III", data, 4)  # After the ROS 1 seq or the CDR header.
    except struct.error as error:
        raise DecodeError("shorter than a header") from error
    end = 16 + size
    if end > len(data):
        raise DecodeError("shorter than its frame_id")
    frame = data[16:end].rstrip(b"\0").decode("utf-8", "replace")
    if encoding == "cdr":
        end = (end + 3) & -4
    number = struct.unpack_from(order + "I", data, end)[0] if end + 4 <= len(data) else 0
    return seconds * 10**9 + nanoseconds, frame, number


def read_length(data: bytes, encoding: str) -> int:
    """Return the array length in a message that is only an array, such as tf2_msgs/TFMessage.

    The result is 0 if the message is too short. encoding: "ros1" or "cdr".
    """
    at = 4 if encoding == "cdr" else 0
    big = encoding == "cdr" and data[1:2] == b"\0"
    return int.from_bytes(data[at : at + 4], "big" if big else "little") if len(data) >= at + 4 else 0


def make_decoder(connection: Connection) -> Callable[[bytes], Any]:
    """Return a function that decodes the messages of a connection. The function raises DecodeError for malformed messages.

    If the file has no definition, the known definitions are tried. Raises DecodeError if no definition can be used.
    """
    name, encoding = connection.type, connection.encoding
    if encoding not in ("ros1", "cdr"):
        raise DecodeError(f"encoded as {encoding[:40]!r}, which is not supported")
    stores = list(typestores(name, encoding, connection.definition, connection.language))

    def decode(data: bytes) -> Any:
        from rosbags.serde import SerdeError

        reason = ""
        for index, store in enumerate(stores):
            try:
                message = (store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr)(data, name)
            except (SerdeError, *_WRONG) as error:
                reason = reason or str(error) or type(error).__name__
                continue
            if index:
                stores.insert(0, stores.pop(index))
            return message
        raise DecodeError(reason)

    return decode


@lru_cache(maxsize=256)
def typestores(name: str, encoding: str, definition: str, language: str) -> tuple[Typestore, ...]:
    """Return a type store of the rosbags library for each possible definition of a type. The result is cached.

    definition: the definition in the bag, or "". language: the language of the definition, "msg" or "idl". Raises
    DecodeError if there is no definition, or if a definition cannot be used.
    """
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

    texts: tuple[str, ...] = (definition,) if definition else definitions.KNOWN.get(name, ())
    if not texts:
        known = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
        if name not in known.fielddefs:
            raise DecodeError("the bag lacks the definition of the type")
        return (known,)
    stores = []
    for text in texts:
        if len(text) > _MAX_DEFINITION:
            raise DecodeError("its definition is too long")
        try:
            types = get_types_from_idl(text) if language == "idl" else get_types_from_msg(text, name)
            fields = [description for _, members in types.values() for _, description in members]
            elements = sum(int(description[1][1]) for description in fields if description[0] == Nodetype.ARRAY)
            if len(types) > _MAX_TYPES or len(fields) > _MAX_FIELDS or elements > _MAX_ELEMENTS:
                raise ValueError("it is too large")
            store = get_typestore(Stores.EMPTY)
            store.register(types)
            store.get_msgdef(name)
            if (missing := missing_field(store, name)) is not None:
                raise ValueError(f"it has no usable field {missing}")
        except (TypesysError, SyntaxError, *_WRONG) as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0][:80]
            raise DecodeError(f"its definition cannot be used ({reason})") from error
        stores.append(store)
    return tuple(stores)

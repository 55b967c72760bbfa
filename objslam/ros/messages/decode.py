"""From serialised messages to objects, type by type; and what can be seen of a message without that."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from objslam.ros.bag.records import Connection
from objslam.ros.messages import definitions

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

_MAX_DEFINITION = 1 << 18  # The longest text of a definition, letters; a longer one is refused.
_MAX_TYPES, _MAX_FIELDS, _MAX_ELEMENTS = 200, 2000, 50_000
"""The most types, fields, and elements of arrays of one definition; chosen to bound the code that is made of them."""
_HEAD = {"<": struct.Struct("<III"), ">": struct.Struct(">III")}
_NUMBER = {"<": struct.Struct("<I"), ">": struct.Struct(">I")}
_WRONG = (ValueError, LookupError, ArithmeticError, AssertionError, RecursionError, TypeError, AttributeError, struct.error)
"""What the type library raises, besides its own errors, for definitions and messages that are not what they should be."""


class DecodeError(ValueError):
    """A message, or a whole type, that cannot be decoded; says why."""


def read_head(data: bytes, encoding: str) -> tuple[int, str, int]:
    """Stamp (ns) and frame_id of a message that begins with a std_msgs/Header, and the u32 number after them (0 if none).

    For an array message that number is its length. Stamp and frame_id stand at the same bytes in ROS 1 and in CDR: the one
    has a sequence number where the other has its encapsulation. DecodeError where the message is shorter than that.
    """
    order = ">" if encoding == "cdr" and data[1:2] == b"\0" else "<"
    try:
        seconds, nanoseconds, size = _HEAD[order].unpack_from(data, 4)
    except struct.error as error:
        raise DecodeError("shorter than a header") from error
    end = 16 + size
    if end > len(data):
        raise DecodeError("shorter than its frame_id")
    frame = data[16:end].rstrip(b"\0").decode("utf-8", "replace")
    if encoding == "cdr":
        end = (end + 3) & -4
    number = _NUMBER[order].unpack_from(data, end)[0] if end + 4 <= len(data) else 0
    return seconds * 10**9 + nanoseconds, frame, number


def read_length(data: bytes, encoding: str) -> int:
    """The length of a message that is nothing but an array (tf2_msgs/TFMessage), 0 if it is too short to tell."""
    order = ">" if encoding == "cdr" and data[1:2] == b"\0" else "<"
    at = 4 if encoding == "cdr" else 0
    return int(_NUMBER[order].unpack_from(data, at)[0]) if len(data) >= at + 4 else 0


def make_decoder(connection: Connection) -> Callable[[bytes], Any]:
    """A function that decodes the messages of a connection, raising DecodeError for those that it cannot.

    The definition is the one that the file brings, else one that is known. Where several layouts of a type are known, each
    message is tried with the one that fitted last, then with the others. DecodeError where there is no definition, or none
    that can be used.
    """
    name, encoding = connection.type, connection.encoding
    if encoding not in ("ros1", "cdr"):
        raise DecodeError(f"encoded as {encoding[:40]!r}, which is not read")
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
    """What can decode a type, one for each layout; the files of a recording share them, as making them takes a while.

    DecodeError where there is no definition, or none that can be used.
    """
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

    texts: tuple[str, ...] = (definition,) if definition else definitions.KNOWN.get(name, ())
    if not texts:
        known = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
        if name not in known.fielddefs:
            raise DecodeError("the bag does not bring the type's definition")
        return (known,)
    stores = []
    for text in texts:
        if len(text) > _MAX_DEFINITION:
            raise DecodeError("its definition is larger than any definition")
        try:
            types = get_types_from_idl(text) if language == "idl" else get_types_from_msg(text, name)
            _check(types)
            store = get_typestore(Stores.EMPTY)
            store.register(types)
            store.get_msgdef(name)
        except (TypesysError, SyntaxError, *_WRONG) as error:
            reason = str(error).strip().splitlines()[0][:80] if str(error).strip() else type(error).__name__
            raise DecodeError(f"its definition cannot be used ({reason})") from error
        stores.append(store)
    return tuple(stores)


def _check(types: Typesdict) -> None:
    """Refuse definitions of absurd size: code is made of them, a line for each field and each element of an array."""
    from rosbags.interfaces import Nodetype

    fields = [description for _, members in types.values() for _, description in members]
    elements = sum(int(description[1][1]) for description in fields if description[0] == Nodetype.ARRAY)
    if len(types) > _MAX_TYPES or len(fields) > _MAX_FIELDS or elements > _MAX_ELEMENTS:
        raise ValueError("it is of absurd size")

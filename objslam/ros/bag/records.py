"""What a bag file holds, whatever its format: connections and messages; and what could not be read of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

MAX_RECORD = 256 << 20
"""The largest record, chunk or message that is loaded, bytes, packed or not; chosen to bound the memory."""

LANGUAGES = {"ros2msg": "msg", "ros1msg": "msg", "ros2idl": "idl"}
"""The language of a definition, by the name that a bag has for it."""

Message = tuple["Connection", int, bytes]
"""Connection, time of recording (ns), and the serialised message."""
Messages = Iterator[Message]

MAX_NAME = 256  # The longest name of a topic or frame that is kept, letters; chosen for a line that can be read.
_TYPE = re.compile(r"([A-Za-z]\w*)/(?:(?:msg|action|srv)/)?([A-Za-z]\w*)", re.ASCII)


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic as one file describes it.

    type: as ROS 2 writes it, package/msg/Name. encoding: "ros1", "cdr", or what else the file says. definition: the text of
    the type, in `language` "msg" or "idl"; empty where the file brings none.
    """

    topic: str
    type: str
    encoding: str
    definition: str = ""
    language: str = "msg"


@dataclass
class FileReport:
    """How the reading of one file went: messages read, lost (known from the file's own indexes), and why, in words.

    expected: how many messages the file says it holds, None where it does not say. complete: False where something is gone
    of which nothing tells how much.
    """

    file: str
    messages: int = 0
    lost: int = 0
    expected: int | None = None
    complete: bool = True
    problems: list[str] = field(default_factory=list)

    def damage(self, problem: str, lost: int | None = None) -> None:
        """Note a damaged place; lost: the messages gone with it, None where that is not known."""
        if problem not in self.problems:
            self.problems.append(problem)
        if lost is None:
            self.complete = False
        else:
            self.lost += lost

    def close(self) -> None:
        """Settle the count when all is read: what the file says it holds is better than the sum over its damaged places."""
        if self.expected is not None:
            self.lost = max(self.lost, self.expected - self.messages)
            self.complete = True

    def lines(self) -> list[str]:
        """The report in words, one line a problem; nothing where the file is whole."""
        if not self.problems and not self.lost:
            return []
        known = f"at least {self.lost}" if self.lost else "an unknown number"
        lost = f"{self.lost if self.complete else known} lost"
        return [
            f"{self.file}: damaged, {self.messages} messages read, {lost}: {'; '.join(self.problems) or 'no reason seen'}"
        ]


def plain(name: str) -> str:
    """The name of a topic or frame as one line can show it: what is not printable is replaced, what is long is cut."""
    if len(name) <= MAX_NAME and name.isprintable():
        return name
    return "".join(c if c.isprintable() else "\ufffd" for c in name[:MAX_NAME])


def frame_name(frame_id: str) -> str:
    """A frame as tf knows it: ROS 1 wrote some of them with a leading slash."""
    name = frame_id.lstrip("/")
    return name if len(name) <= MAX_NAME and name.isprintable() else plain(name)


def type_name(name: str) -> str:
    """A message type as ROS 2 writes it (nav_msgs/Odometry becomes nav_msgs/msg/Odometry); what is no type stays."""
    match = _TYPE.fullmatch(name)
    return f"{match[1]}/msg/{match[2]}" if match else plain(name)

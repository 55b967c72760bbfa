"""The content of a bag file, independent of its format, and the report of unreadable parts."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

MAX_RECORD = 256 << 20  # The size limit of a record, chunk or message, packed or unpacked, bytes. The limit bounds memory.
LANGUAGES = {"ros2msg": "msg", "ros1msg": "msg", "ros2idl": "idl"}  # The definition language by its name in bags.
MAX_NAME = 256  # The length limit of a topic or frame name, characters. The limit keeps messages readable.
_TYPE = re.compile(r"([A-Za-z]\w*)/(?:(?:msg|action|srv)/)?([A-Za-z]\w*)", re.ASCII)


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic as one file describes it."""

    topic: str
    type: str  # The message type in ROS 2 form, package/msg/Name.
    encoding: str  # The encoding of messages: "ros1", "cdr", or another name from the file.
    definition: str = ""  # The text that defines the message type, empty if the file does not contain it.
    language: str = "msg"  # The language of the definition, "msg" or "idl".


Messages = Iterator[tuple[Connection, int, bytes]]  # Each tuple has connection, recording time (ns) and message bytes.
Wanted = Callable[[Connection], bool]  # The function returns whether the caller wants the messages of a connection.


@dataclass
class FileReport:
    """The result of reading one file. of_folder: whether it is about the messages that no file of a folder has instead."""

    file: str
    messages: int = 0  # The number of messages read.
    lost: int = 0  # The number of messages known to be lost.
    expected: int | None = None  # The message count that the file states, None if unknown.
    complete: bool = True  # False if an unknown number of messages is lost.
    problems: list[str] = field(default_factory=list)  # One text per kind of damage.
    of_folder: bool = False

    def damage(self, problem: str, lost: int | None = None) -> None:
        """Add damage of the kind `problem`. lost: the number of messages that this damage lost, None if unknown."""
        if problem not in self.problems:
            self.problems.append(problem)
        if lost is None:
            self.complete = False
        else:
            self.lost += lost

    def close(self) -> None:
        """Compare the messages read with the count that the file states, if any.

        Then `lost` is at least the stated count minus the messages read, and `complete` is True.
        """
        if self.expected is not None:
            self.lost = max(self.lost, self.expected - self.messages)
            self.complete = True

    def lines(self) -> list[str]:
        """Return the report as a list of at most one line. The list is empty for an intact file."""
        if not self.problems and not self.lost:
            return []
        if self.of_folder:
            return [f"{self.file}: {self.lost} messages are missing, because metadata.yaml counts {self.expected}"]
        known = f"at least {self.lost}" if self.lost else "an unknown number"
        why = "; ".join(self.problems) or "no reason seen"
        return [f"{self.file}: damaged, {self.messages} messages read, {self.lost if self.complete else known} lost: {why}"]


@dataclass
class Reading:
    """The state of reading a file of chunks. In the file, the index of a chunk comes after the chunk.

    connections: by their number in the file. chunk_read, chunk_indexed: how many messages of the current chunk were read,
    and how many its index lists. chunk_problem: why the chunk cannot be read, "" if it can.
    """

    report: FileReport
    wanted: Wanted
    connections: dict[int, Connection] = field(default_factory=dict)
    chunk_read: int = 0
    chunk_indexed: int = 0
    chunk_problem: str = ""

    def end_chunk(self) -> None:
        """Report the current chunk if it is broken, and reset the state for the next chunk."""
        if self.chunk_problem:
            self.report.damage(self.chunk_problem, self.chunk_indexed - self.chunk_read if self.chunk_indexed else None)
        self.chunk_read, self.chunk_indexed, self.chunk_problem = 0, 0, ""


def plain(name: str) -> str:
    """Return a topic or frame name with unprintable characters replaced, cut to `MAX_NAME` characters."""
    if len(name) <= MAX_NAME and name.isprintable():
        return name
    return "".join(c if c.isprintable() else "\ufffd" for c in name[:MAX_NAME])


def frame_name(frame_id: str) -> str:
    """Return a frame name as tf2 uses it, without the leading slash of some ROS 1 messages."""
    return plain(frame_id.lstrip("/"))


def type_name(name: str) -> str:
    """Return a message type in ROS 2 form, such as nav_msgs/msg/Odometry. Other text is returned as `plain` text."""
    match = _TYPE.fullmatch(name)
    return f"{match[1]}/msg/{match[2]}" if match else plain(name)


def make_connection(topic: str, type_: str, encoding: str, definition: str, language: str) -> Connection:
    """Return a connection with printable names. A definition in an unknown language ("") is dropped."""
    return Connection(plain(topic), type_name(type_), encoding, definition if language else "", language)

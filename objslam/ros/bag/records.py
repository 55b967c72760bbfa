"""The content of a bag file, independent of its format, and the report of unreadable parts."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

MAX_RECORD = 256 << 20  # The size limit of a record, chunk or message, packed or unpacked, bytes. The limit bounds memory.
LANGUAGES = {"ros2msg": "msg", "ros1msg": "msg", "ros2idl": "idl"}  # The language of a definition, by its name in bags.
MAX_NAME = 256  # The length limit of a topic or frame name, characters. The limit keeps printed texts readable.
_TYPE = re.compile(r"([A-Za-z]\w*)/(?:(?:msg|action|srv)/)?([A-Za-z]\w*)", re.ASCII)


@dataclass(frozen=True, slots=True)
class Connection:
    """The description of a topic in one file."""

    topic: str
    type: str  # The message type in ROS 2 form, package/msg/Name.
    encoding: str  # The encoding of messages: "ros1", "cdr", or another name from the file.
    definition: str = ""  # The text that defines the message type, empty if the file does not contain it.
    language: str = "msg"  # The language of the definition, "msg" or "idl".


Messages = Iterator[tuple[Connection, int, bytes]]  # Messages, each as connection, recording time (ns) and message bytes.
Wanted = Callable[[Connection], bool]  # A function that returns whether the caller wants the messages of a connection.


@dataclass
class FileReport:
    """The result of reading one file. of_folder: True if the report is about a folder instead. The report about a folder
    counts the missing messages: metadata.yaml counts them, but no file of the folder has them."""

    file: str
    messages: int = 0  # The number of messages read.
    lost: int = 0  # The number of messages known to be lost.
    expected: int | None = None  # The message count that the file states, or None if it states no count.
    complete: bool = True  # False if an unknown number of messages is lost.
    problems: list[str] = field(default_factory=list)  # One text per kind of damage.
    of_folder: bool = False

    def damage(self, problem: str, lost: int | None = None) -> None:
        """Add damage of the kind `problem`. lost: the number of messages lost by this damage, or None if it is unknown."""
        if problem not in self.problems:
            self.problems.append(problem)
        if lost is None:
            self.complete = False
        else:
            self.lost += lost

    def close(self) -> None:
        """Finish the report. If the file states a message count, update `lost` and `complete`.

        `lost` becomes at least the stated count minus the number of messages read. `complete` becomes True.
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

    connections: the connections by their number in the file. chunk_read: the number of messages read from the current
    chunk. chunk_indexed: the number of messages that the chunk's index lists. chunk_problem: the reason why the chunk
    cannot be read, or "" if it can be read.
    """

    report: FileReport
    wanted: Wanted
    connections: dict[int, Connection] = field(default_factory=dict)
    chunk_read: int = 0
    chunk_indexed: int = 0
    chunk_problem: str = ""

    def end_chunk(self) -> None:
        """Report the current chunk if it cannot be read, and reset the state for the next chunk."""
        if self.chunk_problem:
            self.report.damage(self.chunk_problem, self.chunk_indexed - self.chunk_read if self.chunk_indexed else None)
        self.chunk_read, self.chunk_indexed, self.chunk_problem = 0, 0, ""


def plain(name: str) -> str:
    """Return a topic or frame name, cut to `MAX_NAME` characters. Unprintable characters are replaced."""
    if len(name) <= MAX_NAME and name.isprintable():
        return name
    return "".join(c if c.isprintable() else "\ufffd" for c in name[:MAX_NAME])


def frame_name(frame_id: str) -> str:
    """Return a frame name as tf2 uses it, without the leading slash of some ROS 1 messages."""
    return plain(frame_id.lstrip("/"))


def type_name(name: str) -> str:
    """Return a message type in ROS 2 form, such as nav_msgs/msg/Odometry. Any other text is only cleaned by `plain`."""
    match = _TYPE.fullmatch(name)
    return f"{match[1]}/msg/{match[2]}" if match else plain(name)


def make_connection(topic: str, type_: str, encoding: str, definition: str, language: str) -> Connection:
    """Return a connection with printable names. A definition in an unknown language ("") is dropped."""
    return Connection(plain(topic), type_name(type_), encoding, definition if language else "", language)

"""Find the logs in the sources of a fleet, and the site, the robot and the day of each log."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256

from objslam.errors import ConfigError, LogError
from objslam.fleet.stores.open_store import open_source
from objslam.fleet.stores.store import FileState
from objslam.sources import SOURCES

DEFAULT_LAYOUT = "{site}/{log}"
"""The default of --layout. With it, the site of a log is the name of the folder that contains the log."""
NO_SITE = "all"
"""The name of the only site with --by none. With --by folder, it is the site of a log whose path names no folder."""
_LOG_MARKS = {mark for source in SOURCES for mark in source.marks}
"""The names of files and folders that mark a log. A folder that contains such a name is a log."""
_BAGS = (".bag", ".mcap", ".db3")
"""The endings of the file names of ROS bags. Each may be followed by .zstd or .zst."""
_BAG_FOLDER = "metadata.yaml"
"""The name of the file that rosbag2 writes into the folder of a recording. A folder with this file and bags is one log,
because all its bags belong to one recording."""


@dataclass(frozen=True, slots=True)
class LogPlace:
    """A log that was found. path: its path or URL. size: the size of all its files, bytes. fingerprint: a hash of the path
    of the log and of the name, the size and the stamp (`FileState`) of each file. site, robot, day: the names of its site,
    robot and day. The names of robot and day are empty if the layout does not give them."""

    path: str
    size: int
    fingerprint: str
    site: str
    robot: str
    day: str


class Layout:
    """A description of the folders above a log, such as "{site}/{robot}/{day}/{log}". Each {name} is a field, whose value is
    read from the path of a log."""

    def __init__(self, template: str, by: str) -> None:
        """template: the description. by: what gives a log its site. It is a field of the layout, `folder` for the name of
        the folder that contains the log, or `none` for one site for all logs.

        ConfigError for a wrong template or field.
        """
        parts = template.strip("/").split("/")
        hint = f"for example --layout {DEFAULT_LAYOUT}"
        try:
            self._parts = [re.compile(re.sub(r"\\\{(\w+)\\\}", r"(?P<\1>.+?)", re.escape(part))) for part in parts]
        except re.error as error:
            raise ConfigError(f"not a layout: {template!r}, {error}", hint=hint) from error
        fields = [name for part in self._parts for name in part.groupindex]
        if len(set(fields)) < len(fields) or not fields:
            raise ConfigError(f"a layout names each field once: {template!r}", hint=hint)
        if by not in (*fields, "folder", "none"):
            raise ConfigError(
                f"--by {by!r} is no field of the layout {template!r}", hint="name a field of it, folder or none"
            )
        self._template, self._by = template, by

    def fields(self, path: str) -> tuple[str, str, str]:
        """Return the names of the site, the robot and the day of a log. path: the path or URL of the log.

        If the path does not fit the layout and --by is folder or none, the names of robot and day are empty. ConfigError if
        the path does not fit the layout and --by is a field of the layout.
        """
        parts = [part for part in path.partition("://")[2 if "://" in path else 0].split("/") if part]
        tail = parts[-len(self._parts) :]
        found: dict[str, str] = {}
        for part, wanted in zip(tail[::-1], self._parts[::-1], strict=False):
            match = wanted.fullmatch(part)
            if match is None:
                break
            found |= match.groupdict()
        else:
            if len(tail) == len(self._parts):
                return self._site(found, parts), found.get("robot", ""), found.get("day", "")
        if self._by in ("folder", "none"):
            return self._site({}, parts), "", ""
        raise ConfigError(f"{path} does not fit the layout {self._template!r}", hint="change --layout, or --by folder")

    def _site(self, found: Mapping[str, str], parts: Sequence[str]) -> str:
        if self._by == "none":
            return NO_SITE
        if self._by == "folder":
            return parts[-2] if len(parts) > 1 else NO_SITE
        return found[self._by]


def find_logs(sources: Sequence[str], layout: Layout) -> list[LogPlace]:
    """Return the logs that the sources name, each log once, in the order of their paths. sources: paths, glob patterns and
    URLs.

    If a path is a folder but no log, its inner folders are searched. If no log is found there, the path itself counts as a
    log. The task of this log then says what is wrong. Files that a pattern names count only if they are bags. LogError if a
    source names nothing, ConfigError if a path does not fit the layout.
    """
    found: dict[str, LogPlace] = {}
    for source in sources:
        tree = open_source(source)
        paths = tree.expand(source)
        if not paths:
            raise LogError("nothing is there", where=source)
        for path in paths:
            files = tree.files(path)
            if "" in files and not _is_bag(path) and any(mark in source for mark in "*?["):
                continue
            for inner, own in _split(files):
                at = f"{path.rstrip('/')}/{inner}" if inner else path.rstrip("/")
                found.setdefault(at, _place(at, own, layout))
    return [found[path] for path in sorted(found)]


def _split(files: Mapping[str, FileState]) -> Iterator[tuple[str, dict[str, FileState]]]:
    """Yield the relative path of each log among files, with the files of the log by their names relative to the log.

    files: the files below one path, by their relative names. If no log is among them, all files together count as one log. A
    log inside another log is a part of the outer log.
    """
    names: dict[str, set[str]] = {}
    for name in files:
        folder, _, last = name.rpartition("/")
        names.setdefault(folder, set()).add(last)
        while folder:
            folder, _, last = folder.rpartition("/")
            names.setdefault(folder, set()).add(last)
    logs = {folder for folder, inside in names.items() if _is_log(inside)}
    logs |= {name for name in files if _is_bag(name)}
    top = [log for log in sorted(logs) if not any(above in logs for above in _above(log))]
    if not top:
        yield "", dict(files)
        return
    owners = {log: {} for log in top}  # type: dict[str, dict[str, FileState]]
    for name, state in files.items():
        owner = next((one for one in (name, *_above(name)) if one in owners), None)
        if owner is not None:
            owners[owner][name[len(owner) :].lstrip("/")] = state
    yield from owners.items()


def _above(name: str) -> Iterator[str]:
    while name:
        name = name.rpartition("/")[0]
        yield name


def _is_log(inside: set[str]) -> bool:
    return bool(inside & _LOG_MARKS) or (_BAG_FOLDER in inside and any(_is_bag(name) for name in inside))


def _is_bag(name: str) -> bool:
    return name.removesuffix(".zstd").removesuffix(".zst").endswith(_BAGS)


def _place(path: str, files: Mapping[str, FileState], layout: Layout) -> LogPlace:
    digest = sha256(path.encode())
    for name, state in sorted(files.items()):
        digest.update(f"\0{name}\0{state.size}\0{state.stamp}".encode())
    return LogPlace(path, sum(one.size for one in files.values()), digest.hexdigest(), *layout.fields(path))

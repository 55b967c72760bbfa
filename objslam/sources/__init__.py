"""Sources: whatever a robot recorded, read into a `Log`.

`SOURCES` is the table of the kinds of recordings, one file or folder each; messages that come live are in `live`. A new kind
is one more file and one more row. If it has options of its own, it declares them as `options` says, and `SourceOptions`
inherits them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from objslam.errors import ConfigError, LogError
from objslam.sources.mrclam import MrclamOptions
from objslam.sources.options import AnyOptions, names, unused
from objslam.sources.ros_bag.options import BagOptions
from objslam.sources.tum_rgbd import TumOptions

if TYPE_CHECKING:
    from objslam.core.diagnostics import Ledger
    from objslam.core.types import Log


@dataclass(frozen=True)
class SourceOptions(BagOptions, TumOptions, MrclamOptions, AnyOptions):
    """What a recording of any kind does not say itself: the options of all sources, the last class's first in `--help`."""


@dataclass(frozen=True)
class Source:
    """A kind of recording.

    Attributes:
        name: what `--format` calls it.
        looks_for: how to tell it, in words.
        detector: "module:function", where function(path) says whether a path is one; imported when it is first asked.
        reader: "module:function", where function(path, ledger) reads one, or function(path, ledger, options).
        options: the class of the options that it takes, which `SourceOptions` inherits; None: it takes none.
    """

    name: str
    looks_for: str
    detector: str
    reader: str
    options: type[Any] | None = None

    def detects(self, path: Path) -> bool:
        """Whether a path is a recording of this kind."""
        return bool(_function(self.detector)(path))

    def reads(self, path: Path, ledger: Ledger, options: SourceOptions) -> Log:
        """Read a recording of this kind; LogError where it cannot be read."""
        log: Log = _function(self.reader)(path, ledger, *((options,) if self.options is not None else ()))
        return log


def _function(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    found: Callable[..., Any] = getattr(import_module(f"objslam.{module}"), name)
    return found


SOURCES = (
    Source(
        "log",
        "camera.yaml or cameras/ with odometry.txt or localization.txt",
        "sources.log_folder:is_log_folder",
        "sources.log_folder:read_log_folder",
    ),
    Source(
        "mrclam",
        "Barcodes.dat and Robot<n>_Odometry.dat (or .dat.gz)",
        "sources.mrclam.reader:is_mrclam",
        "sources.mrclam.reader:read_mrclam",
        MrclamOptions,
    ),
    Source(
        "tum_numbered",
        "truth_cam_poses.txt and boxes/<number>*.txt",
        "sources.tum_rgbd.reader:is_numbered",
        "sources.tum_rgbd.reader:read_numbered",
        TumOptions,
    ),
    Source(
        "tum",
        "groundtruth.txt (or .gz) and rgb.txt, or boxes in <stamp>.txt in a folder or tar archive",
        "sources.tum_rgbd.reader:is_stamped",
        "sources.tum_rgbd.reader:read_stamped",
        TumOptions,
    ),
    Source(
        "journal",
        "journal.objslam, what a live session accepted",
        "sources.journal.file:is_journal",
        "sources.journal.file:read_journal",
    ),
    Source(
        "ros",
        "a ROS bag (.bag, .mcap, .db3, also .zstd), or a folder with one",
        "ros.bag.recording:is_bag",
        "sources.ros_bag.log:read_bag",
        BagOptions,
    ),
)
"""The kinds of recordings in the order in which they are looked for: the first that fits is taken."""


def read(path: Path, ledger: Ledger, options: SourceOptions | None = None) -> Log:
    """Read a recording of any kind that `SOURCES` lists.

    Args:
        path: what was recorded; its kind is guessed from what it holds unless the options name it.
        ledger: takes what was dropped, and a warning of each option that the kind does not take.
        options: what the recording does not say itself.
    Raises:
        LogError: when nothing fits or the recording cannot be read.
        ConfigError: for a format that does not exist.
    """
    options = options or SourceOptions()
    source = choose(path, options.format)
    for flag in unused(options, SourceOptions, names(source.options, AnyOptions)):
        ledger.warn(f"{path}: {flag} has no meaning for a {source.name} recording")
    return replace(source.reads(path, ledger, options), path=path.resolve())


def convert(source: Path, log: Path, ledger: Ledger, options: SourceOptions, *, overwrite: bool = False) -> None:
    """Read a recording of any kind and write it as a log folder, with the images and depth images that it brings.

    Images that a recording holds inside it are extracted right beside the log folder and then take their place in it: they
    are written once. Errors as in `read` and `log_folder.write_log_folder`.
    """
    from objslam.sources import log_folder

    kind = choose(source, options.format)
    log_folder.check_target(log, overwrite)
    with ExitStack() as stack:
        if "extract" in names(kind.options) and options.extract is None:
            options = replace(options, extract=stack.enter_context(log_folder.beside(log)))
        log_folder.write_log_folder(read(source, ledger, options), log, overwrite=overwrite)


def choose(path: Path, name: str | None = None) -> Source:
    """The kind of recording that a path holds, or the one with that name; errors as in `read`."""
    if name is not None:
        for source in SOURCES:
            if source.name == name:
                return source
        raise ConfigError(f"there is no format {name!r}", hint=f"known: {', '.join(source.name for source in SOURCES)}")
    try:
        path.stat()
        for source in SOURCES:
            if source.detects(path):
                return source
        from objslam.sources.log_folder import resembles_log

        if resembles_log(path):  # reading it says what is missing
            return choose(path, "log")
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise LogError(f"cannot be read: {getattr(error, 'strerror', None) or error}", where=str(path)) from error
    if (path / "objects.json").is_file() and (path / "summary.json").is_file():
        raise LogError("this is a result, not a log", where=str(path), hint="log_path in its summary.json names the log")
    looked_for = "; ".join(f"{source.name}: {source.looks_for}" for source in SOURCES)
    raise LogError("nothing here that objslam reads", where=str(path), hint=f"looked for {looked_for}")

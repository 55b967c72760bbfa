"""Sources: whatever a robot recorded, read into a `Log`.

One file a kind of recording. `SOURCES` is the table of them: a new kind is one more file and one more row.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path

from objslam.errors import ConfigError, LogError
from objslam.ledger import Ledger
from objslam.sources import folder, mrclam, ros, tum
from objslam.types import Log


@dataclass(frozen=True)
class SourceOptions:
    """What a recording does not say itself.

    format: the name of a source, None to guess it. robot: which one, where there are several. with_range: whether measured
    depths are used. anonymous: whether landmarks that tell who they are get one label. label: for boxes without a class.
    ROS bags: topics, base_frame, camera_info, rectified, extract and with_images are what `ros.BagOptions` says.
    """

    format: str | None = None
    robot: int | None = None
    with_range: bool = True
    anonymous: bool = False
    label: str | None = None
    topics: tuple[str, ...] = ()
    base_frame: str | None = None
    camera_info: Path | None = None
    rectified: bool | None = None
    extract: Path | None = None
    with_images: bool = True

    def of_bag(self) -> ros.BagOptions:
        """Those of the options that a ROS bag takes."""
        return ros.BagOptions(**{field.name: getattr(self, field.name) for field in fields(ros.BagOptions)})


@dataclass(frozen=True)
class Source:
    """A kind of recording: how to tell it, in words and as a function, how to read it, and which options it takes."""

    name: str
    looks_for: str
    detects: Callable[[Path], bool]
    reads: Callable[[Path, Ledger, SourceOptions], Log]
    takes: frozenset[str] = frozenset()


def _read_log(path: Path, ledger: Ledger, options: SourceOptions) -> Log:
    return folder.read_log_folder(path, ledger)


def _read_mrclam(path: Path, ledger: Ledger, options: SourceOptions) -> Log:
    with_range, anonymous = options.with_range, options.anonymous
    return mrclam.read_mrclam(path, options.robot, with_range=with_range, anonymous=anonymous, ledger=ledger)


def _read_tum_numbered(path: Path, ledger: Ledger, options: SourceOptions) -> Log:
    return tum.read_numbered(path, ledger, label=options.label or "object", with_range=options.with_range)


def _read_tum(path: Path, ledger: Ledger, options: SourceOptions) -> Log:
    return tum.read_stamped(path, ledger, label=options.label or "object", with_range=options.with_range)


def _read_ros(path: Path, ledger: Ledger, options: SourceOptions) -> Log:
    return ros.read_bag(path, ledger, options.of_bag())


def _is_journal(path: Path) -> bool:
    from objslam.live.journal import is_journal

    return is_journal(path)


def _read_journal(path: Path, ledger: Ledger, options: SourceOptions) -> Log:
    from objslam.live.journal import read_journal

    return read_journal(path, ledger)


SOURCES: tuple[Source, ...] = (
    Source("log", "camera.yaml or cameras/ with odometry.txt or localization.txt", folder.is_log_folder, _read_log),
    Source(
        "mrclam",
        "Barcodes.dat and Robot<n>_Odometry.dat (or .dat.gz)",
        mrclam.is_mrclam,
        _read_mrclam,
        frozenset({"robot", "with_range", "anonymous"}),
    ),
    Source(
        "tum_numbered",
        "truth_cam_poses.txt and boxes/<number>*.txt",
        tum.is_numbered,
        _read_tum_numbered,
        frozenset({"label", "with_range"}),
    ),
    Source(
        "tum",
        "groundtruth.txt (or .gz) and rgb.txt, or boxes in <stamp>.txt in a folder or tar archive",
        tum.is_stamped,
        _read_tum,
        frozenset({"label", "with_range"}),
    ),
    Source("journal", "journal.objslam, what a live session accepted", _is_journal, _read_journal),
    Source(
        "ros",
        "a ROS bag (.bag, .mcap, .db3, also .zstd), or a folder with one",
        ros.is_bag,
        _read_ros,
        frozenset(field.name for field in fields(ros.BagOptions)),
    ),
)


_FLAGS = {"topics": "--topic", "with_range": "--without-range"}
"""What the command line calls an option, where that is not its name here."""


def read(path: Path, ledger: Ledger, options: SourceOptions | None = None) -> Log:
    """Read a recording of any kind that `SOURCES` lists; the kind is guessed from what the path holds unless it is given.

    An option that the kind does not take is named in a warning. LogError where nothing fits or the recording cannot be read;
    ConfigError for a format that does not exist.
    """
    options = options or SourceOptions()
    source = choose(path, options.format)
    default = SourceOptions()
    for option in (field.name for field in fields(options) if field.name != "format"):
        if option not in source.takes and getattr(options, option) != getattr(default, option):
            flag = _FLAGS.get(option, f"--{option.replace('_', '-')}")
            ledger.warn(f"{path}: {flag} has no meaning for a {source.name} recording")
    return replace(source.reads(path, ledger, options), path=path.resolve())


def convert(source: Path, log: Path, ledger: Ledger, options: SourceOptions, *, overwrite: bool = False) -> None:
    """Read a recording of any kind and write it as a log folder, with the images and depth images that it brings.

    Images that a recording holds inside it are extracted right beside the log folder and then take their place in it: they
    are written once. Errors as in `read` and `folder.write_log_folder`.
    """
    takes = choose(source, options.format).takes
    folder.check_target(log, overwrite)
    with ExitStack() as stack:
        if "extract" in takes and options.extract is None:
            options = replace(options, extract=stack.enter_context(folder.beside(log)))
        folder.write_log_folder(read(source, ledger, options), log, overwrite=overwrite)


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
        if folder.resembles_log(path):  # reading it says what is missing
            return SOURCES[0]
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise LogError(f"cannot be read: {getattr(error, 'strerror', None) or error}", where=str(path)) from error
    if (path / "objects.json").is_file() and (path / "summary.json").is_file():
        raise LogError("this is a result, not a log", where=str(path), hint="log_path in its summary.json names the log")
    looked_for = "; ".join(f"{source.name}: {source.looks_for}" for source in SOURCES)
    raise LogError("nothing here that objslam reads", where=str(path), hint=f"looked for {looked_for}")

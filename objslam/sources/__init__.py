"""Read recordings of any kind into a `Log`.

`SOURCES` lists the kinds of recordings. Each entry names the functions that detect and read its kind.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from objslam.errors import ConfigError, LogError
from objslam.sources.mrclam import MrclamOptions
from objslam.sources.no_camera import NoCamera
from objslam.sources.options import AnyOptions, names, unused
from objslam.sources.ros_bag.options import BagOptions
from objslam.sources.tum_rgbd import TumOptions

if TYPE_CHECKING:
    from objslam.core.diagnostics import Ledger
    from objslam.core.types import Log


@dataclass(frozen=True)
class SourceOptions(BagOptions, TumOptions, MrclamOptions, AnyOptions):
    """The options of all kinds of recordings. `--help` shows the options of the last base class first."""


@dataclass(frozen=True)
class Source:
    """A kind of recording.

    name: the value of `--format` that selects this kind. looks_for: the files that identify this kind, for error messages.
    detector: "module:function" of a function that takes a path and returns whether the path is of this kind.
    reader: "module:function" of a function that takes (path, ledger), or (path, ledger, options) if the kind has options.
    options: the class of the kind's options, a base class of `SourceOptions`. None if the kind has no options.
    marks: names of files and folders. A fleet takes a folder with any of them for a recording of this kind. The tuple is
    empty for a kind that is a single file.
    """

    name: str
    looks_for: str
    detector: str
    reader: str
    options: type[Any] | None = None
    marks: tuple[str, ...] = ()

    def detects(self, path: Path) -> bool:
        """Return whether a path is a recording of this kind."""
        return resolve_name(f"objslam.{self.detector}")(path)

    def reads(self, path: Path, ledger: Ledger, options: SourceOptions) -> Log:
        """Return the `Log` of a recording of this kind. Raises LogError if the recording cannot be read."""
        more = () if self.options is None else (options,)
        return resolve_name(f"objslam.{self.reader}")(path, ledger, *more)


SOURCES = (
    Source(
        "log",
        "camera.yaml or cameras/ with odometry.txt or localization.txt",
        "sources.log_folder:is_log_folder",
        "sources.log_folder:read_log_folder",
        marks=("camera.yaml", "cameras", "odometry.txt", "localization.txt"),
    ),
    Source(
        "mrclam",
        "Barcodes.dat and Robot<n>_Odometry.dat (or .dat.gz)",
        "sources.mrclam.reader:is_mrclam",
        "sources.mrclam.reader:read_mrclam",
        MrclamOptions,
        marks=("Barcodes.dat",),
    ),
    Source(
        "tum_numbered",
        "truth_cam_poses.txt and boxes/<number>*.txt",
        "sources.tum_rgbd.reader:is_numbered",
        "sources.tum_rgbd.reader:read_numbered",
        TumOptions,
        marks=("truth_cam_poses.txt",),
    ),
    Source(
        "tum",
        "groundtruth.txt (or .gz), with rgb.txt or with box files <stamp>.txt in a folder or tar archive",
        "sources.tum_rgbd.reader:is_stamped",
        "sources.tum_rgbd.reader:read_stamped",
        TumOptions,
        marks=("groundtruth.txt", "groundtruth.txt.gz"),
    ),
    Source(
        "journal",
        "journal.objslam, the journal of a live session",
        "sources.journal.segments:is_journal",
        "sources.journal.log:read_journal",
        marks=("journal.objslam",),
    ),
    Source(
        "ros",
        "a ROS bag (.bag, .mcap, .db3, also .zstd), or a folder with one",
        "ros.bag.recording:is_bag",
        "sources.ros_bag.log:read_bag",
        BagOptions,
    ),
)
"""The kinds of recordings. `choose` tries them in this order and takes the first that fits."""


def read(path: Path, ledger: Ledger, options: SourceOptions | None = None) -> Log:
    """Return the log of a recording of any kind in `SOURCES`.

    The content of the recording determines its kind, unless `options.format` names the kind. The ledger counts dropped data.
    The ledger also gets a warning for each option that is set but has no meaning for this kind.
    Raises LogError if no kind fits or the recording cannot be read, and ConfigError if `options.format` is unknown.
    """
    options = options or SourceOptions()
    source = choose(path, options.format)
    for flag in unused(options, SourceOptions, names(source.options, AnyOptions)):
        ledger.warn(f"{path}: {flag} has no meaning for a {source.name} recording")
    log = replace(source.reads(path, ledger, options), path=path.resolve())
    if options.begin is not None or options.end is not None:
        from objslam.frontend.log_part import part_of_log

        log = part_of_log(log, options.begin, options.end)
    if options.class_names is None:
        return log
    from objslam.frontend.class_names import with_names

    return with_names(log, options.class_names, ledger)


def convert(source: Path, log: Path, ledger: Ledger, options: SourceOptions, *, overwrite: bool = False) -> None:
    """Read a recording of any kind and write it as a log folder, including colour and depth images.

    source: the recording. log: the log folder. Images inside a bag are extracted into a temporary folder beside the log
    folder, unless `options.extract` names another folder. The images are then linked into the log folder, so that their
    bytes are written only once. If the recording has neither images nor boxes, the function warns. It then writes only the
    robot's path, and the cameras. If no camera is known, the poses of the optical frames in tf are written.
    Raises the errors of `read` and `log_folder.write_log_folder`.
    """
    from objslam.sources import log_folder

    kind = choose(source, options.format)
    log_folder.check_target(log, overwrite)
    with ExitStack() as stack:
        if "extract" in names(kind.options) and options.extract is None:
            options = replace(options, extract=stack.enter_context(log_folder.beside(log)))
        try:
            log_folder.write_log_folder(read(source, ledger, options), log, overwrite=overwrite)
        except NoCamera as found:
            written = log_folder.write_path(found, log, overwrite=overwrite)
            lacks = "a detections.jsonl" if found.cameras else "a camera.yaml and a detections.jsonl"
            ledger.warn(f"{found.where}: the recording has no images and no detections; add {lacks} to {', '.join(written)}")


def choose(path: Path, name: str | None = None) -> Source:
    """Return the kind called `name`. If `name` is None, return the kind of the recording at `path`.

    Raises ConfigError if no kind has this name, and LogError if no kind fits the path or the path cannot be read.
    """
    if name is not None:
        named = {source.name: source for source in SOURCES}
        if name not in named:
            raise ConfigError(f"there is no format {name!r}", hint=f"choose {', '.join(named)}")
        return named[name]
    try:
        path.stat()
        for source in SOURCES:
            if source.detects(path):
                return source
        from objslam.sources.log_folder import resembles_log

        if resembles_log(path):  # The reader of log folders then reports the missing file.
            return choose(path, "log")
    except (OSError, ValueError) as error:  # A NUL in the path raises ValueError.
        raise LogError(f"cannot be read: {getattr(error, 'strerror', None) or error}", where=str(path)) from error
    if (path / "objects.json").is_file() and (path / "summary.json").is_file():
        raise LogError("this is a result, not a log", where=str(path), hint="use its log instead: log_path in summary.json")
    from objslam.sources.unknown import unknown_recording

    looked_for = "; ".join(f"{source.name}: {source.looks_for}" for source in SOURCES)
    raise unknown_recording(path, lambda inner: any(source.detects(inner) for source in SOURCES), looked_for)

"""The functions that read a recording (`read`) and map it (`run`)."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from objslam.api.inputs import Log
from objslam.api.result import Result
from objslam.config import Settings, load_settings
from objslam.config.presets import find_config
from objslam.config.settings import change_settings
from objslam.core import object_map, types
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.errors import ConfigError
from objslam.io.results.object_map import ObjectMap
from objslam.io.results.read import load_up
from objslam.mapping.progress import Progress
from objslam.sources import SourceOptions
from objslam.sources import read as read_recording

if TYPE_CHECKING:
    from objslam.mapping.localization import PriorMap

Given = Settings | Mapping[str, Any] | str | PathLike[str] | None
"""The settings that a user gives: `Settings`, a mapping of changes to the defaults, the name of ready settings, a YAML file,
or None for the defaults."""

_LOG = logging.getLogger("objslam")


def read(path: str | PathLike[str], **options: Any) -> Log:
    """Return the log of a recording. path: a log folder, a ROS bag, or another recording that `objslam info` knows.

    options: the options for this kind of recording. Their names are those of the flags: `robot=1` is --robot 1, and
    `label="cup"` is --label cup. `objslam.sources.SourceOptions` lists them. Dropped data are logged as warnings. They are
    also counted in the log's `reading`. LogError if the recording cannot be read, ConfigError for a wrong option.
    """
    known = [field.name for field in fields(SourceOptions)]
    if unknown := [name for name in options if name not in known]:
        raise ConfigError(f"there is no option {unknown[0]!r} of a recording", hint=f"the options are {', '.join(known)}")
    ledger = Ledger()
    found = read_recording(Path(path), ledger, SourceOptions(**options))
    _tell(ledger.lines())
    return Log(**{**vars(found), "reading": ledger})


def run(
    log: types.Log,
    settings: Given = None,
    *,
    detector: str | PathLike[str] | None = None,
    embed: str | PathLike[str] | None = None,
    map: Result | ObjectMap | str | PathLike[str] | None = None,
    progress: Progress = lambda stage, done, total: None,
    **changes: Any,
) -> Result:
    """Map the objects of a log, and return the result.

    Args:
        log: what `read` or `Log.from_arrays` returned. It is not changed.
        settings: a `Settings`, a mapping of changes to the defaults such as {"mode": "joint", "rays.pixel_sigma": 2}, a
            YAML file, or the name of ready settings such as "odometry".
        detector: the path of an ONNX model that finds boxes in the log's images. These boxes replace the boxes of the
            log.
        embed: the path of an ONNX image encoder. It makes an appearance vector of each box from the log's images.
        map: the map of another day, as a `Result`, an `ObjectMap`, or the path of its file or result folder. If the
            drive is found in this map, the result is in the frame of the map, and the objects of the map count as priors.
            `Result.localised` says whether the drive was found.
        progress: a function of the stage's name, the steps done, and the total number of steps (0 if unknown).
        changes: more changes of settings, such as `mode="joint"` or `rays={"pixel_sigma": 2}`. They override `settings`.
    Raises:
        LogError: no frame lies on the path. SolveError: no box gives a usable ray. ConfigError: a setting is wrong.
        DetectorError: the model cannot be used. OutputError: `map` cannot be read. TypeError: `log` is not a log.
    """
    if not isinstance(log, types.Log):
        raise TypeError(f"run needs a log, as `objslam.read(path)` returns it, got {type(log).__name__}")
    chosen = settings_of(settings, changes)
    ledger, told = Ledger(), []
    if log.reading is not None:
        ledger.add(log.reading)
        told = ledger.lines()
    model, encoder = (None if given is None else Path(given) for given in (detector, embed))
    mapped, log = map_log(log, chosen, ledger, model, progress, None if map is None else prior_map(map), encoder)
    _tell(line for line in ledger.lines() if line not in told)
    return Result.of(mapped, log, detected=model is not None or encoder is not None)


def prior_map(given: Result | ObjectMap | str | PathLike[str]) -> PriorMap:
    """Return the map of another day. given: a `Result`, an `ObjectMap`, or the path of a file or a result folder.
    OutputError if the map cannot be read."""
    from objslam.mapping.localization import PriorMap

    if isinstance(given, Result):
        return PriorMap("the given result", given.objects, given.summary.get("up", "z"))
    if isinstance(given, object_map.ObjectMap):
        return PriorMap("the given map", given)
    return PriorMap(str(given), ObjectMap.load(given), load_up(Path(given)))


def map_log(
    log: types.Log,
    settings: Settings,
    ledger: Ledger,
    detector: Path | None,
    progress: Progress,
    known: PriorMap | None = None,
    encoder: Path | None = None,
) -> tuple[RunResult, types.Log]:
    """Map a log. Return the result of the run, and the log with the boxes and vectors that were used.

    detector: the path of a detection model, whose boxes replace the boxes of the log, or None. encoder: the path of an image
    encoder, which gives each box its appearance vector, or None. known: the map of another day, in which the drive is
    searched for, or None.
    """
    from objslam.mapping import pipeline

    looks = None
    if encoder is not None:
        from objslam.detection import embed_log, load_encoder

        looks = load_encoder(encoder, settings)  # A wrong model fails before the detector runs.
    if detector is not None:
        log = find_boxes(log, detector, settings, ledger, progress)
    if looks is not None:
        log = embed_log(log, looks, ledger, progress)
    return pipeline.run(log, settings, ledger, progress, known), log


def find_boxes(log: types.Log, detector: Path, settings: Settings, ledger: Ledger, progress: Progress) -> types.Log:
    """Return the log with the boxes that a detector finds in its images. Boxes from an earlier run are read from a cache."""
    from objslam.detection import default_cache, detect_log, load_detector

    network = load_detector(detector, settings.detector)
    return detect_log(log, network, settings, ledger, cache=default_cache(), progress=progress)


def settings_of(given: Given, changes: Mapping[str, Any]) -> Settings:
    """Return the settings that a user gives, with changes. ConfigError names a wrong key or value."""
    if isinstance(given, Mapping):
        return change_settings(change_settings(Settings(), given), changes)
    base = given if isinstance(given, Settings) else load_settings(None if given is None else find_config(Path(given)))
    return change_settings(base, changes)


def _tell(lines: Any) -> None:
    for line in lines:
        _LOG.warning("%s", line)

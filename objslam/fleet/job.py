"""Make the job that the tasks of all logs of a fleet share. It has the user's settings and the files that the settings
name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from objslam.config import is_file
from objslam.fleet.keys import OPTION_FILES, file_content, hash_settings, key_of
from objslam.fleet.stores.open_store import is_remote, open_store
from objslam.fleet.tasks.map_task import Job

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.sources import SourceOptions

_INPUTS = "inputs"
"""The name of the folder in a remote store for the files that the settings name."""


def make_job(store: str, settings: Settings, options: SourceOptions, detector: Path | None, *, report: bool) -> Job:
    """Return the job of a fleet. If the store is remote, copy the files that settings and options name into it. Workers read
    these copies.

    The digest of the job depends on the content of the files, and not on their paths. store: the path or URL of the output.
    detector: the path of a model file. report: whether each log gets a report.html. ConfigError if a file cannot be read,
    StoreError if the store cannot be read or written.
    """
    files: dict[str, Path] = {}
    if settings.calibration.file is not None:
        files["calibration.file"] = Path(settings.calibration.file)
    names = settings.detector.names
    if isinstance(names, str):
        beside = [] if detector is None else [detector.parent / names]
        found = next((file for file in (Path(names), *beside) if is_file(file)), None)
        if found is not None:
            files["detector.names"] = found
    if detector is not None:
        files["detector"] = detector
    for name in OPTION_FILES:
        said = getattr(options, name, None)
        if said is not None and is_file(Path(said)):
            files[name] = Path(said)
    content = {key: file_content(file) for key, file in files.items()}
    url = store if is_remote(store) else open_store(store).url
    placed = tuple((key, _placed(url, file, content[key])) for key, file in files.items())
    digest = key_of(hash_settings(settings, options, content), "report" if report else "")
    return Job(url, settings, options, digest, placed, report)


def _placed(store: str, file: Path, content: bytes) -> str:
    """Return the path at which workers find a file. If the store is remote, write the file into it, and return its name
    there."""
    if not is_remote(store):
        return str(file.resolve())
    name = f"{_INPUTS}/{key_of(content.hex())}/{file.name}"
    open_store(store).write(name, content)
    return name

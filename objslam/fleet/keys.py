"""The keys of a fleet. A key is a hash of all that a result depends on, so a second run does only what is missing or
changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from objslam import __version__
from objslam.config.settings import change_settings
from objslam.errors import ConfigError

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.sources import SourceOptions

OPTION_FILES = ("class_names", "camera_info")
"""The names of those options of a source whose value may be the path of a file."""
_LETTERS = 32
"""The number of hexadecimal digits of a key. With 32 digits, two contents never have the same key by chance. A larger number
makes longer names."""
_BLOCK = 1 << 20  # The number of bytes in one read of a file. A larger number needs more memory.


def hash_log(path: Path) -> str:
    """Return the hash of a log. It covers the relative names and the bytes of all its files. OSError if a file cannot be
    read."""
    digest = sha256()
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for file in files:
        digest.update(f"\0{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0".encode())
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def hash_settings(settings: Settings, options: SourceOptions, files: Mapping[str, bytes]) -> str:
    """Return the hash of everything that a result depends on, except the log: settings, source options, version and `files`.

    files: the content of each file by key. If a setting names the file, the key is the dotted key of this setting. If an
    option names the file, the key is the name of this option. The key of the model is "detector". The path of a file does
    not change the hash.
    """
    values = change_settings(settings, dict.fromkeys((key for key in files if "." in key), "a file")).model_dump(mode="json")
    said: dict[str, Any] = {"version": __version__, "settings": values}
    said["options"] = {
        name: value for name, value in asdict(options).items() if value not in (None, ()) and name not in files
    }
    said["files"] = {name: sha256(content).hexdigest() for name, content in files.items()}
    return key_of(json.dumps(said, sort_keys=True, default=str))


def key_of(*parts: str) -> str:
    """Return the key of several texts. It is the first `_LETTERS` digits of the hash of the texts in the given order."""
    return sha256("\0".join(parts).encode()).hexdigest()[:_LETTERS]


def file_content(file: Path) -> bytes:
    """Return the content of a file that the settings name. ConfigError if it cannot be read."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror or error}", where=str(file)) from error

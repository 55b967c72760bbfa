"""The ready settings of the package. `--config NAME` takes one by its name."""

import os
from pathlib import Path

from objslam.config.settings import is_file
from objslam.errors import ConfigError

_FOLDER = Path(__file__).parent / "preset_files"  # In the sources it is a link to configs/ at the top.


def presets() -> dict[str, Path]:
    """Return the file of each ready setting by its name."""
    return {file.stem: file for file in sorted(_FOLDER.glob("*.yaml"))}


def find_config(given: Path) -> Path:
    """Return the settings file that the user means: a file, or the name of ready settings. ConfigError if it is neither."""
    known = presets()
    if str(given) in known and not is_file(given):
        return known[str(given)]
    if os.path.exists(given):  # noqa: PTH110 - Path.exists raises OSError for names that are too long
        return given
    raise ConfigError("no such file", where=str(given), hint=f"ready settings: {', '.join(known)}")

"""The ready settings of the package. `--config NAME` uses ready settings by their name."""

import os
from pathlib import Path

from objslam.config.settings import is_file
from objslam.errors import ConfigError

_FOLDER = Path(__file__).parent / "preset_files"  # In the repository, this folder is a link to configs/.


def presets() -> dict[str, Path]:
    """Return the path of each file of ready settings, by the name of the settings."""
    return {file.stem: file for file in sorted(_FOLDER.glob("*.yaml"))}


def find_config(given: Path) -> Path:
    """Return the path of the settings file that the user means. given: the path of a file, or the name of ready settings.
    ConfigError if there is neither such a file nor such a name."""
    known = presets()
    if str(given) in known and not is_file(given):
        return known[str(given)]
    if os.path.exists(given):  # noqa: PTH110 - Path.exists raises OSError for names that are too long
        return given
    raise ConfigError("no such file", where=str(given), hint=f"ready settings: {', '.join(known)}")

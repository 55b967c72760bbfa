"""objslam config: look at the settings."""

from __future__ import annotations

from objslam.cli.console import say
from objslam.cli.options import Config, Set


def config_dump(config: Config = None, set_: Set = None) -> None:
    """Print every setting as YAML: the defaults, changed by --config and --set."""
    from objslam.config import dump_settings, load_settings

    say(dump_settings(load_settings(config, tuple(set_ or ()))), end="")

"""The command `objslam config`, which prints the settings."""

from objslam.cli.console import put
from objslam.cli.options import Config, Set, settings_of


def config_dump(config: Config = None, set_: Set = None) -> None:
    """Print all settings as YAML. They include the changes by --config and --set."""
    from objslam.config import dump_settings

    put(dump_settings(settings_of(None, config, set_)))

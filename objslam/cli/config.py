"""The command `objslam config dump`, which prints the settings."""

import typer

from objslam.cli.console import put
from objslam.cli.options import Config, Set, settings_of

config_app = typer.Typer(no_args_is_help=True, help="Print the settings.")


@config_app.command("dump")
def config_dump(config: Config = None, set_: Set = None) -> None:
    """Print all settings as YAML. They include the changes by --config and --set."""
    from objslam.config import dump_settings

    put(dump_settings(settings_of(None, config, set_)))

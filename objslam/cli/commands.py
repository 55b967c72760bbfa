"""The table of the commands, and the application that they make."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Final

import typer

COMMANDS: Final = {
    "run": "run:run",
    "live": "live_command.command:live",
    "calibrate": "calibrate:calibrate",
    "eval": "evaluate:evaluate_result",
    "explain": "explain:explain",
    "report": "report:report_result",
    "register": "maps:register_results",
    "merge": "maps:merge_results",
    "diff": "maps:diff_results",
    "fleet": "fleet:fleet",
    "view": "view:view",
    "demo": "demo:demo",
    "convert": "convert:convert",
    "info": "info:info",
    "doctor": "doctor:doctor",
    "detect": "detect:detect",
    "export": "export:export",
    "config": "config:config_app",
    "journal": "journal:journal_app",
}
"""The commands in the order of --help. The value is "file:function", with a file in this folder. The function of a group of
commands is an application of typer."""


def build_app(words: list[str] | None = None) -> typer.Typer:
    """Return the application. If the words of the command line begin with a command, the application has only this command.

    A process runs only one command. The other commands, with their options, would take about 3 % of the CPU time of a small
    run. If the words do not begin with a command, as with --help, the application has all commands.
    """
    words = [] if words is None else words[words[:1] == ["--debug"] :]
    only = words[0] if words and words[0] in COMMANDS else None
    app = typer.Typer(
        name="objslam",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        help="Build a 3D map of objects from the log of a robot. Poses and detector boxes become positions with "
        "covariances.",
    )
    app.callback()(_options)
    for name in COMMANDS if only is None else (only,):
        file, _, function = COMMANDS[name].partition(":")
        command = getattr(import_module(f"objslam.cli.{file}"), function)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name=name)(command)
    return app


def _version(asked: bool) -> None:
    if asked:
        from objslam import __version__
        from objslam.cli.console import say

        say(f"objslam {__version__}")
        raise typer.Exit


def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    pass

"""Define the command line, with one file per command. Heavy imports are inside the commands, so that --help is fast."""

import atexit
import gc
import os
import sys
from typing import Annotated, NoReturn

import typer

from objslam.cli.calibrate import calibrate
from objslam.cli.config import config_dump
from objslam.cli.console import say
from objslam.cli.convert import convert
from objslam.cli.demo import demo
from objslam.cli.detect import detect
from objslam.cli.doctor import doctor
from objslam.cli.evaluate import evaluate_result
from objslam.cli.explain import explain
from objslam.cli.export import export
from objslam.cli.fleet import fleet
from objslam.cli.info import info
from objslam.cli.journal import journal_app
from objslam.cli.live_command.command import live
from objslam.cli.maps import diff_results, merge_results, register_results
from objslam.cli.report import report_result
from objslam.cli.run import run
from objslam.cli.view import view
from objslam.errors import ObjslamError, is_out_of_memory, one_line

_YOUNG = 50_000
"""The number of new objects after which Python searches them for garbage in cycles. The imports of a run make 140,000
objects that stay. With Python's own number, 700, the searches among them take 0.1 s of CPU. A larger number leaves garbage
in memory for longer."""

app = typer.Typer(
    name="objslam",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Build a 3D map of objects from the log of a robot. Poses and detector boxes become positions with covariances.",
)
app.command()(run)
app.command()(live)
app.command()(calibrate)
app.command(name="eval")(evaluate_result)
app.command()(explain)
app.command(name="report")(report_result)
app.command(name="register")(register_results)
app.command(name="merge")(merge_results)
app.command(name="diff")(diff_results)
app.command()(fleet)
app.command()(view)
app.command()(demo)
app.command()(convert)
app.command()(info)
app.command()(doctor)
app.command()(detect)
app.command()(export)
config_app = typer.Typer(no_args_is_help=True, help="Print the settings.")
config_app.command("dump")(config_dump)
app.add_typer(config_app, name="config")
app.add_typer(journal_app, name="journal")


_MEANT = {"--mount": "the pose of a camera: --camera-info FILE with base_T_camera in it"}
"""Options that newcomers try, and what does the same."""


def _version(asked: bool) -> None:
    if asked:
        from objslam import __version__

        say(f"objslam {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    pass


def main() -> NoReturn:
    """Run a command. Exit codes: 0 success, 1 failure, 2 usage error, 3 the drive is not in the map of --map, 130 Ctrl-C. An
    error is printed as one line on stderr, or with --debug as a traceback."""
    gc.set_threshold(_YOUNG)
    gc.freeze()  # No search goes through the imports of the commands again.
    atexit.register(gc.freeze)  # At its exit, Python would search all objects once more, which takes 0.08 s after a run.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # Damaged images are counted, and OpenCV need not print them.
    debug = "--debug" in sys.argv
    if sys.argv[1:2] == ["help"]:  # `objslam help run` is what many tools take.
        sys.argv[1:] = [*sys.argv[2:], "--help"]
    for word in sys.argv[2:]:
        if (flag := word.partition("=")[0]) in _MEANT:
            say(f"objslam: there is no {flag}. To give {_MEANT[flag]}", stderr=True)
            sys.exit(2)
    try:
        app()
    except ObjslamError as error:
        if debug:
            raise
        say(f"objslam: {error}", stderr=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        say("objslam: interrupted", stderr=True)
        sys.exit(130)
    except Exception as error:  # Hides the traceback of an internal error from the user.
        if debug:
            raise
        if is_out_of_memory(error):
            say("objslam: out of memory", stderr=True)
            sys.exit(1)
        if isinstance(error, OSError) and error.filename is not None:  # For example, a folder without permission.
            say(f"objslam: {one_line(error.filename)}: {error.strerror}", stderr=True)
            sys.exit(1)
        said = f"{type(error).__name__}: {one_line(error)}"
        say(f"objslam: internal error, {said} (please report it with the traceback from objslam --debug)", stderr=True)
        sys.exit(1)
    sys.exit(0)

"""The command line, with one file per command. Heavy modules are imported inside the commands, so that --help is fast."""

import atexit
import gc
import os
import sys
from typing import NoReturn

_YOUNG = 400_000
"""The number of new Python objects after which Python searches for garbage among them. A larger number leaves garbage in
memory for longer. A run of a small log makes 223,000 objects that stay, most of them in imports. One search of 200,000
objects took 0.11 s, a tenth of the CPU time of such a run, and found only 6,000 objects to free."""

_BLAS_THREADS = "1"
"""The number of threads of OpenBLAS, unless the user sets another. OpenBLAS multiplies the matrices of numpy and scipy. The
matrices of a map are small. More threads wait for each other in loops that keep the cores busy. On two cores, the log of 30
minutes of a real robot took 8.1 s with two threads, and 5.2 s with one."""

_MEANT = {"--mount": "the pose of a camera: --camera-info FILE with base_T_camera in it"}
"""The options that newcomers try but that do not exist, each with an option that does the same."""


def main() -> NoReturn:
    """Run a command. Exit codes: 0 success, 1 failure, 2 usage error, 3 the drive is not in the map of --map, 130 Ctrl-C. An
    error is printed as one line on stderr, or with --debug as a traceback."""
    gc.set_threshold(_YOUNG)  # Before the imports, because they make most of the objects.
    from objslam.cli.commands import build_app
    from objslam.cli.console import say
    from objslam.errors import ObjslamError, is_out_of_memory, one_line

    atexit.register(gc.freeze)  # At its exit, Python would search all objects once more, which takes 0.08 s after a run.
    if "OMP_NUM_THREADS" not in os.environ:  # This variable also sets the threads of OpenBLAS.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", _BLAS_THREADS)  # Before numpy is imported, which starts the threads.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # Damaged images are counted, so OpenCV need not print them.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")  # Pydantic would search all installed packages for plugins.
    debug = "--debug" in sys.argv
    if sys.argv[1:2] == ["help"]:  # `objslam help COMMAND` does the same as `objslam COMMAND --help`.
        sys.argv[1:] = [*sys.argv[2:], "--help"]
    for word in sys.argv[2:]:
        if (flag := word.partition("=")[0]) in _MEANT:
            say(f"objslam: there is no {flag}. To give {_MEANT[flag]}", stderr=True)
            sys.exit(2)
    try:
        build_app(sys.argv[1:])()
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

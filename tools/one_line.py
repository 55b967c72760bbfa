"""The end of a tool that reads files of a user. An error that the user can correct is one line, as in `objslam`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from objslam.errors import ObjslamError


def end_with(main: Callable[[], None]) -> NoReturn:
    """Run `main` and end the program. An ObjslamError becomes one line on stderr and its exit code."""
    try:
        main()
    except ObjslamError as error:
        print(f"{Path(sys.argv[0]).name}: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    sys.exit(0)

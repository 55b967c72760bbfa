"""Processes that tests start."""

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def running(command: Sequence[str | Path], **options: Any) -> Iterator[subprocess.Popen]:
    """Start a process. At the end it is killed if it still runs, so that a test which fails leaves nothing behind."""
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        finally:
            process.kill()

"""Estimate shared errors in a separate process, because GTSAM stops all other threads of its process while it solves."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.arrays import Floats
    from objslam.core.calibration import Calibration
    from objslam.core.types import Association
    from objslam.frontend.shared_errors import SharedErrors

_PATIENT = 600.0
"""The longest time, s, that a calibration may take. A larger value waits longer for a process that hangs."""
_NICE = 10
"""The niceness of the process, added to the session's (`os.nice`). A larger number leaves more CPU time to the session."""
_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Request:
    """The input of a calibration. The solve starts at the values theta (P,) of the errors and at the poses map_T_camera.

    errors: gives keyframes and rays for any values of the errors. association: of the rays. map_T_camera: (K, 4, 4).
    """

    errors: SharedErrors
    theta: Floats
    association: Association
    map_T_camera: Floats
    settings: Settings

    def solve(self) -> Calibration | None:
        """Return the shared errors that fit best, None if they cannot be estimated. Raises SolveError if the solve fails."""
        from objslam.core.diagnostics import Ledger
        from objslam.graph.batch_solver import solve_joint

        e = self.errors
        found = solve_joint(
            e.keyframes,
            e.rays,
            self.association,
            self.settings,
            Ledger(),
            start=self.map_T_camera,
            errors=e,
            theta=self.theta,
        )
        return found.calibration


class Worker:
    """A process that solves one request."""

    def __init__(self, request: Request) -> None:
        """Start the process."""
        self._answer = b""
        self._process: subprocess.Popen[bytes] | None = None
        package = str(Path(__file__).parents[3])
        paths = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
        with suppress(OSError):  # Then `result` returns None.
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **_THREADS, "PYTHONPATH": paths},
                start_new_session=True,  # Ctrl+C ends the session, and the session ends this process.
            )
        self._thread = threading.Thread(
            target=self._run, args=(pickle.dumps(request),), name="objslam calibration", daemon=True
        )
        self._thread.start()

    @property
    def done(self) -> bool:
        """Whether `result` returns at once."""
        return not self._thread.is_alive()

    def result(self) -> Calibration | None:
        """Wait for the process, and return its calibration. None if the errors cannot be estimated or the process failed."""
        self._thread.join()
        if not self._answer:
            return None
        found: Calibration | None = pickle.loads(self._answer)  # noqa: S301 - this program wrote it
        return found

    def close(self) -> None:
        """End the process without waiting for its answer."""
        if self._process is not None:
            self._process.kill()
        self._thread.join()

    def _run(self, request: bytes) -> None:
        if self._process is None:
            return
        try:
            answer, _ = self._process.communicate(request, timeout=_PATIENT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            return
        if self._process.returncode == 0:
            self._answer = answer


def main() -> None:
    """Read a request from stdin, and write its calibration to stdout."""
    os.nice(_NICE)
    request: Request = pickle.load(sys.stdin.buffer)  # noqa: S301 - this program wrote it
    answer = pickle.dumps(request.solve())
    sys.stdout.buffer.write(answer)


if __name__ == "__main__":
    main()

"""What a process beside the session needs to estimate the shared errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.arrays import Floats
    from objslam.core.calibration import Calibration
    from objslam.core.noise import NoiseFactors
    from objslam.core.types import Association
    from objslam.frontend.shared_errors import SharedErrors


@dataclass(frozen=True)
class CalibrationRequest:
    """The input of a calibration. The solve starts at the values theta (P,) of the errors and at the poses map_T_camera.

    errors: gives keyframes and rays for any values of the errors. association: the object of each ray. map_T_camera: (K, 4,
    4).
    """

    errors: SharedErrors
    theta: Floats
    association: Association
    map_T_camera: Floats
    settings: Settings

    def solve(self) -> tuple[Calibration, NoiseFactors] | None:
        """Return the shared errors and the noise that fit best, or None if they cannot be estimated. Raises SolveError if
        the solve fails."""
        from objslam.core.diagnostics import Ledger
        from objslam.core.noise import NOMINAL
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
        return None if found.calibration is None else (found.calibration, found.noise or NOMINAL)

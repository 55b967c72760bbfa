"""What the stages of a run know about its log: the log itself, the settings, and the findings so far."""

from dataclasses import dataclass, replace
from typing import Self

from objslam.config import Settings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.frontend.boxes.ignored_labels import without_ignored_labels
from objslam.frontend.boxes.robot_parts import without_robot_parts
from objslam.frontend.boxes.second_labels import without_second_labels
from objslam.frontend.known_errors import take_out_known
from objslam.frontend.localization.odometry_clock import OdometryClock, at_one_clock
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.verdict import say
from objslam.mapping.chosen_poses import with_chosen_poses, with_mode_of


@dataclass(frozen=True)
class Drive:
    """A log as a run maps it.

    log: the log without the errors that are known or solved. given: the log with these errors, at the chosen poses. It lacks
    boxes of ignored labels, boxes on parts of the robot, and second boxes on one thing. settings: the settings, with the
    mode that `auto` means for this log. diagnosis: the findings so far. detections, frames: the numbers of recorded boxes
    and frames. chosen: whether `auto` chose the mode. clock: the clock of the odometry, None if it is the clock of the
    localisation.
    """

    log: Log
    given: Log
    settings: Settings
    diagnosis: Diagnosis
    detections: int
    frames: int
    chosen: bool
    clock: OdometryClock | None

    @classmethod
    def of(cls, log: Log, settings: Settings, ledger: Ledger) -> Self:
        """Return the drive of a log at its chosen poses, before any check. The ledger counts what is left out.

        LogError if the log lacks the chosen poses. ConfigError if calibration.file is wrong or does not fit the log.
        """
        recorded = [c.detections for c in log.cameras if c.detections is not None]
        mapped = without_ignored_labels(log, settings, ledger)
        given, clock = at_one_clock(with_chosen_poses(mapped, settings, ledger), settings, ledger)
        given = without_second_labels(without_robot_parts(given, settings, ledger), settings, ledger)
        of_mode = with_mode_of(given, settings)
        return cls(
            take_out_known(given, of_mode, ledger),
            given,
            of_mode,
            Diagnosis(),
            sum(len(detections) for detections in recorded),
            sum(len(detections.frame_stamps) for detections in recorded),
            settings.mode == "auto",
            clock,
        )

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, in the order of the log."""
        return tuple(one.camera for one in self.log.cameras)

    @property
    def joint(self) -> bool:
        """Whether the poses are solved."""
        return self.settings.mode == "joint"

    @property
    def refutable(self) -> bool:
        """Whether the solve may refute findings about the input."""
        return self.joint and self.diagnosis.refutable

    @property
    def both(self) -> bool:
        """Whether the log has a localisation and an odometry."""
        return self.given.localization is not None and self.given.odometry is not None

    def with_finding(self, finding: Finding | None, ledger: Ledger) -> Self:
        """Return the drive with one more finding, if there is one. The ledger warns of it."""
        if finding is None:
            return self
        found = self.diagnosis.with_findings([finding])
        say(found, ledger)
        return replace(self, diagnosis=found)

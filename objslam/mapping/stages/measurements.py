"""The first stages of a run: check the input, and turn its boxes into keyframes and rays."""

from dataclasses import replace

from objslam.core.diagnostics import Ledger
from objslam.core.types import Keyframes, Rays
from objslam.errors import SolveError
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors, take_out_expected
from objslam.frontend.localization.continued_localization import continued_by_odometry, share_on_continuation
from objslam.frontend.turning_clocks import in_order_of_clocks
from objslam.mapping.checks.diagnosis import diagnose
from objslam.mapping.checks.jumps import taken_out
from objslam.mapping.checks.upright import lies_on_its_side
from objslam.mapping.checks.verdict import say
from objslam.mapping.fixed.sparse_noise import with_sparse_noise
from objslam.mapping.ground.uneven_ground import with_uneven_ground
from objslam.mapping.progress import Progress
from objslam.mapping.stages.drive import Drive


def checked(drive: Drive, ledger: Ledger, progress: Progress) -> Drive:
    """Return the drive with the findings about its input, and with the noise that its boxes show.

    Jumps of the localisation are taken out of the log. If the input is certainly wrong, the mode becomes `fixed`. The ledger
    warns of findings, unless a solve may refute them. LogError if stamps are not in s, or boxes not in px.
    """
    expected = take_out_expected(drive.given, drive.settings)
    settings = with_uneven_ground(expected, drive.settings, ledger, progress)
    diagnosis = drive.diagnosis
    if settings.checks.use:
        diagnosis = diagnose(expected, settings, ledger, progress)
        settings, diagnosis = with_sparse_noise(expected, settings, diagnosis, ledger, progress)
        if (settings.mode == "fixed" and not (drive.chosen and drive.both)) or not diagnosis.refutable:
            say(diagnosis, ledger)  # No solve will refute the findings, so a user need not wait for one.
    if diagnosis.certain and settings.mode == "joint":
        ledger.warn("the poses are not solved, because a solve cannot correct wrong input")
        diagnosis = diagnosis.proven()  # No joint solve will test the other findings.
        settings = settings.model_copy(update={"mode": "fixed"})
    return replace(drive, log=taken_out(diagnosis.jumps, drive.log), settings=settings, diagnosis=diagnosis)


def measured(drive: Drive, ledger: Ledger) -> tuple[Drive, Keyframes, Rays]:
    """Return the drive, its keyframes and its rays. In joint mode, the odometry continues the localisation of the drive.

    The ledger counts the boxes that give no ray. LogError if no frame lies on the path. SolveError if no box gives a usable
    ray.
    """
    localized, log, settings = drive.log, drive.log, drive.settings
    if drive.joint:
        log = continued_by_odometry(log, settings)
    if drive.chosen and log is not localized:
        share = share_on_continuation(localized, log, settings)
        ledger.warn(
            f"the odometry continues the localisation for {100 * share:.0f} % of the boxes, so the poses are solved "
            "(--mode fixed leaves these boxes out)"
        )
    frames = build_keyframes(log, settings, ledger, localized.localization)
    if not drive.joint and not frames.localized_every and not drive.diagnosis.certain:
        cause = " and allow no calibration" if settings.calibration.use is True else ""
        ledger.warn(f"the poses are plain odometry{cause}, so the map drifts with them (--mode joint corrects both)")
    if sideways := lies_on_its_side(frames):
        ledger.warn(sideways)
    rays = build_rays(log, frames, settings, ledger)
    if drive.joint and len(log.cameras) > 1 and len(rays):
        frames, rays = in_order_of_clocks(frames, rays, shared_errors(log, frames, rays, settings))
    if len(rays) == 0:
        say(drive.diagnosis, ledger)
        raise SolveError(
            "no box gives a usable ray", where=log.name, hint="; ".join(ledger.lines()) or "the detections are empty"
        )
    return replace(drive, log=log), frames, rays

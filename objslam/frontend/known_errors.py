"""The shared errors that a log can have, and the errors in a calibration file.

Errors in the file that a run does not estimate are corrected before the run.
"""

from pathlib import Path

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import AXES, LENS, Calibration, kind
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import is_planar
from objslam.core.trajectory import Trajectory
from objslam.core.types import Keyframes, Log, Rays
from objslam.errors import ConfigError
from objslam.frontend.corrected_log import take_out
from objslam.frontend.corrected_odometry import ODOMETRY, CorrectablePath
from objslam.frontend.recent_values import ValuesOfObjects
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.surface_ranges import half_widths_of_rays, with_known_surfaces
from objslam.io.calibration_yaml import load_calibration

USUAL_PLACE = 0.05
"""The prior standard deviation (m) of the place of a camera along each axis. It fits a place that was measured with a ruler.
With a larger value, a log must show more before an error counts as known."""
USUAL_PLACES = USUAL_PLACE, USUAL_PLACE
"""`USUAL_PLACE` for x and y, and for z."""
_PLACE_BESIDE_ODOMETRY = 0.02
"""The prior standard deviation (m) that replaces `USUAL_PLACE` in joint mode with localisation and odometry. In this mode,
the poses may move, and so hide the effect of a wrong place. In a short live drive, the map was off by 4 cm with this value,
and by 11 cm with `USUAL_PLACE`. For logs with places that were 1.5 cm off, both values gave equally good maps."""
USUAL_FOCAL = 0.02
"""The prior standard deviation of the focal length, as a share, if the field of view is from a data sheet. A calibrated
camera errs less. The focal length is estimated only if a localisation or fixed mode gives poses. A path from odometry alone
can bend to fit a wrong focal length, and then a wrong association also fits. When the focal length was also estimated there,
one of 36 parts of recorded drives had four landmarks twice. With a larger value, a log must show more before an error counts
as known."""
COARSE = 0.3
"""The least noise (m) at which fixed poses reveal no error of a camera. A robot at 1 to 2 m/s drives less than this distance
during a clock error of 0.1 s. A larger value calibrates cameras by worse poses."""
OF_LENGTHS = ("range_scale", "range_offset", "surface", "tag_scale")
"""The errors of measured lengths."""
_OF_LONG_WAYS = ("odometry.turn_slip", "odometry.turn_per_m")
"""The errors of wheels that have hardly any effect over short distances."""
_CAMERA = ("clock", *AXES, *LENS, "x", "y", "z")
# Cached, because a run asks for one odometry many times.
_in_plane = ValuesOfObjects[Trajectory, bool](lambda path: is_planar(path.poses))
_sideways = ValuesOfObjects[Trajectory, bool](lambda path: CorrectablePath(path).drives_sideways)


def error_names(log: Log) -> tuple[str, ...]:
    """Return the names of all errors that the measurements of a log can share."""
    odometry = () if log.odometry is None else ODOMETRY
    cameras = tuple(f"{one.camera.name}.{name}" for one in log.cameras for name in _CAMERA)
    return (*odometry, *cameras, *OF_LENGTHS)


def usual_place(log: Log, settings: Settings) -> tuple[float, float]:
    """Return the prior standard deviations, m, of the place of a camera on the base, if `calibration.translation` is auto:
    of x and y, and of z.

    At given poses (a localisation, or fixed mode), a wrong place of a camera moves all objects, so the place is estimated. A
    map from odometry alone simply moves with the camera. Poses in a plane do not rise to hide a wrong height of a camera.
    """
    if settings.mode == "fixed":
        return USUAL_PLACES
    if log.localization is None:
        return 0.0, 0.0
    if log.odometry is None:
        return USUAL_PLACES
    return _PLACE_BESIDE_ODOMETRY, USUAL_PLACE if _in_plane(log.localization) else _PLACE_BESIDE_ODOMETRY


def prior_sigma(name: str, settings: Settings, place: tuple[float, float] = USUAL_PLACES) -> float:
    """Return the prior standard deviation of an error in the settings, in the unit of the error. It is 0 if the error is
    fixed.

    In fixed mode, the errors are estimated from bearings and given poses. So errors of lengths and of odometry are fixed.
    place: what `usual_place` returns for the log.
    """
    what, fixed = kind(name), settings.mode == "fixed"
    if fixed and (name in ODOMETRY or what in OF_LENGTHS):
        return 0.0
    setting = {"x": "translation", "y": "translation", "z": "translation", "cx": "centre", "cy": "centre"}.get(what, what)
    sigma = getattr(settings.calibration, setting)
    if sigma == "auto" and name in ODOMETRY:
        return 0.0
    if sigma == "auto":
        return place[what == "z"] if setting == "translation" else USUAL_FOCAL * (place[0] > 0)
    return float(sigma)


def estimates(settings: Settings, odometry: bool, localized: bool) -> bool:
    """Return whether the shared errors of a log are estimated.

    calibration.use decides. With "auto", fixed mode needs a localisation that is not coarse. In joint mode, each pose counts
    by its noise, so a coarse localisation helps little, and does no harm. odometry: whether the odometry is used. localized:
    whether there is a localisation.
    """
    use = settings.calibration.use
    if settings.mode == "fixed":
        return localized and (use is True or (use == "auto" and not coarse(settings)))
    return (odometry or localized) if use == "auto" else use


def coarse(settings: Settings) -> bool:
    """Return whether fixed poses err too much to reveal an error of a camera."""
    return settings.localization.xy >= COARSE


def possible(log: Log, settings: Settings) -> list[str]:
    """Return the names of the errors of a log that the settings do not fix.

    A camera whose base_T_camera is the identity is the base itself, as in a log of a camera's own poses. Its rotation and
    position have no errors, unless settings.calibration.use is true. Its lens has no errors either, because such poses come
    from images of this lens, or were calibrated with it. Only odometry in the plane slips in curves, or has another scale
    sideways. Odometry in space comes from a camera or a scanner, not from wheels. With a localisation, odometry only leads
    from one pose to the next. Such a short way hardly shows a slip or a difference between two wheels. If these two errors
    were estimated, wrong associations could fit.
    """
    asked, place = settings.calibration.use is True, usual_place(log, settings)
    base = {c.camera.name for c in log.cameras if not asked and np.array_equal(c.camera.base_T_camera, np.eye(4))}
    mounted = (*AXES, *LENS, "x", "y", "z")
    names = [n for n in error_names(log) if prior_sigma(n, settings, place) > 0]
    if log.odometry is not None and not (_in_plane(log.odometry) and _sideways(log.odometry)):
        names = [n for n in names if n != "odometry.lateral_scale"]
    if log.localization is not None or (log.odometry is not None and not _in_plane(log.odometry)):
        names = [n for n in names if n not in _OF_LONG_WAYS]
    return [n for n in names if not ((parts := n.rpartition("."))[0] in base and parts[2] in mounted)]


def has_sized_tags(rays: Rays, settings: Settings) -> bool:
    """Return whether any ray is to a fiducial whose size is given."""
    if rays.corner_sigma is None:
        return False
    names = (rays.label_names[i] for i in np.unique(rays.label[np.isfinite(rays.corner_sigma)]).tolist())
    return any(settings.tags.size_of(name) is not None for name in names)


def measured_lengths(rays: Rays, half: Floats, settings: Settings) -> dict[str, bool]:
    """Return for each name in `OF_LENGTHS` whether any ray has this error. half: (R,) as `surface_ranges.half_widths`."""
    ranged = np.isfinite(rays.range)
    some, surfaces = bool(ranged.any()), bool((ranged & (half > 0)).any())
    return dict(zip(OF_LENGTHS, (some, some, surfaces, has_sized_tags(rays, settings)), strict=True))


def known_errors(settings: Settings) -> Calibration | None:
    """Return the robot's shared errors in calibration.file, None without a file. ConfigError if the file is wrong."""
    return None if settings.calibration.file is None else load_calibration(Path(settings.calibration.file)).of_robot()


def warn_of_others(known: Calibration, log: Log, settings: Settings, ledger: Ledger) -> None:
    """Warn of errors in calibration.file that the log does not have."""
    names = error_names(log)
    others = ", ".join(name for name in known.names if name not in names)
    if others:
        where = settings.calibration.file
        ledger.warn(f"{where}: nothing in the log is called {others}, so this is not used ({_parts(log)})")


def take_out_known(log: Log, settings: Settings, ledger: Ledger) -> Log:
    """Return the log corrected by the errors of calibration.file that the run does not estimate.

    If the run estimates no errors, all errors in the file are corrected. If it estimates some, the errors in the file that
    `possible` does not list are corrected. The ledger warns of errors in the file that the log does not have. ConfigError if
    the file is wrong, or if the log has none of its errors.
    """
    known, names, file = known_errors(settings), error_names(log), settings.calibration.file
    if known is None:
        return log
    if not set(known.names) & set(names):
        raise ConfigError(f"log {log.name} has none of its errors: {', '.join(known.names)}", where=file, hint=_parts(log))
    warn_of_others(known, log, settings, ledger)
    estimated = estimates(settings, log.odometry is not None, log.localization is not None)
    sought = set(possible(log, settings)) if estimated else set()
    values = zip(known.names, known.values.tolist(), strict=True)
    held = {name: value for name, value in values if name in names and name not in sought}
    return take_out(log, held)


def take_out_expected(log: Log, settings: Settings) -> Log:
    """Return the log corrected by all errors of calibration.file, whether a run estimates them or not."""
    of = settings.calibration.model_copy(update={"use": False})
    return take_out_known(log, settings.model_copy(update={"calibration": of}), Ledger())


def _parts(log: Log) -> str:
    cameras = ", ".join(one.camera.name for one in log.cameras)
    return f"the log has {'no' if log.odometry is None else 'an'} odometry and these cameras: {cameras or 'none'}"


def shared_errors(log: Log, keyframes: Keyframes, rays: Rays, settings: Settings) -> SharedErrors | None:
    """Return the errors that the settings let a run estimate from a log, None if there are no such errors.

    keyframes, rays: of the solve. An error is a parameter if its prior sigma is not 0 and it affects a measurement.
    """
    names: tuple[str, ...] = ()
    half = half_widths_of_rays(rays, keyframes, [one.camera for one in log.cameras])
    if estimates(settings, keyframes.odom_T_base is not None, keyframes.localized_every > 0):
        cameras = {one.camera.name: (keyframes.camera == index).any() for index, one in enumerate(log.cameras)}
        measured = {
            **cameras,
            "odometry": keyframes.odom_T_base is not None,
            **measured_lengths(rays, half, settings),
        }
        names = tuple(n for n in possible(log, settings) if measured[n.rpartition(".")[0] or n])
    rays = with_known_surfaces(rays, half, settings.calibration.surface if "surface" in names else 0.0)
    mean, place = np.zeros(len(names)), usual_place(log, settings)
    prior = np.diag([prior_sigma(name, settings, place) ** 2 for name in names]).reshape(len(names), len(names))
    known = known_errors(settings) if names else None
    if known is not None:
        here, there = np.array([(names.index(n), i) for i, n in enumerate(known.names) if n in names], int).reshape(-1, 2).T
        mean[here], prior[np.ix_(here, here)] = known.values[there], known.covariance[np.ix_(there, there)]
    errors = SharedErrors(log, keyframes, rays, settings, names, mean, prior, sized_tags=has_sized_tags(rays, settings))
    return errors if names or errors.unknown_noise else None

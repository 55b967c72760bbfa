"""The consequences of findings: warnings, and larger covariances if a known error shifts objects."""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.meeting_points import nearest_point
from objslam.mapping.checks.small_errors import shared

_STEPS = 2
"""The number of Gauss-Newton steps that fit a point to moved rays. A small error hardly moves the rays, so few steps are
enough. More steps are slower."""


def say(diagnosis: Diagnosis, ledger: Ledger) -> None:
    """Warn of each finding, and of its consequences for the objects."""
    for finding in diagnosis.findings:
        ledger.warn(finding.message)
    if diagnosis.spoilt:
        ledger.warn("no object is called ok, because the input is wrong (--set checks.use=false maps it anyway)")


def widened(
    objects: ObjectMap, keyframes: Keyframes, rays: Rays, association: Association, weight: Floats, diagnosis: Diagnosis
) -> ObjectMap:
    """Return the objects with the covariance of small calibration errors added, if the run did not correct such errors.

    association: the object of each ray. weight: (R,) their robust weights.
    """
    errors = diagnosis.errors
    if errors is None:
        return objects
    own = shared(errors.errors.log, keyframes, rays, errors.errors.settings)
    values = np.zeros(len(own.names))
    values[[own.names.index(name) for name in errors.names]] = errors.values
    moved, moved_rays, _ = own.at(values, drift=False)
    before, after = rays.in_map(keyframes.map_T_camera), moved_rays.in_map(moved.map_T_camera)
    changed = []
    for number, item in enumerate(objects.objects):
        mine = (association.object == number) & (weight > 0)
        if item.covariance is None or mine.sum() < 2:
            changed.append(item)
            continue
        shift = _settled(after, mine, item.position) - _settled(before, mine, item.position)
        changed.append(replace(item, covariance=item.covariance + np.outer(shift, shift)))
    return replace(objects, objects=tuple(changed))


def _settled(rays: tuple[Floats, Floats], mine: Floats, start: Floats) -> Floats:
    """Return the point (3,) nearest to the rays in the mask `mine` (R,). rays: origins and directions (R, 3)."""
    point = start
    for _ in range(_STEPS):
        point = nearest_point(rays[0][mine], rays[1][mine], point)
    return point

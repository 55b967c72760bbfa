"""The estimate of a joint solve: poses and objects with their covariances, and the evidence for the map."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.geometry import angles_off
from objslam.core.statistics import widening
from objslam.core.types import Association, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.outlier_rejection import JointSolution
from objslam.graph.posterior.evidence import log_evidence
from objslam.graph.posterior.marginals import (
    Solved,
    SolvedGraph,
    SolvedMeasurements,
    correlated_factor,
    joint_covariances,
    largest_sigma,
    marginal_covariances,
    seen_covariances,
)
from objslam.graph.tags.estimate import with_objects


@dataclass(frozen=True)
class SolvedErrors:
    """The shared errors of a joint solve.

    errors: the measurements as a function of the shared errors, with the noise that was found. None without shared errors.
    calibration: the values of the errors, None without errors. sensitivity: (N, 3, P) the derivatives of the landmarks, m
    per unit of each error, NaN for a landmark outside the graph. None if the errors were held. failed: whether the
    estimation of the errors failed.
    """

    errors: CalibratedMeasurements | None = None
    calibration: Calibration | None = None
    sensitivity: Floats | None = None
    failed: bool = False


def estimate_of(
    measured: Measurements, association: Association, found: JointSolution, shared: SolvedErrors, ledger: Ledger
) -> Estimate:
    """Return the estimate of a joint solution. The ledger counts landmarks without a covariance.

    association: the landmark of each ray. The landmarks are objects or corners of fiducials.
    """
    rays, optimum, positions, tags = measured.rays, found.optimum, found.positions, measured.tags
    used, map_T_camera = found.used, found.map_T_camera
    origins, directions = (a[used] for a in rays.in_map(map_T_camera))
    seen = positions[association.object[used]]
    residual = angles_off(origins, directions, seen) / rays.sigma[used]
    weight = np.zeros(len(rays))
    weight[used] = optimum.ray_weights(measured.settings.joint.loss, residual)
    at = association.object, used & (weight > 0), map_T_camera, positions
    solved: Solved = SolvedMeasurements(measured, association, *at[1:], found.near)
    if tags is not None:
        solved = SolvedGraph(measured.whole(*at, "gnc")[0], optimum.values)
    covariance, correlated = _covariances(solved, positions, ledger)
    seen_sigma = _seen_sigma(solved, measured, association, found, at[1], covariance, ledger)
    body = np.arange(association.count) if tags is None else tags.object_of_landmark()
    wider = widening(residual, body[association.object[used]], association.count)[body]
    covariance *= wider[:, None, None]
    if shared.sensitivity is not None and shared.calibration is not None:
        by_error, told = shared.sensitivity, shared.calibration
        covariance += by_error @ told.covariance @ np.swapaxes(by_error, 1, 2)
        covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
        correlated = np.concatenate([correlated, np.nan_to_num(by_error) @ told.root], axis=2)
    distance, cost = np.linalg.norm(seen - origins, axis=1), optimum.cost_after
    ranges_open = shared.errors is not None and "ranges" in shared.errors.unknown_noise
    calibration = shared.calibration
    estimate = Estimate(
        map_T_base=measured.map_T_base(map_T_camera),
        positions=positions,
        covariance=covariance,
        seen_sigma=seen_sigma * np.sqrt(wider),
        solved=np.isfinite(covariance[:, 0, 0]),
        weight=weight,
        cost_before=found.cost_before,
        cost_after=cost,
        iterations=found.iterations,
        calibration=calibration if calibration is not None and calibration.names else None,
        noise=None if shared.errors is None else shared.errors.noise,
        correlated=correlated if tags is None else tags.of_objects(correlated),
        log_evidence=log_evidence(measured, association, used, distance, solved, cost, ranges_open),
        uncalibrated=shared.failed,
    )
    if tags is None:
        return estimate
    covariances = partial(joint_covariances, solved)
    return with_objects(estimate, tags, rays, map_T_camera, optimum.values, covariances, wider, shared.sensitivity, ledger)


def _covariances(solved: Solved, positions: Floats, ledger: Ledger) -> tuple[Floats, Floats]:
    """Return the covariances (N, 3, 3) m^2 of the landmarks, and the factor (N, 3, F) m of their correlated part.

    Both do not contain the shared errors of the calibration. positions: (N, 3) m, NaN for a landmark outside the graph.
    """
    landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
    covariance = np.full((len(positions), 3, 3), np.nan)
    covariance[landmarks] = marginal_covariances(solved, landmarks, ledger)
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    drift = correlated_factor(solved, known, covariance[known])
    correlated = np.zeros((len(positions), 3, drift.shape[2]))
    correlated[known] = drift
    return covariance, correlated


def _seen_sigma(
    solved: Solved,
    measured: Measurements,
    association: Association,
    found: JointSolution,
    inliers: Bools,
    covariance: Floats,
    ledger: Ledger,
) -> Floats:
    """Return the largest standard deviation (N,) m of each landmark. If it is large in the map, a keyframe is the reference.

    The keyframe is one that sees the landmark. Far from the start, all landmarks share the error of the path to them.
    inliers: (R,). covariance: (N, 3, 3) m^2 in the map.
    """
    witness = _witnesses(measured.rays, association, inliers)
    sigma = largest_sigma(covariance)
    reach = np.linalg.norm(found.positions - found.map_T_camera[witness, :3, 3], axis=1)
    far = np.flatnonzero(sigma > measured.settings.triangulation.max_rel_sigma * reach)
    sigma[far] = largest_sigma(seen_covariances(solved, far, witness[far], ledger))
    return sigma


def _witnesses(rays: Rays, association: Association, used: Bools) -> Ints:
    """Return for each object (N,) the keyframe of its middle used ray, or 0 without one."""
    object_, keyframe = association.object[used], rays.keyframe[used]
    order = np.lexsort((keyframe, object_))
    number = np.bincount(object_, minlength=association.count)
    middle = np.cumsum(number) - number + number // 2
    witness = np.zeros(association.count, dtype=np.int64)
    witness[number > 0] = keyframe[order][middle[number > 0]]
    return witness

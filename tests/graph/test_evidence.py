"""The evidence for an association, against dense linear algebra, and in simulated drives."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from drives import ODOMETRY_ALONE, make_drive
from scipy.stats import multivariate_normal

from objslam.core.statistics import CAUCHY_K
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.factors.range import share_bias
from objslam.graph.posterior.evidence import log_evidence, shared_bias_density
from objslam.graph.posterior.marginals import SolvedGraph
from objslam.simulation import DepthNoise

NAMES = ("x_per_m", "y_per_m", "xy_per_rad", "yaw_per_m", "yaw_per_rad", "floor_xy", "floor_yaw")


def noisier(drive, rays=1.0, odometry=1.0):
    """The drive as a solve takes it that expects other noise."""
    of = drive.settings.odometry
    of = of.model_copy(update={name: odometry * getattr(of, name) for name in NAMES})
    keyframes = replace(drive.keyframes, drift=drive.keyframes.drift * odometry**2)
    noisy = replace(drive.rays, sigma=drive.rays.sigma * rays)
    return replace(drive, keyframes=keyframes, rays=noisy, settings=drive.settings.model_copy(update={"odometry": of}))


def whole(graph, values):
    """The log of the integral of all densities in the graph, in dense matrices and with the noise models of GTSAM."""
    total = -graph.error(values)
    for i in range(graph.size()):
        root = graph.at(i).noiseModel().R()
        total += np.linalg.slogdet(root)[1] - len(root) * np.log(2 * np.pi) / 2
    ordering = gtsam.Ordering()
    for key in sorted(values.keys()):
        ordering.push_back(key)
    information = graph.linearize(values).hessian(ordering)[0]
    return total + len(information) * np.log(2 * np.pi) / 2 - np.linalg.slogdet(information)[1] / 2


def test_the_evidence_is_the_integral_of_all_densities():
    drive = make_drive(0, "mode=joint", objects=4, classes=4, frames=60, **ODOMETRY_ALONE)
    estimate, every = drive.joint(), np.ones(len(drive.rays), dtype=bool)
    found, dense = [], []
    for changed in (drive, noisier(drive, rays=2.0), noisier(drive, odometry=3.0)):
        measured = Measurements.of(changed.keyframes, changed.rays, changed.settings)
        poses, owner = estimate.map_T_base @ drive.keyframes.base_T_camera, drive.association.object
        for used in (every, np.arange(len(every)) % 5 > 0):
            graph, values = measured.whole(owner, used, poses, estimate.positions, "gnc")
            args = used, np.ones(used.sum()), SolvedGraph(graph, values), graph.error(values)
            found.append(log_evidence(measured, drive.association, *args))
            dense.append(whole(graph, values))
    # A stray ray is one of a view of 1 sr, whose density is 1.
    np.testing.assert_allclose(np.subtract(found, found[0]), np.subtract(dense, dense[0]), atol=0.5)


def test_errors_that_share_a_bias():
    rng = np.random.default_rng(0)
    group, variance, bias = np.array([0, 0, 1, 1, 1]), rng.uniform(1.0, 2.0, 5), np.array([0.5, 0.5, 2.0, 2.0, 2.0])
    off = 0.02 * rng.normal(size=5)  # So small that Cauchy's loss is quadratic.
    covariance = np.diag(variance) + np.where(group[:, None] == group, np.sqrt(bias[:, None] * bias), 0.0)
    found = shared_bias_density(off, variance, bias, group, 3)
    np.testing.assert_allclose(found, multivariate_normal(np.zeros(5), covariance).logpdf(off), atol=1e-4)


@pytest.mark.parametrize("depth", [None, DepthNoise()])
def test_the_evidence_is_largest_at_the_noise_of_the_drive(depth):
    """More noise in the odometry lets the path bend onto the rays. That explains them more closely, but is no better map."""
    drive = make_drive(1, "mode=joint", objects=6, classes=6, frames=150, false=0.0, depth=depth, **ODOMETRY_ALONE)
    right = drive.joint().log_evidence
    for change in ({"rays": 2.0}, {"rays": 0.5}, {"odometry": 4.0}, {"odometry": 0.25}):
        assert noisier(drive, **change).joint().log_evidence < right


def test_one_object_as_two_has_less_evidence_and_two_as_one_too():
    drive = make_drive(2, "mode=joint", objects=8, classes=8, frames=80, false=0.0, **ODOMETRY_ALONE)
    true, rays = drive.association, drive.rays
    late = drive.rays.keyframe > np.median(rays.keyframe[true.object == 0])
    twice = Association(np.where((true.object == 0) & late, 8, true.object), np.append(true.label, true.label[0]))
    right = drive.joint().log_evidence
    assert replace(drive, association=twice).joint().log_evidence < right - 3
    near = int(np.argmin(np.linalg.norm(drive.points[1:] - drive.points[0], axis=1))) + 1
    as_one = Association(np.where(true.object == near, 0, true.object), true.label)
    assert replace(drive, association=as_one).joint().log_evidence < right - 10


def test_one_wrong_error_does_not_move_the_bias_of_a_group():
    """The reference is the integral over the bias, with Cauchy's loss on each error."""
    rng = np.random.default_rng(4)
    off, group = rng.normal(0, 0.03, 20) + 0.02, np.zeros(20, dtype=np.int64)
    off[3] = 50.0
    variance, bias = np.full(20, 0.03**2), np.full(20, 0.02**2)
    shared = np.linspace(-0.1, 0.1, 4001)
    squares = CAUCHY_K**2 * np.log1p((off[:, None] - shared) ** 2 / variance[:, None] / CAUCHY_K**2)
    squares = squares.sum(axis=0) + shared**2 / bias[0] + np.log(2 * np.pi * variance).sum() + np.log(2 * np.pi * bias[0])
    expected = np.log(np.trapezoid(np.exp(-squares / 2 + squares.min() / 2), shared)) - squares.min() / 2
    assert shared_bias_density(off, variance, bias, group, 1) == pytest.approx(expected, abs=0.5)


def test_ranges_that_end_before_a_thing_in_one_visit_make_no_second_thing_of_it():
    """They end 0.4 m before it in the first of two visits. A second thing at this place would agree with them exactly. If
    each range counts for itself, the second thing explains more, because it needs less noise."""
    drive = make_drive(2, "mode=joint", objects=8, classes=8, frames=80, false=0.0, depth=DepthNoise(), **ODOMETRY_ALONE)
    estimate, every, one = drive.joint(), np.ones(len(drive.rays), dtype=bool), drive.association
    early = np.array_split(np.flatnonzero(one.object == 0), 2)[0]
    away = np.arange(len(drive.keyframes)) > drive.rays.keyframe[early[-1]]
    drive = replace(drive, keyframes=replace(drive.keyframes, stamps=drive.keyframes.stamps + 10.0 * away))
    shorter, owner = drive.rays.range.copy(), one.object.copy()
    shorter[early] -= 0.4
    owner[early] = one.count
    two = Association(owner, np.append(one.label, one.label[0]))
    poses = estimate.map_T_base @ drive.keyframes.base_T_camera
    distance = np.linalg.norm(estimate.positions[one.object] - drive.rays.in_map(poses)[0], axis=1)

    def evidence(ranges, association, ranges_open):
        rays = share_bias(replace(drive.rays, range=ranges), association)
        measured = Measurements.of(drive.keyframes, rays, drive.settings)
        positions = np.vstack([estimate.positions, estimate.positions[:1]])[: association.count]
        graph, values = measured.whole(association.object, every, poses, positions, "gnc")
        args = every, distance, SolvedGraph(graph, values), graph.error(values)
        return log_evidence(measured, association, *args, ranges_open)

    gain = {way: evidence(shorter, one, way) - evidence(drive.rays.range, two, way) for way in (False, True)}
    assert gain[True] > 5
    assert gain[False] < -5

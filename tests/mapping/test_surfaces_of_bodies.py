"""Ranges to the centres of bodies that were seen from many sides, against rays cast at the true solids."""

import numpy as np
import pytest
from mapping.hiding_drives import Solid
from mapping.surface_drives import AROUND, depth_along, ring_of, surface_drive

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse
from objslam.core.trajectory import poses_near
from objslam.core.types import Rays
from objslam.evaluation.evaluate import INSIDE_95_3D, evaluate
from objslam.frontend.surface_ranges import centre_factors, to_centres
from objslam.mapping import pipeline
from objslam.mapping.bodies import fitting
from objslam.mapping.solution import RangeShift
from objslam.mapping.stages import solved

JOINT = ("mode=joint", "poses.use=odometry", "output.recording=false", "checks.use=false")


def mapped(log, *changes):
    """The scores, after an alignment with a scale, and the solution, of a run from odometry alone."""
    settings, found = load_settings(None, (*JOINT, *changes)), []
    given = solved.solve

    def noted(*args, **more):
        found.append(given(*args, **more))
        return found[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solved, "solve", noted)
        result = pipeline.run(log, settings, Ledger())
    return evaluate(result.map, log.truth, result.path_after, align="sim2", radius=1.0).objects, found[-1]


@pytest.mark.parametrize("shape", ["cuboid", "cylinder", "ellipsoid"])
def test_a_cast_ray_ends_where_it_enters_the_solid(shape):
    """The simulation itself."""
    rng = np.random.default_rng(0)
    solid = Solid(shape, "thing", np.array([0.3, -0.2, 4.0]), np.array([0.5, 0.3, 0.8]), 0.6)
    slopes = rng.uniform(-0.3, 0.3, (400, 2))
    depth = depth_along(solid, np.eye(4), slopes)

    def inside(z):
        x, y, up = (np.column_stack([slopes, np.ones(400)]) * np.reshape(z, (-1, 1)) - solid.centre).T
        cos, sin = np.cos(solid.yaw), np.sin(solid.yaw)
        x, y, up = (part / half for part, half in zip((cos * x + sin * y, cos * y - sin * x, up), solid.half, strict=True))
        flat = np.maximum(abs(x), abs(y)) if shape == "cuboid" else np.hypot(x, y)
        return (np.hypot(flat, up) if shape == "ellipsoid" else np.maximum(flat, abs(up))) < 1

    hit = np.isfinite(depth)
    assert 30 < hit.sum() < 370
    near = np.where(hit, depth, 1.0)
    assert inside(near + 1e-3)[hit].mean() > 0.95  # A ray that grazes an edge leaves at once.
    before = near[:, None] - np.linspace(1e-6, 1.5, 60)
    assert not any(inside(z)[hit].any() for z in before.T)
    assert not any(inside(z)[~hit].any() for z in np.linspace(3, 5, 50))


def test_bodies_tell_how_far_centres_are_behind_surfaces():
    log, seed = surface_drive(3, around=True), 3
    _, solution = mapped(log)
    rays, keyframes = solution.rays, solution.keyframes
    assert rays.surface is not None
    true = poses_near(log.truth.trajectory, keyframes.stamps, 1.0) @ keyframes.base_T_camera
    solids = ring_of(np.random.default_rng([seed, 77]), *AROUND)
    names = np.array(rays.label_names)[rays.label]
    for solid in solids:
        mine = np.flatnonzero((names == solid.label) & (rays.surface[:, 1] < 0.9))
        assert len(mine) > 100
        share, weight = rays.surface[mine].T
        told, behind = (share - 0.5 * weight) / (1 - weight), []
        for ray, pose in zip(mine.tolist(), true[rays.keyframe[mine]], strict=True):
            slopes = rays.direction[ray, :2] / rays.direction[ray, 2]
            local = inverse(pose)[:3, :3] @ solid.centre + inverse(pose)[:3, 3]
            reach = depth_along(solid, pose, slopes[None])[0] * np.sqrt(1 + slopes @ slopes)
            wide = (rays.box[ray, 2] - rays.box[ray, 0]) / 400 / 2 * rays.direction[ray, 2] * np.linalg.norm(local)
            behind.append((np.linalg.norm(local) - reach) / wide)
        known = np.isfinite(behind)
        assert known.mean() > 0.5
        allowed = 0.15 if min(solid.half) > 0.05 else 0.4  # Of a sign 2 cm thick, the boxes are noisier than that.
        assert np.median(told[known]) == pytest.approx(np.median(np.array(behind)[known]), abs=allowed)


@pytest.mark.long
def test_large_things_tell_the_scale_of_the_map():
    """Things of up to 2.5 m, whose centres are farther behind than `depth.centre` says.

    In one of the four drives, the ranges are taken for those of centres, so bodies change nothing.
    """
    off, widths, inside = [], [], []
    for seed in range(102, 106):
        log = surface_drive(seed, around=True, wide=2.5)
        scores, _ = mapped(log)
        inside += [m.squared_3d < INSIDE_95_3D for m in scores.matches]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fitting, "range_shift", lambda found, views, ray, count, *_: RangeShift.none(count))
            by_widths, _ = mapped(log)
        off.append(abs(1 / scores.transform.scale - 1))
        widths.append(abs(1 / by_widths.transform.scale - 1))
    assert np.mean(off) < 0.8 * np.mean(widths)
    assert len(inside) == 24
    assert np.mean(inside) > 0.8


@pytest.mark.parametrize(("ends", "changes"), [("centre", ()), ("surface", ("depth.centre=0",))])
def test_ranges_of_centres_stay(ends, changes):
    """If the log shows that ranges end at centres, and if the settings say so."""
    _, solution = mapped(surface_drive(3, around=True, ends=ends), *changes)
    assert solution.bodies is None
    assert solution.rays.surface is None


def test_a_shift_of_ranges_can_be_undone():
    count, settings, errors = 3, load_settings(None, ()), {"surface": 0.2}
    none, half = np.zeros(count, dtype=int), np.array([0.05, 0.1, 0.2])
    ahead, unit = np.tile([0.0, 0.0, 1.0], (count, 1)), np.ones(count)
    surface = np.array([2.0, 3.0, 4.0])
    reach = surface * to_centres(half, settings.depth.centre)
    rays = Rays(none, ahead, unit, reach, unit, unit, none, unit, np.zeros((count, 4)), none - 1, ("thing",))
    after = np.array([[1.0, 0.0], [0.8, 0.4], [0.7, 0.6]])
    factor = to_centres(half, after[:, 0]) / to_centres(half, settings.depth.centre)
    shift = RangeShift(factor, np.full(count, 0.5), after).only(np.array([True, True, False]))
    moved = shift.apply(rays, settings)
    np.testing.assert_allclose(moved.range_bias, [0.5, 0.5, 1.0])
    np.testing.assert_allclose(moved.surface, [[1.0, 0.0], [0.8, 0.4], [settings.depth.centre, 1.0]])
    centre = surface * np.array([1 / (1 - 0.05), 1 / (1 - 0.08) / (1 - 0.1 * 0.4 * 0.2), 1 / (1 - 0.1) / (1 - 0.2 * 0.2)])
    common = 1 / (1 - 0.2 * half * moved.surface[:, 1])
    np.testing.assert_allclose(moved.range * common, centre)
    np.testing.assert_allclose(moved.range * common / centre_factors(moved, errors, half, settings), surface)
    assert RangeShift.none(count).apply(rays, settings) is rays

"""Bodies of things that something hides in part, against the true ellipsoids."""

from dataclasses import replace

import numpy as np
import pytest
from outlines import from_axes
from triangulation.true_boxes import CAMERAS, edges_of, random_bodies, views_of

from objslam.core.camera import undistort
from objslam.mapping.bodies.fitting import repeated_error
from objslam.triangulation.bodies.ellipsoid import half_axes
from objslam.triangulation.bodies.residuals import residuals
from objslam.triangulation.bodies.shapes import ELLIPSOID
from objslam.triangulation.bodies.solve import solve_bodies
from objslam.triangulation.bodies.to_centre import directions_to_centres, shifts_of

CAMERA = CAMERAS["pinhole"]
CHI2_95 = 7.815  # chi-squared, 3 degrees of freedom


def seen(count, boxes, rng):
    """Boxes (count * boxes, 4) of ellipsoids of 0.3 to 0.8 m around the origin over half a turn, with noise of 2 px."""
    half = rng.uniform(0.15, 0.4, (count, 3))
    true = from_axes(rng.uniform(-0.3, 0.3, (count, 3)), half, rng.uniform(-1.5, 1.5, count))
    parts = [views_of(CAMERA, one, boxes, rng, arc=np.pi) for one in true]
    box, pose = (np.concatenate(part) for part in zip(*parts, strict=True))
    return true, box + rng.normal(0, 2, box.shape), pose, np.repeat(np.arange(count), boxes)


def solved(box, pose, owner, true, *, bound=None):
    edges = edges_of(CAMERA, box, pose, owner, sigma=3 * np.sqrt(2))
    if bound is not None:
        edges = replace(edges, bound=bound)
    half = np.column_stack([half_axes(true)[:, :2].mean(axis=1), half_axes(true)[:, 2]])
    names, side = tuple(f"thing {j}" for j in range(len(true))), np.full(len(box), 277.0)
    return solve_bodies(lambda _: edges, true[:, :3] + 0.03, half, names, side=side, share=0.1, bent=False)


def hide(box, which, edge, share):
    """Boxes whose edge ends short by a share (B,) of the side."""
    box, axis = box.copy(), edge % 2
    box[which, edge] += np.where(edge < 2, 1, -1) * (share * (box[:, axis + 2] - box[:, axis]))[which]
    return box


def behind(pose, arc=0.9):
    """Whether a post stands before the camera, at azimuths around the middle of half a turn."""
    return np.abs(np.arctan2(pose[:, 1, 3], pose[:, 0, 3]) - np.pi / 2) < arc / 2


def off(found, true):
    return np.linalg.norm(found.values[:, :3] - true[:, :3], axis=1)


def inside(found, true):
    """Which centres are inside their 95 % ellipsoids."""
    repeated = np.array([repeated_error(found.share[0], axes) for axes in found.axes[:, 3:6]])
    covariance = found.centre_covariance + repeated[:, None, None] ** 2 * np.eye(3)
    away = found.values[:, :3] - true[:, :3]
    return np.einsum("ni,nij,nj->n", away, np.linalg.inv(covariance), away) < CHI2_95


def test_edges_that_end_short_from_some_sides_do_not_move_the_body():
    rng = np.random.default_rng(1)
    true, box, pose, owner = seen(25, 40, rng)
    which = behind(pose)
    short = hide(box, which, 0, np.full(len(box), 0.4))
    found, whole = solved(short, pose, owner, true), solved(box, pose, owner, true)
    assert np.median(off(found, true)) < 2 * np.median(off(whole, true))
    assert np.mean(found.hidden[which, 0] > 0) > 0.7
    assert np.mean(found.hidden[~which, 0] > 0) < 0.05
    assert np.mean(found.hidden[:, 1] > 0) < 0.05
    assert inside(found, true).mean() > 0.85


def test_whole_boxes_have_no_hidden_edges():
    rng = np.random.default_rng(2)
    true, box, pose, owner = seen(25, 40, rng)
    assert np.mean(solved(box, pose, owner, true).hidden > 0) < 0.005


def test_boxes_that_are_too_large_are_not_hidden():
    """A box that reaches too far says nothing about a thing in front."""
    rng = np.random.default_rng(3)
    true, box, pose, owner = seen(25, 40, rng)
    found = solved(hide(box, rng.random(len(box)) < 0.1, 2, np.full(len(box), -0.4)), pose, owner, true)
    assert np.mean(found.hidden > 0) < 0.02


@pytest.mark.parametrize("edges", [(0,), (0, 2)])
def test_a_covariance_holds_the_centre_if_edges_are_never_seen(edges):
    """From everywhere, a share of 0 to 60 % is hidden beyond the same edges, and it is known which. The box may tell little
    of the place then, and the sigma says so."""
    rng = np.random.default_rng(4)
    true, box, pose, owner = seen(40, 24, rng)
    bound = np.zeros((len(box), 4), dtype=bool)
    for edge in edges:
        box = hide(box, np.ones(len(box), dtype=bool), edge, rng.uniform(0, 0.6 / len(edges), 40)[owner])
        bound[:, edge] = True
    found = solved(box, pose, owner, true, bound=bound)
    assert inside(found, true).mean() > 0.85
    assert np.median(off(found, true)) < 0.15


def test_one_edge_tells_the_direction_to_the_centre():
    """The visible edge of an exact box and a known body give the direction to its centre, whatever is hidden."""
    rng = np.random.default_rng(5)
    true = random_bodies(6, rng)
    for one in true:
        box, pose = views_of(CAMERA, one, 10, rng)
        for edge in range(4):
            short = hide(box, np.ones(10, dtype=bool), edge, rng.uniform(0.1, 0.5, 10))
            edges = edges_of(CAMERA, short, pose, np.zeros(10, dtype=int))
            bound = np.zeros((10, 4), dtype=bool)
            bound[:, edge] = True
            ray, _ = undistort(CAMERA, (short[:, :2] + short[:, 2:]) / 2)
            edges = replace(edges, bound=bound, direction=np.einsum("bij,bj->bi", pose[:, :3, :3], ray))
            shift = shifts_of(edges, residuals(edges, one[None], ELLIPSOID))
            turned = edges.direction + directions_to_centres(edges, one[None, :3], shift)
            towards = one[:3] - edges.origin
            angle = np.linalg.norm(np.cross(turned, towards), axis=1) / np.linalg.norm(towards, axis=1)
            miss = np.linalg.norm(np.cross(edges.direction, towards), axis=1) / np.linalg.norm(towards, axis=1)
            assert (angle < 0.1 * miss + 2e-3).all()


def test_an_end_that_no_box_shows_may_be_anywhere_beyond():
    """Something hides one end of each thing from all sides that are seen, and a tenth of the boxes do not show what hides
    it. Then the visible part fits well, and its centre is far off. Without its bounds, the same centre would look exact."""
    rng = np.random.default_rng(5)
    true, box, pose, owner = seen(25, 40, rng)
    front = behind(pose, 1.2)
    box, pose, owner = box[front], pose[front], owner[front]
    short, bound = hide(box, np.ones(len(box), bool), 2, np.full(len(box), 0.35)), np.zeros((len(box), 4), dtype=bool)
    bound[:, 2] = rng.random(len(box)) < 0.9
    found = solved(short, pose, owner, true, bound=bound)
    assert np.median(off(found, true)) > 0.05
    assert inside(found, true).mean() > 0.85
    assert inside(solved(short, pose, owner, true), true).mean() < 0.5

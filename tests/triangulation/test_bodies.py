"""Bodies from boxes: exact without noise, honest with noise, and no more shape than the boxes carry."""

import numpy as np
import pytest
from outlines import from_axes
from triangulation.true_boxes import (
    CAMERAS,
    box_around,
    boxes_of_outlines,
    corner_box,
    corners_of,
    edges_of,
    inside,
    looking_at,
    outline_box,
    random_bodies,
    ring_of,
    solved,
    views_of,
)

from objslam.core.bodies.body import SHAPES
from objslam.core.camera import project
from objslam.mapping.bodies.fitting import repeated_error
from objslam.triangulation.bodies.choice import shapes_disagree, with_shares_of_shapes
from objslam.triangulation.bodies.edges import BoxEdges, contacts
from objslam.triangulation.bodies.fit import Prior, Weights, fit, sums_of_products
from objslam.triangulation.bodies.prior import label_prior, weak_prior
from objslam.triangulation.bodies.residuals import edge_gaps, nominal_noise, residuals, touched_points
from objslam.triangulation.bodies.shapes import CUBOID, CYLINDER, ELLIPSOID
from objslam.triangulation.bodies.shared import covariance_of, sides_of


def plain(count):
    """Weights of one, without robustness."""
    return Weights(np.ones((count, 5)), np.ones((count, 5)), robust=False)


@pytest.mark.parametrize(("each", "shuffled"), [(3, False), (40, False), (40, True)])
def test_products_are_summed_over_the_boxes_of_each_body(each, shuffled):
    rng = np.random.default_rng(3)
    body = np.repeat([0, 1, 3], [each, 2 * each, each])  # Body 2 has no box.
    body = rng.permutation(body) if shuffled else body
    one, other = rng.normal(size=(len(body), 5, 7)), rng.normal(size=(len(body), 5, 8))
    expected = [np.einsum("bri,brj->ij", one[body == j], other[body == j]) for j in range(4)]
    np.testing.assert_allclose(sums_of_products(body, one, other, 4), expected, atol=1e-12)


@pytest.mark.parametrize("lens", CAMERAS)
def test_true_ellipsoids_are_found_from_their_boxes(lens):
    rng, camera = np.random.default_rng(1), CAMERAS[lens]
    true = random_bodies(8, rng)
    views = [views_of(camera, body, 10, rng) for body in true]
    boxes, poses = (np.concatenate(part) for part in zip(*views, strict=True))
    body = np.repeat(np.arange(8), 10)
    values = true + rng.normal(0, 0.05, true.shape)
    prior, contact = Prior(values, np.tile(1e-12 * np.eye(7), (8, 1, 1))), None
    for _ in range(1 if lens == "pinhole" else 6):  # The contacts converge by a factor of about 50.
        edges = edges_of(camera, boxes, poses, body, contact=contact)
        values = fit(edges, values, prior, plain(len(body)), ELLIPSOID).values
        contact = contacts(camera, boxes, poses, edge_gaps(edges, values, ELLIPSOID)[2][:, :, None])
    assert np.abs(values - true).max() < 1e-6


def test_a_true_cuboid_is_found_from_its_boxes():
    rng, camera = np.random.default_rng(2), CAMERAS["pinhole"]
    centre, half, yaw = np.array([0.2, -0.1, 0.3]), np.array([0.5, 0.3, 0.4]), 0.5
    poses = [
        looking_at(centre + d * np.array([np.cos(a), np.sin(a), 0.4]), centre + rng.normal(0, 0.1, 3))
        for a, d in zip(rng.uniform(0, 6, 20), rng.uniform(2, 4, 20), strict=True)
    ]
    boxes = np.array([corner_box(camera, centre, half, yaw, pose) for pose in poses])
    edges = edges_of(camera, boxes, np.array(poses), np.zeros(20, dtype=int))
    start = np.array([[0.25, -0.05, 0.2, -1.0, 0.1, 0.3, -1.0]])
    found = fit(edges, start, Prior(start, 1e-12 * np.eye(7)[None]), plain(20), CUBOID).values
    assert np.abs(found[0, :3] - centre).max() < 1e-6
    assert np.abs(CUBOID.half_axes(found)[0] - half).max() < 1e-6
    assert abs(CUBOID.heading(found)[0] - yaw) < 1e-6


@pytest.mark.parametrize("shape", ["cuboid", "cylinder"])
def test_straight_sides_are_curved_in_a_wide_lens(shape):
    """A box touches the curved image of an upright side in its middle, and not at a corner."""
    rng, camera, kind = np.random.default_rng(2), CAMERAS["equidistant"], {"cuboid": CUBOID, "cylinder": CYLINDER}[shape]
    centre, half, yaw = np.array([0.2, -0.1, 0.3]), np.array([0.35, 0.25, 0.9]), 0.5
    height = np.linspace(-1, 1, 201)[:, None, None]
    rim = corners_of(half, yaw)[::2] if shape == "cuboid" else ring_of(half)[:40]
    if shape == "cuboid":  # The straight sides at the top and at the bottom are curved too.
        rim = np.concatenate([a + np.linspace(0, 1, 101)[:, None] * (b - a) for a in rim for b in rim])
    surface = centre + (rim * [1, 1, 0] + height * [0, 0, half[2]]).reshape(-1, 3)
    poses = np.array(
        [
            looking_at(centre + d * np.array([np.cos(a), np.sin(a), 0.1]), centre + rng.normal(0, 0.6, 3))
            for a, d in zip(rng.uniform(0, 6, 20), rng.uniform(1.6, 3, 20), strict=True)
        ]
    )
    boxes = np.array([box_around(camera, surface, pose) for pose in poses])
    start = np.array([[0.25, -0.05, 0.2, -1.0, 0.1, 0.3, -0.3]])
    values, prior, contact = start, Prior(start, 1e-12 * np.eye(7)[None]), None
    for _ in range(8):
        edges = edges_of(camera, boxes, poses, np.zeros(20, dtype=int), contact=contact)
        values = fit(edges, values, prior, plain(20), kind).values
        contact = contacts(camera, boxes, poses, touched_points(edges, values, np.array([SHAPES.index(shape)])))
    assert np.abs(values[0, :3] - centre).max() < 3e-3
    np.testing.assert_allclose(kind.half_axes(values)[0], half, rtol=0.02)


@pytest.mark.parametrize("kind", [ELLIPSOID, CUBOID, CYLINDER])
def test_the_derivatives_are_those_of_differences(kind):
    rng = np.random.default_rng(3)
    normal, place = rng.normal(size=(200, 4, 3)), 3 * rng.normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    towards = -place + 0.2 * rng.normal(size=(200, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    at = np.array([[0.1, 0.2, -0.1, -0.5, 0.3, 0.4, -0.9]])
    far = np.linalg.norm(place, axis=1) > 1.5
    none, one = np.zeros((200, 4), dtype=bool), np.ones(200)
    edges = BoxEdges(
        np.zeros(200, dtype=int), place, normal, none + 0.002, one, 0 * one, none, one, towards, one + 1, one, 0 * one
    ).take(far)
    found = residuals(edges, at, kind)
    _, by_gap, _ = edge_gaps(edges, at, kind)
    slope = kind.axes_jacobian(at)[0]
    for k in range(7):
        step = 1e-6 * np.eye(7)[k]
        ahead, behind = edge_gaps(edges, at + step, kind)[0], edge_gaps(edges, at - step, kind)[0]
        assert np.abs((ahead - behind) / 2e-6 - by_gap[..., k]).max() < 1e-6
        ahead, behind = residuals(edges, at + step, kind), residuals(edges, at - step, kind)
        same = (ahead.use[:, 4] > 0) & (behind.use[:, 4] > 0)
        off = np.abs((ahead.value - behind.value)[:, 4] / 2e-6 - found.by[:, 4, k])[same]
        assert np.quantile(off, 0.95) < 1e-5
        sides = [np.append(kind.half_axes(at + s)[0], kind.heading(at + s)) for s in (step, -step)]
        assert np.abs((sides[0] - sides[1]) / 2e-6 - slope[3:, k]).max() < 1e-6
    assert found.use[:, 4].mean() > 0.5


def test_the_covariance_is_that_of_repeated_boxes():
    rng, camera, many = np.random.default_rng(4), CAMERAS["pinhole"], 1000
    true = from_axes(np.zeros((1, 3)), np.array([[0.5, 0.25, 0.35]]), np.array([0.6]))
    boxes, poses = views_of(camera, true[0], 30, rng, arc=2.5)
    body = np.repeat(np.arange(many), 30)
    noisy = np.tile(boxes, (many, 1)) + rng.normal(0, 2, (30 * many, 4))
    edges = edges_of(camera, noisy, np.tile(poses, (many, 1, 1)), body, sigma=2.0)
    prior = weak_prior(np.zeros((many, 3)), np.tile([[0.35, 0.35]], (many, 1)))
    sigma = nominal_noise(edges)
    found = fit(edges, prior.mean, prior, Weights(sigma**2, sigma), ELLIPSOID)
    told = covariance_of(edges, found, sides_of(edges, prior.mean[:, :3]), np.ones(2), np.zeros(2)).mean(axis=0)
    root = np.linalg.cholesky(told)
    spread = np.linalg.solve(root, np.linalg.solve(root, np.cov(found.values.T)).T)
    assert np.abs(np.sqrt(np.linalg.eigvalsh(spread)) - 1).max() < 0.1


def test_the_error_that_boxes_of_one_side_share_is_found():
    """Shifts of 8 % of half the size for each side, and none of the sizes. Half of the bodies have few sides."""
    rng, camera, share, each = np.random.default_rng(7), CAMERAS["pinhole"], 0.08, 30
    true = random_bodies(24, rng)
    views = [views_of(camera, body, each, rng, arc=1.0 if i % 2 else 2 * np.pi) for i, body in enumerate(true)]
    boxes, poses = (np.concatenate(part) for part in zip(*views, strict=True))
    body = np.repeat(np.arange(24), each)
    edges = edges_of(camera, boxes, poses, body)
    sides = sides_of(edges, true[:, :3])
    error = [rng.multivariate_normal(np.zeros(len(a)), a, 2).T for a in sides.alike]
    shift = share * edges.size[:, None] / 2 * np.concatenate(error)[sides.cell]
    noisy = boxes + np.tile(shift, 2) + rng.normal(0, 2, boxes.shape)
    found = solved(camera, noisy, poses, true[:, :3], np.full((24, 2), 0.3))
    assert found.share[0] == pytest.approx(share, rel=0.25)
    assert found.share[1] < 0.3 * share


def test_boxes_that_grow_do_not_tell_the_distance_better_than_outlines_allow():
    """On a straight way to a thing, sizes err by 5 %, and by 5 % more or less at a distance larger by the factor e."""
    rng, camera, many, each, share = np.random.default_rng(3), CAMERAS["pinhole"], 400, 20, 0.05
    true = from_axes(np.zeros((1, 3)), np.array([[0.2, 0.2, 0.4]]), np.zeros(1))
    away = np.linspace(6.0, 2.0, each)
    poses = np.array([looking_at(np.array([-x, 0.4, 0.3]), true[0, :3]) for x in away])
    boxes = np.array([outline_box(camera, true[0], pose) for pose in poses])
    distance = np.log(np.linalg.norm(poses[:, :3, 3], axis=1))
    half = np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1)) / 2
    error = rng.normal(size=(many, 1, 2)) + rng.normal(size=(many, 1, 2)) * (distance - distance.mean())[:, None]
    error = (share * half[:, None] * error).reshape(-1, 2)
    noisy = np.tile(boxes, (many, 1)) + np.concatenate([-error, error], axis=1) + rng.normal(0, 0.5, (each * many, 4))
    edges = edges_of(camera, noisy, np.tile(poses, (many, 1, 1)), np.repeat(np.arange(many), each), sigma=0.5)
    prior = weak_prior(np.zeros((many, 3)), np.tile([[0.2, 0.4]], (many, 1)))
    sigma = nominal_noise(edges)
    found = fit(edges, prior.mean, prior, Weights(sigma**2, sigma, robust=False), ELLIPSOID)
    told = covariance_of(edges, found, sides_of(edges, prior.mean[:, :3]), np.ones(2), np.array([0.0, share]))
    assert np.sqrt(told[:, 0, 0].mean()) == pytest.approx(found.values[:, 0].std(), rel=0.3)


def test_the_shape_is_chosen_by_what_the_boxes_show():
    rng, camera = np.random.default_rng(5), CAMERAS["pinhole"]
    ball = from_axes(np.zeros((1, 3)), np.full((1, 3), 0.3), np.zeros(1))[0]
    egg = from_axes(np.zeros((1, 3)), np.array([[0.5, 0.2, 0.3]]), np.array([0.7]))[0]
    poses = np.array(
        [looking_at(d * np.array([np.cos(a), np.sin(a), 0.3]), rng.normal(0, 0.1, 3)) for a, d in zip(
            rng.uniform(0, 5, 40), rng.uniform(2, 4, 40), strict=True)]
    )  # fmt: skip
    cuboid = [corner_box(camera, np.zeros(3), np.array([0.5, 0.2, 0.3]), 0.7, pose) for pose in poses]
    pixels = np.concatenate([project(camera, -pose[:3, 3][None] @ pose[:3, :3]) for pose in poses])
    free = rng.uniform(5, 150, (40, 2))
    label = np.concatenate([pixels - free, pixels + free], axis=1)  # boxes of any size
    things = (
        [outline_box(camera, ball, pose) for pose in poses],
        [outline_box(camera, egg, pose) for pose in poses],
        cuboid,
        label,
    )
    boxes = np.concatenate([np.array(one) for one in things]) + rng.normal(0, 2, (160, 4))
    found = solved(camera, boxes, np.tile(poses, (4, 1, 1)), np.zeros((4, 3)), np.full((4, 2), 0.3))
    assert [SHAPES[one] for one in found.shape] == ["sphere", "ellipsoid", "cuboid", "point"]
    assert np.abs(found.axes[1, 3:6] / [0.5, 0.2, 0.3] - 1).max() < 0.05
    assert np.abs(found.axes[2, 3:6] / [0.5, 0.2, 0.3] - 1).max() < 0.05


def test_from_one_side_the_depth_stays_near_its_prior_and_says_so():
    rng, camera = np.random.default_rng(6), CAMERAS["pinhole"]
    body = from_axes(np.zeros((1, 3)), np.array([[0.6, 0.15, 0.3]]), np.array([np.pi / 2]))[0]  # wide, and flat in depth
    boxes, poses = [], []
    for _ in range(40):
        a, d = rng.uniform(-0.08, 0.08), rng.uniform(1.5, 3.0)
        poses.append(looking_at(d * np.array([np.cos(a), np.sin(a), 0.05]), rng.normal(0, 0.1, 3)))
        boxes.append(outline_box(camera, body, poses[-1]))
    noisy = np.array(boxes) + rng.normal(0, 2, (40, 4))
    found = solved(camera, noisy, np.array(poses), np.zeros((1, 3)), np.array([[0.6, 0.3]]))
    covariance = found.slope[0] @ found.covariance[0] @ found.slope[0].T
    half, sigma = found.axes[0, 3:6], np.sqrt(np.diag(covariance))
    depth = int(np.argmax(sigma[3:5]))
    assert half.max() < 1.2
    assert half.min() > 0.05
    assert sigma[3 + depth] > 0.15 * half[depth]


def test_cuboids_and_cylinders_are_told_apart():
    rng, camera, many, each = np.random.default_rng(8), CAMERAS["pinhole"], 20, 24
    half = rng.uniform(0.15, 0.3, (many, 3))
    half[1::2, 1] = half[1::2, 0]
    outlines = [ring_of(h) if i % 2 else corners_of(h, rng.uniform(0, 3)) for i, h in enumerate(half)]
    boxes, poses = boxes_of_outlines(camera, outlines, rng, each, arc=2.0)
    true = np.column_stack([np.zeros((many, 2)), half[:, 2]])
    found = solved(camera, boxes, poses, true + rng.normal(0, 0.05, true.shape), np.full((many, 2), 0.25))
    off = found.axes[:, :3] - true
    assert [SHAPES[one] for one in found.shape] == ["cuboid", "cylinder"] * (many // 2)
    assert np.abs(off).max() < 0.015
    assert inside(off, found.centre_covariance) >= 0.9
    assert np.median(np.abs(found.axes[:, 5] / half[:, 2] - 1)) < 0.02


def turned_things(camera, bottom, top, arc):
    """Bodies of 30 round things, and the errors (30, 3) of their centres. bottom, top: their radii there, as shares."""
    rng, many = np.random.default_rng(8), 30
    half = np.column_stack([np.tile(rng.uniform(0.15, 0.3, (many, 1)), 2), rng.uniform(0.15, 0.4, many)])
    outlines = [ring_of(h) * np.repeat([[bottom, bottom, 1.0], [top, top, 1.0]], 40, axis=0) for h in half]
    boxes, poses = boxes_of_outlines(camera, outlines, rng, 24, arc)
    true = np.column_stack([np.zeros((many, 2)), half[:, 2]])
    found = solved(camera, boxes, poses, true + rng.normal(0, 0.05, true.shape), np.full((many, 2), 0.25))
    return found, found.axes[:, :3] - true


def test_no_shape_is_surer_than_the_choice_between_shapes():
    """A pot is wider at its top. A cylinder and an ellipsoid fit it about equally well, at two heights."""
    found, off = turned_things(CAMERAS["pinhole"], 0.6, 1.0, arc=0.6)
    assert inside(off, found.covariance[:, :3, :3]) < 0.8
    assert inside(off, found.centre_covariance) >= 0.9


def test_a_shape_that_is_not_tried_lies_within_its_sigma():
    """Cones: all come out as cylinders, whose centres are too low. Their sigma has the error that repeats from all sides."""
    found, off = turned_things(CAMERAS["pinhole"], 1.0, 0.2, arc=2.0)
    repeated = np.array([repeated_error(found.share[0], axes) for axes in found.axes[:, 3:6]])
    assert inside(off, found.centre_covariance) < 0.7
    assert inside(off, found.centre_covariance + repeated[:, None, None] ** 2 * np.eye(3)) >= 0.9


def test_the_spread_of_shapes_is_that_of_a_mixture():
    """Draws of the shapes by their evidence have the second moment about the chosen shape."""
    rng = np.random.default_rng(9)
    evidence, axes, chosen = rng.normal(0, 1, (4, 1)), rng.normal(0, 1, (4, 1, 6)), np.array([2])
    told = shapes_disagree(evidence, axes, chosen)[0]
    chance = np.exp(evidence[:, 0]) / np.exp(evidence[:, 0]).sum()
    drawn = axes[rng.choice(4, 400_000, p=chance), 0] - axes[2, 0]
    assert np.abs(drawn.T @ drawn / len(drawn) - told).max() < 0.02


def test_the_shape_of_a_thing_is_judged_with_the_others_of_its_label():
    """The others are sure, so their shares are the Dirichlet-multinomial's, with all shapes equally usual before."""
    sure, open_ = np.array([0.0, 0.0, 30.0, 0.0, 0.0]), np.zeros(5)
    evidence, label = np.stack([open_, *[sure] * 4], axis=1), np.zeros(5, dtype=int)
    found = with_shares_of_shapes(evidence, label)
    whole = np.array([1.0, 1, 5, 1, 1]) / 9
    expected = np.array([0.0, 0, 4, 0, 0]) + 5 * whole
    assert np.abs(found[:, 0] - np.log(expected / expected.sum())).max() < 1e-6
    # Things of another label say less, and a hundred say no more than a few.
    other = with_shares_of_shapes(evidence, np.array([1, 0, 0, 0, 0]))
    assert 0 < other[2, 0] - other[3, 0] < found[2, 0] - found[3, 0]
    many = with_shares_of_shapes(np.stack([open_, *[sure] * 100], axis=1), np.zeros(101, dtype=int))
    assert many[2, 0] - many[3, 0] == pytest.approx(np.log((6 + 5 * 7 / 11) / (5 / 11)))
    assert np.ptp(with_shares_of_shapes(np.zeros((5, 7)), np.arange(7))) < 1e-9


def test_wrong_boxes_of_one_body_do_not_make_all_outlines_inexact():
    """A half of the boxes of one of 24 bodies, all from one side, are those of a thing that looks twice as large."""
    rng, camera, each = np.random.default_rng(8), CAMERAS["pinhole"], 30
    true = random_bodies(24, rng)
    views = [views_of(camera, body, each, rng, arc=1.0 if i % 2 else 2 * np.pi) for i, body in enumerate(true)]
    boxes, poses = (np.concatenate(part) for part in zip(*views, strict=True))
    noisy = boxes + rng.normal(0, 2, boxes.shape)
    clean = solved(camera, noisy, poses, true[:, :3], np.full((24, 2), 0.3))
    wrong = noisy[: each // 2]
    middle, half = (wrong[:, :2] + wrong[:, 2:]) / 2, wrong[:, 2:] - wrong[:, :2]
    noisy[: each // 2] = np.concatenate([middle - half, middle + half], axis=1)
    found = solved(camera, noisy, poses, true[:, :3], np.full((24, 2), 0.3))
    assert found.share[1] < clean.share[1] + 0.02


def test_sizes_that_no_box_shows_are_no_sizes_of_their_label():
    """The boxes of forty bodies show their heights, of 2 m, and nothing about their lengths and widths."""
    weak = weak_prior(np.zeros((40, 3)), np.tile([[0.3, 0.9]], (40, 1)))
    values, told = weak.mean.copy(), np.linalg.inv(weak.information)
    values[:, 6], told[:, 6, 6] = np.log(1.0), 0.05**2
    found = label_prior(weak, weak, values, told, np.zeros(40, dtype=int), np.zeros(40, dtype=bool))
    sigma = np.sqrt(1 / np.einsum("nii->ni", found.information))[0]
    before = np.sqrt(1 / np.einsum("nii->ni", weak.information))[0]
    assert sigma[4:6] == pytest.approx(before[4:6])
    assert sigma[3] == pytest.approx(before[3], rel=0.1)
    assert found.mean[0, 3:6] == pytest.approx(weak.mean[0, 3:6], abs=0.01)
    assert found.mean[0, 6] == pytest.approx(np.log(1.0), abs=0.02)
    assert sigma[6] < 0.25


def test_sizes_that_boxes_show_are_sizes_of_their_label():
    """Forty plates of one size, each seen from all sides."""
    rng = np.random.default_rng(5)
    weak = weak_prior(np.zeros((40, 3)), np.tile([[0.3, 0.9]], (40, 1)))
    values, told = weak.mean.copy(), np.tile(0.02**2 * np.eye(7), (40, 1, 1))
    yaw = rng.uniform(0, np.pi, 40)
    values[:, 3:] = np.column_stack([np.full(40, -1.5), 1.2 * np.cos(2 * yaw), 1.2 * np.sin(2 * yaw), np.zeros(40)])
    values[:, 3:] += rng.normal(0, 0.02, (40, 4))
    found = label_prior(weak, weak, values, told, np.zeros(40, dtype=int), np.zeros(40, dtype=bool))
    sigma = np.sqrt(1 / np.einsum("nii->ni", found.information))[0]
    assert found.mean[0, [3, 6]] == pytest.approx([-1.5, 0.0], abs=0.05)
    assert (sigma[[3, 6]] < 0.25).all()
    assert sigma[4] == pytest.approx(1.2 / np.sqrt(2), rel=0.1)

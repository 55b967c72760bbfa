"""Where the centre of the box around a body is: against outlines of ellipsoids, images of corners, and Monte Carlo."""

import numpy as np
import pytest
from outlines import from_axes, looking_at, outline_box

from objslam.core.bodies.body import SHAPES
from objslam.core.bodies.box_centres import beside_centres, image_axes
from objslam.core.camera import Camera, project, undistort
from objslam.core.geometry import make_pose
from objslam.core.rotation import rotation_from_vector

MATRIX = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
PINHOLE = Camera("front", 640, 480, MATRIX)
FISHEYE = Camera("wide", 640, 480, MATRIX * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]], "equidistant", np.zeros(4))
RIMS = np.array([[np.cos(a), np.sin(a), z] for a in np.linspace(0, 2 * np.pi, 320, endpoint=False) for z in (-1, 1)])
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def views(count):
    """Cameras that look beside bodies: poses, centres, half axes and yaws."""
    rng = np.random.default_rng(4)
    centre, half = rng.normal(0, 0.3, (count, 3)), rng.uniform(0.2, 0.6, (count, 3))
    place = rng.normal([3.0, 0, 0.5], 0.4, (count, 3))
    poses = np.array([looking_at(one, rng.normal(0, 0.6, 3)) for one in place])
    tilt = make_pose(rotation_from_vector(rng.normal(0, 0.2, (count, 3))), np.zeros((count, 3)))
    return poses @ tilt, centre, half, rng.uniform(-1.5, 1.5, count)


def points(camera, poses, centre, half, yaw, shape):
    """Directions (n, 3) to the centres of the boxes in the camera frame, by the functions under test."""
    to, fisheye = centre - poses[:, :3, 3], np.full(len(yaw), camera.fisheye)
    axes = image_axes(poses[:, :3, :3], to, fisheye)
    found = to + beside_centres(axes, to, half, yaw, np.full(len(yaw), SHAPES.index(shape)), np.zeros((len(yaw), 4, 4)))[0]
    return np.einsum("nji,nj->ni", poses[:, :3, :3], found / np.linalg.norm(found, axis=1, keepdims=True))


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))


@pytest.mark.parametrize(("camera", "share"), [(PINHOLE, 1e-4), (FISHEYE, 0.4)])
def test_the_box_of_an_ellipsoid(camera, share):
    """What is left of the difference between centre and box. A fisheye bends the edges, so more is left."""
    poses, centre, half, yaw = views(40)
    boxes = [outline_box(camera, *one) for one in zip(from_axes(centre, half, yaw), poses, strict=True)]
    true, _ = undistort(camera, np.array([(box[:2] + box[2:]) / 2 for box in boxes]))
    off = angle(points(camera, poses, centre, half, yaw, "ellipsoid"), true)
    before = angle(np.einsum("nji,nj->ni", poses[:, :3, :3], centre - poses[:, :3, 3]), true)
    assert np.median(before) > np.radians(0.1)
    assert np.sqrt(np.mean(off**2)) < share * np.sqrt(np.mean(before**2))


@pytest.mark.parametrize(("shape", "outline", "off"), [("cuboid", CORNERS, 1e-6), ("cylinder", RIMS, 3.0)])
def test_the_box_of_a_body_with_edges_goes_around_them(shape, outline, off):
    """The rims of a true cylinder have 20 times more points than the function uses."""
    poses, centre, half, yaw = views(40)
    found = project(PINHOLE, points(PINHOLE, poses, centre, half, yaw, shape))
    middle, away = [], []
    for pose, c, h, turn in zip(poses, centre, half, yaw, strict=True):
        rotation = rotation_from_vector(np.array([[0.0, 0.0, turn]]))[0]
        pixels = project(PINHOLE, (c + (outline * h) @ rotation.T - pose[:3, 3]) @ pose[:3, :3])
        middle.append((pixels.min(axis=0) + pixels.max(axis=0)) / 2)
        away.append(project(PINHOLE, ((c - pose[:3, 3]) @ pose[:3, :3])[None])[0])
    error = np.abs(found - np.array(middle))
    assert error.max() < off
    assert np.median(error) < 0.05 * np.median(np.abs(np.array(away) - np.array(middle)))


@pytest.mark.parametrize("shape", ["ellipsoid", "cuboid", "cylinder"])
def test_a_body_around_the_camera_has_no_box(shape):
    poses, _, half, yaw = views(5)
    near, sigma = beside_centres(
        poses[:, :3, :3], 0.5 * half, half, yaw, np.full(5, SHAPES.index(shape)), np.ones((5, 4, 4))
    )
    np.testing.assert_array_equal(near, 0.0)
    np.testing.assert_array_equal(sigma, 0.0)


@pytest.mark.parametrize("shape", ["ellipsoid", "cuboid", "cylinder"])
def test_the_noise_is_that_of_sizes_and_yaw(shape):
    rng = np.random.default_rng(1)
    poses, centre, half, yaw = views(6)
    root = 0.003 * rng.normal(size=(6, 4, 4))
    spread, to, kind = root @ np.swapaxes(root, 1, 2), centre - poses[:, :3, 3], np.full(6, SHAPES.index(shape))
    found, sigma = beside_centres(poses[:, :3, :3], to, half, yaw, kind, spread)
    drawn = []
    for _ in range(1500):
        off = np.einsum("nij,nj->ni", root, rng.normal(size=(6, 4)))
        drawn.append(beside_centres(poses[:, :3, :3], to, half + off[:, :3], yaw + off[:, 3], kind, spread)[0])
    away = np.array(drawn) - found
    along = to / np.linalg.norm(to, axis=1, keepdims=True)
    away -= (away * along).sum(axis=2, keepdims=True) * along
    np.testing.assert_allclose(sigma, np.sqrt((away**2).sum(axis=2).mean(axis=0) / 2), rtol=0.15)

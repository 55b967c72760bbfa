"""Boxes of ellipsoids and cuboids by their outlines, without the tangent planes that the fit uses."""

import numpy as np
from outlines import from_axes, looking_at, outline_box

from objslam.core.camera import Camera, project
from objslam.triangulation.bodies.edges import BoxEdges, tangent_planes
from objslam.triangulation.bodies.solve import solve_bodies

CAMERAS = {
    "pinhole": Camera("c", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])),
    "plumb_bob": Camera(
        "c",
        640,
        480,
        np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]),
        distortion=np.array([-0.28, 0.08, 0.001, -0.0005, 0.0]),
    ),
    "equidistant": Camera(
        "c",
        640,
        480,
        np.array([[250.0, 0, 320], [0, 250, 240], [0, 0, 1]]),
        "equidistant",
        np.array([-0.01, 0.003, 0.0, 0.0]),
    ),
}


def corners_of(half, yaw):
    """The corners (8, 3) of a cuboid around the origin."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    cos, sin = np.cos(yaw), np.sin(yaw)
    return signs * half @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


def ring_of(half):
    """Points (80, 3) on the rims of an upright cylinder around the origin."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rim = np.column_stack([half[0] * np.cos(angle), half[1] * np.sin(angle)])
    return np.concatenate([np.column_stack([rim, np.full(40, z)]) for z in (-half[2], half[2])])


def box_around(camera, points, pose):
    """The box around the images of points (P, 3) in a pinhole, None if one is not in front of the camera."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    if local[:, 2].min() < 0.05:
        return None
    pixels = project(camera, local)
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def corner_box(camera, centre, half, yaw, pose):
    """The box around the image of a cuboid, by its corners in a pinhole."""
    return box_around(camera, centre + corners_of(half, yaw), pose)


def random_bodies(count, rng):
    """Ellipsoids of 0.1 to 1.4 m around the origin."""
    half = np.exp(rng.uniform(np.log(0.05), np.log(0.7), (count, 3)))
    return from_axes(rng.uniform(-0.3, 0.3, (count, 3)), half, rng.uniform(-1.5, 1.5, count))


def views_of(camera, body, count, rng, arc=2 * np.pi):
    """Boxes (count, 4) of an ellipsoid and the poses (count, 4, 4) that see it, at 1.6 to 4 m over an arc of azimuths."""
    boxes, poses = [], []
    while len(boxes) < count:
        azimuth, distance = rng.uniform(0, arc), rng.uniform(1.6, 4)
        place = body[:3] + distance * np.array([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.2, 0.6)])
        pose = looking_at(place, body[:3] + rng.uniform(-0.3, 0.3, 3))
        box = outline_box(camera, body, pose)
        if box is not None:
            boxes.append(box)
            poses.append(pose)
    return np.array(boxes), np.array(poses)


def edges_of(camera, boxes, poses, body, sigma=1.0, contact=None):
    """The edges of boxes of bodies (B,), without ranges."""
    normal, turn, good = tangent_planes(camera, boxes, poses, contact)
    assert good.all()
    count = len(boxes)
    size = np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1))
    none, unknown = np.zeros((count, 4), dtype=bool), np.full(count, np.nan)
    flat = np.zeros(count)
    return BoxEdges(
        body,
        poses[:, :3, 3],
        normal,
        turn,
        np.full(count, sigma),
        flat,
        none,
        size,
        np.zeros((count, 3)),
        unknown,
        flat + 1,
        flat,
    )


def boxes_of_outlines(camera, outlines, rng, each, arc):
    """Boxes with a noise of 2 px of upright things on the floor, and the poses, as a robot sees them from a height of 0.7 m.

    outlines: points (P, 3) of each thing around its centre.
    """
    boxes, poses = [], []
    for outline in outlines:
        centre, start = np.array([0.0, 0.0, -outline[:, 2].min()]), rng.uniform(0, 6)
        for azimuth in start + np.linspace(0, arc, each):
            away = rng.uniform(2, 4)
            poses.append(looking_at(np.array([away * np.cos(azimuth), away * np.sin(azimuth), 0.7]), centre))
            boxes.append(box_around(camera, centre + outline, poses[-1]))
    return np.array(boxes) + rng.normal(0, 2, (len(boxes), 4)), np.array(poses)


def solved(camera, boxes, poses, points, half):
    """The bodies of as many objects as points, whose boxes come in their order."""
    body = np.repeat(np.arange(len(points)), len(boxes) // len(points))
    side = np.full(len(boxes), 277.0)
    return solve_bodies(
        lambda _: edges_of(camera, boxes, poses, body, sigma=2.0),
        points,
        half,
        ("thing",) * len(points),
        side=side,
        share=0.05,
        bent=False,
    )


def inside(off, covariance):
    """The share of errors (N, 3) inside the 95 % ellipsoids of covariances (N, 3, 3)."""
    return np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off) < 7.81)

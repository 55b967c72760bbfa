"""Simulated drives among things that hide each other in part, as logs with boxes of the visible parts and a truth.

All solids stand on the floor, and no two touch, so a line on the floor separates each pair. The solid on the camera's side
of the line is in front. The images of all solids are drawn from the front to the back, and each box goes around the pixels
that no solid in front covers. So the boxes know nothing of the bodies that objslam fits.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from mapping.body_drives import FORWARD, drifting_odometry

from objslam.core.camera import Camera
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject

CAMERA = Camera("front", 640, 480, np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]]), base_T_camera=FORWARD)
LEAST_SHOWN = 0.3
"""The least visible share of a thing's image that has a box. With a smaller share, detectors see things that hardly show."""
_NEAREST = 0.05  # m, the least depth of a drawn point.
_FINE = 16  # The pixels of `fillConvexPoly` are divided into this number of parts.
_AROUND = np.linspace(0, 2 * np.pi, 32, endpoint=False)
_RING = np.column_stack([np.cos(_AROUND), np.sin(_AROUND)])


@dataclass(frozen=True)
class Solid:
    """An upright solid on the floor. label: None for one without boxes, such as a pillar. centre: (3,) m. half: (3,) m."""

    shape: str
    label: str | None
    centre: np.ndarray
    half: np.ndarray
    yaw: float

    def turned(self, flat):
        """Points (P, 2) in half axes, in map."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return self.centre[:2] + (flat * self.half[:2]) @ np.array([[cos, sin], [-sin, cos]])

    @cached_property
    def footprint(self):
        """The convex outline (P, 2), m, on the floor."""
        return self.turned(np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) if self.shape == "cuboid" else _RING)

    @cached_property
    def points(self):
        """Points (P, 3), m, whose convex hull is the solid."""
        levels = ((-1.0, 1.0), (1.0, 1.0))
        if self.shape == "ellipsoid":
            levels = tuple((np.sin(a), np.cos(a)) for a in np.linspace(-1.5, 1.5, 17))
        flat = self.footprint - self.centre[:2]
        return np.concatenate(
            [np.column_stack([self.centre[:2] + flat * wide, np.full(len(flat), self.centre[2] + z * self.half[2])])
             for z, wide in levels]
        )  # fmt: skip


def separations(first, second, gap=0.0):
    """The lines (normal (2,), offset, gap) along edges of two footprints that separate them by more than a gap, m."""
    for sign, polygon, other in ((1, first, second), (-1, second, first)):
        along = np.roll(polygon, -1, axis=0) - polygon
        centred = polygon - polygon.mean(axis=0)
        for normal in np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]:
            side = centred @ normal
            if side.max() < -side.min():
                normal = -normal
            here, there = (polygon @ normal).max(), (other @ normal).min()
            if there - here > gap:
                yield sign * normal, sign * (here + there) / 2, there - here


def apart(first, second):
    """The line of `separations` with the largest gap, None if there is none."""
    return max(separations(first, second), key=lambda line: line[2], default=None)


def lines_between(solids):
    """The line of `apart` between each two solids, by their numbers."""
    return {(i, j): apart(solids[i].footprint, solids[j].footprint) for j in range(len(solids)) for i in range(j)}


def front_to_back(solids, lines, place):
    """The solids' numbers from the front to the back, seen from a place (2,) on the floor."""
    behind = np.zeros((len(solids), len(solids)), dtype=bool)
    for (i, j), (normal, offset, _) in lines.items():
        first = place @ normal < offset  # The camera is on the side of i.
        behind[(j, i) if first else (i, j)] = True
    left, order = list(range(len(solids))), []
    while left:
        free = [i for i in left if not behind[i, left].any()] or left  # There may be a circle, which is cut anywhere.
        order.append(min(free, key=lambda i: np.linalg.norm(solids[i].centre[:2] - place)))
        left.remove(order[-1])
    return order


def image_of(points, pose):
    """The convex outline (P, 2), px, of the image of points (P, 3), without what is behind the camera. None if nothing is
    left."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = local[:, 2] >= _NEAREST
    if not ahead.any():
        return None
    if not ahead.all():
        a, b = local[ahead][:, None], local[~ahead][None]
        share = (a[..., 2:] - _NEAREST) / (a[..., 2:] - b[..., 2:])
        local = np.concatenate([local[ahead], (a + share * (b - a)).reshape(-1, 3)])
    pixel = local[:, :2] / local[:, 2:] * np.diag(CAMERA.matrix)[:2] + CAMERA.matrix[:2, 2]
    return cv2.convexHull(np.clip(pixel, -3e4, 3e4).astype(np.float32))[:, 0]


def boxes_at(solids, lines, pose, *, hiding=True):
    """The solids with boxes in one image, and their exact boxes (n, 4), px.

    hiding: whether the boxes go around the visible parts only. Otherwise each solid is as if it were alone.
    """
    covered, found = np.zeros((480, 640), dtype=np.uint8), []
    for i in front_to_back(solids, lines, pose[:2, 3]):
        outline = image_of(solids[i].points, pose)
        if outline is None:
            continue
        part = np.maximum(outline.min(axis=0).astype(int) - 2, 0), outline.max(axis=0).astype(int) + 3
        left, top = part[0].tolist()
        covers = covered[top : max(part[1][1], 0), left : max(part[1][0], 0)]  # The rest of the image stays as it is.
        own = np.zeros_like(covers)
        if own.size:
            cv2.fillConvexPoly(own, np.round(_FINE * (outline - 0.5 - part[0])).astype(np.int32), 1, shift=4)
        shown = own & ~covers & 1 if hiding else own
        if solids[i].label is not None and own.sum() > 50 and shown.sum() >= LEAST_SHOWN * own.sum():
            x, y = left + np.flatnonzero(shown.any(axis=0)), top + np.flatnonzero(shown.any(axis=1))
            found.append((i, [x[0], y[0], x[-1] + 1, y[-1] + 1]))
        covers |= own
    return [i for i, _ in found], np.array([box for _, box in found], dtype=float).reshape(-1, 4)


def scene(rng, *, groups=7, pillars=False):
    """Groups of two or three things around the origin, of 0.3 to 1.5 m, the front ones nearer to the middle.

    pillars: whether posts and ends of walls without a box stand in place of the front things.
    """
    solids, footprints = [], []

    def place(label, at, size, shape):
        for _ in range(60):
            half = np.clip(size * np.exp(rng.normal(0, 0.25, 3)), 0.3, 1.5) / 2
            if label is None:
                half = np.array([*rng.uniform([0.05, 0.05], [0.1, 0.25]), 1.2])
            where = at + rng.normal(0, 0.25, 2)
            one = Solid(shape, label, np.array([*where, half[2]]), half, float(rng.uniform(-1.5, 1.5)))
            here = one.footprint
            near = np.linalg.norm(here / [2.2, 1.8], axis=1).min() < 1.15
            if not near and all(any(map(bool, separations(here, other, 0.08))) for other in footprints):
                solids.append(one)
                footprints.append(here)
                return

    for turn in np.linspace(0, 2 * np.pi, groups, endpoint=False) + rng.uniform(0, 1):
        toward = np.array([np.cos(turn), np.sin(turn)])
        labels = rng.permutation(["cabinet", "chair", "bin"])
        for far, label, wide in ((1.75, labels[0], 0.9), (1.5, labels[1], 0.6), (1.35, labels[2], 0.45)):
            shape = str(rng.choice(["cuboid", "cylinder", "ellipsoid"]))
            if pillars and far < 1.7:
                label, shape = None, "cuboid"
            beside = rng.normal(0, 0.35) * np.array([-toward[1], toward[0]])
            place(None if label is None else str(label), far * toward * [2.3, 1.9] + beside, wide, shape)
    return solids


def desks(rng, number=6):
    """Desks of 1.4 m around the origin, and a chair before each, which hides a part of one end from most sides."""
    solids = []
    for turn in np.linspace(0, 2 * np.pi, number, endpoint=False) + rng.uniform(0, 1):
        toward, along = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        while True:
            at, yaw = rng.uniform(3.6, 4.2) * toward, float(turn + np.pi / 2 + rng.normal(0, 0.1))
            chair = at - 0.75 * toward + rng.uniform(-0.5, 0.5) * along
            pair = [
                Solid("cuboid", "desk", np.array([*at, 0.375]), np.array([0.7, 0.35, 0.375]), yaw),
                Solid("cuboid", "chair", np.array([*chair, 0.45]), np.array([0.25, 0.25, 0.45]), yaw),
            ]
            if None not in lines_between([*solids, *pair]).values():
                break
        solids += pair
    return solids


def aisle(rng, *, named=False):
    """Two rows of seven equal lockers along an aisle. named: whether each has a label of its own."""
    return [
        Solid("cuboid", f"locker {k}{side}" if named else "locker", np.array([1.3 * k, 2.2 * side + y, 0.95]), half, 0.0)
        for side, half in ((side, np.array([0.4, 0.25, 0.95])) for side in (-1, 1))
        for k, y in enumerate(rng.normal(0, 0.02, 7))
    ]


def along_aisle(frames=150):
    """Poses (F, 3) of three ways along the aisle, with turns at its ends."""
    corners = np.array([(-3, 0), (9, 0.1), (9.6, 0.4), (9, 0.7), (-3, 0.4), (-3.6, 0.1), (-3, -0.2), (9, -0.3)])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0, way[-1], frames)
    place = np.column_stack([np.interp(at, way, axis) for axis in corners.T])
    return np.column_stack([place, np.unwrap(np.arctan2(*np.gradient(place, axis=0).T[::-1]))])


def hiding_drive(seed, *, hiding=True, pillars=False, joint=False, frames=400, noise=2.0, solids=None, plane=None):
    """Two laps on an ellipse inside a ring of groups of things, with boxes of 2 px noise. plane: poses (F, 3) instead.

    The poses are a localisation with a noise of 1 cm and 0.2 degrees, or for joint mode drifting odometry. hiding: see
    `boxes_at`. solids: instead of those of `scene`. The same seed gives the same things, poses and noise of poses with
    hiding and without.
    """
    rng = np.random.default_rng(seed)
    solids = solids or scene(rng, pillars=pillars)
    lines = {
        (i, j): apart(solids[i].footprint, solids[j].footprint)
        for i in range(len(solids))
        for j in range(i + 1, len(solids))
    }
    if plane is None:
        turn = np.linspace(0, 4 * np.pi, frames)
        place = np.column_stack([1.8 * np.cos(turn), 1.5 * np.sin(turn)])
        yaw = np.unwrap(np.arctan2(*np.gradient(place, axis=0).T[::-1])) - 0.7 + 0.7 * np.sin(3.5 * turn)
        plane = np.column_stack([place, yaw])
    frames, stamps = len(plane), 0.2 * np.arange(len(plane))
    true = lift_se2(plane)
    odometry = drifting_odometry(true, rng)
    localised = lift_se2(plane + [0.01, 0.01, 0.0035] * rng.standard_normal((frames, 3)))
    found = [
        (k, *one)
        for k, pose in enumerate(true @ FORWARD)
        for one in zip(*boxes_at(solids, lines, pose, hiding=hiding), strict=True)
    ]
    frame, thing = (np.array([one[at] for one in found]) for at in (0, 1))
    box = np.array([one[2] for one in found])
    inside = np.concatenate([box[:, :2] > 0, box[:, 2:] < CAMERA.size], axis=1)
    box = np.clip(box + inside * rng.normal(0, noise, box.shape), 0, np.tile(CAMERA.size, 2))
    if joint:  # From odometry alone, a name for each thing leaves the association out of the comparison.
        solids = [one if one.label is None else replace(one, label=f"{one.label} {i}") for i, one in enumerate(solids)]
    names = tuple(sorted({s.label for s in solids if s.label is not None}))
    unknown = np.full(len(box), np.nan), np.full(len(box), -1)
    label = np.array([names.index(solids[i].label) for i in thing])
    detections = Detections(stamps, frame, box, label, np.ones(len(box)), *unknown, names)
    often = np.bincount(thing, minlength=len(solids))
    things = [
        TruthObject(i, s.label, s.centre, np.array([*np.sort(2 * s.half[:2])[::-1], 2 * s.half[2]]), long_yaw(s))
        for i, s in enumerate(solids)
        if s.label is not None and often[i] >= 8
    ]
    truth = Truth(tuple(things), Trajectory(stamps, true))
    path = {"odometry": Trajectory(stamps, np.array(odometry))} if joint else {"localization": Trajectory(stamps, localised)}
    return Log("hiding", (CameraLog(CAMERA, detections),), **path, truth=truth)


def long_yaw(solid):
    """The yaw, rad in (-pi/2, pi/2], of the longer horizontal axis."""
    yaw = solid.yaw + (np.pi / 2 if solid.half[1] > solid.half[0] else 0.0)
    return float(np.pi / 2 - (np.pi / 2 - yaw) % np.pi)

"""Draw pictures of a reconstruction without a screen or a GPU, by casting rays, with lines, rings and slices over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, make_pose
from objslam.core.result import Surface

BACKGROUND = (255, 255, 255)
_PASSES = 6  # walls seen from behind that a ray may go through
_NEAR = 0.05  # m in front of the eye is not drawn
_HIDDEN = 0.22  # share of a line's opacity that is left behind a surface
_FINE = 2  # times the pixels of the picture, for smooth edges


def read_mesh(file: Path) -> Surface:
    """Return the surface in a PLY file. The program ends if there is none."""
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(file)
    if not len(mesh.triangles):
        raise SystemExit(f"{file}: no surface can be read")
    mesh.compute_vertex_normals()
    colours = np.rint(255 * np.asarray(mesh.vertex_colors)).astype(np.uint8) if mesh.has_vertex_colors() else None
    vertices, normals = (np.asarray(part, dtype=np.float32) for part in (mesh.vertices, mesh.vertex_normals))
    return Surface(vertices, normals, colours, np.asarray(mesh.triangles, dtype=np.int32))


@dataclass(frozen=True)
class View:
    """A pinhole camera for a picture: eye and target (3,) m in map, z up; angle: its width, deg; size in px."""

    eye: Floats
    target: Floats
    angle: float
    width: int
    height: int

    @property
    def map_T_camera(self) -> Floats:
        """(4, 4) optical frame in map."""
        forward = (self.target - self.eye) / np.linalg.norm(self.target - self.eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return make_pose(np.column_stack([right, np.cross(forward, right), forward]), self.eye)

    @property
    def matrix(self) -> Floats:
        """(3, 3) the camera matrix, px of the picture as it is drawn. It is finer than the saved picture."""
        focal = _FINE * self.width / 2 / np.tan(np.radians(self.angle) / 2)
        return np.array([[focal, 0, _FINE * self.width / 2], [0, focal, _FINE * self.height / 2], [0, 0, 1.0]])

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Pixels (..., 2) and depths (...), m, of points (..., 3)."""
        pose = inverse(self.map_T_camera)
        local = points @ pose[:3, :3].T + pose[:3, 3]
        z = np.where(np.abs(local[..., 2]) < 1e-9, 1e-9, local[..., 2])
        flat = local @ self.matrix.T
        return flat[..., :2] / z[..., None], local[..., 2]


class Picture:
    """A surface drawn from a view. What is added is drawn over it, but is fainter where the surface hides it."""

    def __init__(self, surface: Surface, view: View) -> None:
        self.view = view
        self.image, self.depth = _render(surface, view)

    def lines(self, strips: Sequence[Floats], colour: Sequence[int], width: float = 1.0, opacity: float = 1.0) -> None:
        """Polylines, each (N, 3) m in map; colour RGB, width px of the saved picture."""
        seen, hidden = (np.zeros(self.depth.shape, np.uint8) for _ in range(2))
        for strip in strips:
            fine = np.concatenate([np.linspace(a, b, 60, endpoint=False) for a, b in pairwise(strip)] + [strip[-1:]])
            pixels, z = self.view.project(fine)
            middle, at = (z[:-1] + z[1:]) / 2, (pixels[:-1] + pixels[1:]) / 2
            shown = (z[:-1] > _NEAR) & (z[1:] > _NEAR)
            behind = middle > self._depth_at(at) + 0.03
            for i in np.flatnonzero(shown & (np.abs(pixels[:-1]).max(axis=1) < 1e4)):
                ends = np.rint(pixels[i : i + 2] * 16).astype(int)
                mask = hidden if behind[i] else seen
                cv2.line(mask, ends[0], ends[1], 255, max(1, round(_FINE * width)), cv2.LINE_AA, 4)
        self._blend(seen, colour, opacity)
        self._blend(np.where(seen > 0, 0, hidden).astype(np.uint8), colour, _HIDDEN * opacity)

    def ring(self, centre: Floats, radius: float, colour: Sequence[int], width: float) -> None:
        """A circle that faces the eye, over everything: centre (3,) and radius in m."""
        (pixel,), (z,) = (part[None] for part in self.view.project(centre))
        size = radius * self.view.matrix[0, 0] / z
        mask = np.zeros(self.depth.shape, np.uint8)
        at = tuple(np.rint(pixel * 16).astype(int).tolist())
        cv2.circle(mask, at, round(16 * size), 255, round(_FINE * (width + 2)), cv2.LINE_AA, 4)
        self._blend(mask, (255, 255, 255), 0.75)
        mask[:] = 0
        cv2.circle(mask, at, round(16 * size), 255, round(_FINE * width), cv2.LINE_AA, 4)
        self._blend(mask, colour, 1.0)

    def slice(self, points: Floats, colours: Floats, opacity: Floats) -> None:
        """A curved sheet of points (n, m, 3) m with colours (n, m, 3) in [0, 1] and opacities (n, m)."""
        pixels, z = self.view.project(points)
        corners = np.stack([pixels[:-1, :-1], pixels[:-1, 1:], pixels[1:, 1:], pixels[1:, :-1]], axis=2)
        sheet, alpha = np.zeros_like(self.image), np.zeros(self.depth.shape, np.float32)
        hidden = z[:-1, :-1] > self._depth_at(pixels[:-1, :-1].reshape(-1, 2)).reshape(z[:-1, :-1].shape) + 0.03
        for i, j in np.ndindex(corners.shape[:2]):
            quad = np.rint(corners[i, j]).astype(np.int32)
            cv2.fillConvexPoly(sheet, quad, (255 * colours[i, j]).tolist())
            cv2.fillConvexPoly(alpha, quad, float(opacity[i, j] * (0.5 if hidden[i, j] else 1.0)))
        self.image = self.image * (1 - alpha[..., None]) + sheet * alpha[..., None]

    def done(self) -> np.ndarray:
        """The picture (H, W, 3) uint8 RGB."""
        size = self.view.width, self.view.height
        return np.asarray(cv2.resize(np.clip(self.image, 0, 255).astype(np.uint8), size, interpolation=cv2.INTER_AREA))

    def _depth_at(self, pixels: Floats) -> Floats:
        height, width = self.depth.shape
        column = np.clip(pixels[:, 0], 0, width - 1).astype(int)
        return self.depth[np.clip(pixels[:, 1], 0, height - 1).astype(int), column]

    def _blend(self, mask: np.ndarray, colour: Sequence[int], opacity: float) -> None:
        share = (opacity / 255.0) * mask[..., None].astype(np.float32)
        self.image = self.image * (1 - share) + np.array(colour, np.float32) * share


def save(image: np.ndarray, file: Path) -> None:
    """Write a PNG of 256 colours, a third of the size of all of them."""
    from PIL import Image

    full = Image.fromarray(image)
    few = full.quantize(256, method=Image.Quantize.MAXCOVERAGE)
    full.quantize(palette=few, dither=Image.Dither.FLOYDSTEINBERG).save(file, optimize=True)


def _render(surface: Surface, view: View) -> tuple[np.ndarray, Floats]:
    """Return colours (H, W, 3), float, and depths (H, W), m, inf without a surface. Faces that point away are not drawn."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(surface.vertices), o3d.core.Tensor(surface.triangles.astype(np.uint32)))
    size = _FINE * view.width, _FINE * view.height
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    pose, matrix = view.map_T_camera, view.matrix
    local = np.stack([(u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1], np.ones_like(u)], axis=-1)
    towards = (local @ pose[:3, :3].T).astype(np.float32).reshape(-1, 3)  # z = 1: what it hits at t has the depth t
    start = np.full(len(towards), _NEAR, np.float32)
    image = np.tile(np.array(BACKGROUND, np.float32), (len(towards), 1))
    depth = np.full(len(towards), np.inf)
    live = np.arange(len(towards))
    colours = np.full(surface.vertices.shape, 175.0) if surface.colours is None else surface.colours.astype(np.float32)
    for _ in range(_PASSES):
        origin = pose[:3, 3].astype(np.float32) + start[live, None] * towards[live]
        hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([origin, towards[live]], axis=1)))
        t = hit["t_hit"].numpy()
        found = np.isfinite(t)
        live, t = live[found], t[found]
        triangle = surface.triangles[hit["primitive_ids"].numpy()[found].astype(np.int64)]
        b, c = hit["primitive_uvs"].numpy()[found].T
        share = np.stack([1 - b - c, b, c], axis=1)[..., None]
        normal = (surface.normals[triangle] * share).sum(axis=1)
        facing = -(normal * towards[live]).sum(axis=1) / np.linalg.norm(towards[live], axis=1)
        front = facing > 0
        light = (0.72 + 0.28 * np.clip(facing, 0, 1))[:, None]
        image[live[front]] = ((colours[triangle] * share).sum(axis=1) * light)[front]
        depth[live[front]] = (start[live] + t)[front]
        start[live] += t + 2e-3
        live = live[~front]
        if not len(live):
            break
    return image.reshape(size[1], size[0], 3), depth.reshape(size[1], size[0])

"""Render the colour, the depth and the object at each pixel of a furnished room. Open3D casts the rays, on the CPU."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera, in_field, project, undistort
from objslam.core.geometry import inverse
from objslam.errors import ObjslamError
from objslam.simulation.furniture import Room

Reals = NDArray[np.floating]

NEAR = 0.05  # The least depth of an object's points, m. An object with a nearer point counts as partly behind the camera.
_NOISE = 64  # The number of grid points of the 3D noise along each axis. With more points, the noise repeats less often.
_STRIP = 32
"""The number of image rows that are shaded at a time. The arrays of 32 rows fit into a processor's cache. A larger number
is slower: if whole images of 640 x 480 px are shaded at once, rendering takes a fifth more time."""
_PATTERNS = {"plain": 0, "noise": 1, "stripes": 2, "checks": 3}


@dataclass(frozen=True)
class Cast:
    """The surfaces that the rays of an image hit, one ray for each pixel.

    depth: (H, W) z, m, inf without a hit. part: (H, W) the index of the part in the room, -1 without a hit.
    normal: (H, W, 3) normal of the surface, in map. point: (H, W, 3) point that the ray hits, in map, m.
    """

    depth: Reals
    part: Ints
    normal: Reals
    point: Reals

    def rows(self, chosen: slice) -> Self:
        """Return the chosen rows of the image."""
        return type(self)(self.depth[chosen], self.part[chosen], self.normal[chosen], self.point[chosen])


@dataclass(frozen=True)
class Caster:
    """A room and the camera that looks at it. seed: the seed of the noise in the textures."""

    room: Room
    camera: Camera
    seed: int = 0

    @cached_property
    def directions(self) -> Reals:
        """The directions (H, W, 3) of the pixel centres in the camera frame, with z = 1."""
        v, u = np.mgrid[0 : self.camera.height, 0 : self.camera.width]
        directions, _ = undistort(self.camera, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        return np.asarray((directions / directions[:, 2:]).reshape(*u.shape, 3), dtype=np.float32)

    @cached_property
    def _scene(self) -> Any:
        return _scene(self.room, range(len(self.room.parts)))

    @cached_property
    def _alone(self) -> list[Any]:
        return [_scene(self.room, np.flatnonzero(self.room.owner == i)) for i in range(len(self.room.labels))]

    @cached_property
    def _materials(self) -> tuple[NDArray[Any], ...]:
        """The two colours (P, 3), the gloss (P,), the scale (P,) and the number of the pattern (P,) of the room's parts."""
        materials = [part.material for part in self.room.parts]
        names = ("colour", "second", "gloss", "scale")
        columns = [np.array([getattr(material, name) for material in materials], dtype=np.float32) for name in names]
        return (*columns, np.array([_PATTERNS[material.pattern] for material in materials]))

    @cached_property
    def _grain(self) -> Reals:
        """Smooth periodic noise in [0, 1] on a cube of _NOISE^3 points, as a flat array."""
        from scipy.ndimage import gaussian_filter

        rng = np.random.default_rng(self.seed)
        white = rng.standard_normal((_NOISE,) * 3)
        mixed = sum(gaussian_filter(white, s, mode="wrap") * s**1.5 for s in (0.7, 1.5, 3.0))
        return np.clip(0.5 + mixed / (4 * mixed.std()), 0.0, 1.0).astype(np.float32).ravel()

    def prepare(self) -> None:
        """Build the cached data. Afterwards, several threads may use the caster at the same time."""
        _ = self.directions, self._scene, self._alone, self._materials, self._grain

    def cast(self, map_T_camera: Floats) -> Cast:
        """Find the first surface on the ray of every pixel of a camera at map_T_camera (4, 4)."""
        rays = _rays(self.directions, map_T_camera)
        hit = self._scene.cast_rays(_tensor(rays), 1)
        depth = hit["t_hit"].numpy()
        part = hit["geometry_ids"].numpy().astype(np.int64)
        part[~np.isfinite(depth)] = -1
        reach = np.where(np.isfinite(depth), depth, 0.0)[..., None]
        point = rays[..., :3] + reach * rays[..., 3:]
        return Cast(depth, part, hit["primitive_normals"].numpy(), point)

    def owners(self, cast: Cast) -> Ints:
        """Return the id (H, W) of the object at each pixel, or -1 where no object is visible."""
        return np.append(self.room.owner, -1)[cast.part]

    def silhouettes(self, map_T_camera: Floats, chosen: Ints) -> Ints:
        """Return the number (M,) of pixels that each chosen object would cover if nothing hid it. The number is 0 if a part
        of the object is nearer than `NEAR`. chosen: (M,) the ids of the objects."""
        counts = np.zeros(len(chosen), dtype=np.int64)
        for i, number in enumerate(chosen):
            window = self._window(number, map_T_camera)
            if window is not None:
                rays = _rays(self.directions[window], map_T_camera)
                counts[i] = int(self._alone[number].test_occlusions(_tensor(rays), nthreads=1).numpy().sum())
        return counts

    def full_sizes(self, map_T_camera: Floats, chosen: Ints) -> Floats:
        """Return the width and height (M, 2), px, that the boxes of objects would have if the image had no edges.

        chosen: (M,) the ids of the objects. The width and height are inf if a part of the object is nearer than `NEAR`, or
        outside the field of the lens.
        """
        sizes = np.full((len(chosen), 2), np.inf)
        for i, number in enumerate(chosen):
            local = self._local(number, map_T_camera)
            if local[:, 2].min() >= NEAR and in_field(self.camera, local).all():
                sizes[i] = np.ptp(project(self.camera, local), axis=0)
        return sizes

    def _local(self, number: int, map_T_camera: Floats) -> Floats:
        camera_T_map = inverse(map_T_camera)
        points = np.concatenate([self.room.parts[p].vertices for p in np.flatnonzero(self.room.owner == number)])
        return np.asarray(points @ camera_T_map[:3, :3].T + camera_T_map[:3, 3])

    def _window(self, number: int, map_T_camera: Floats) -> tuple[slice, slice] | None:
        """Return the rows and columns around an object. Return None if the object is out of view or partly behind the
        camera."""
        local = self._local(number, map_T_camera)
        if local[:, 2].min() < NEAR:
            return None
        flat = local[:, :2] / local[:, 2:]
        low, high = flat.min(axis=0), flat.max(axis=0)
        x, y = self.directions[..., 0], self.directions[..., 1]
        inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        return (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else None

    def shade(self, cast: Cast, eye: Floats) -> Reals:
        """Return the linear RGB colour (H, W, 3) of each pixel, with reflections and shadows.

        eye: (3,) the camera position in map, m.
        """
        starts = range(0, len(cast.depth), _STRIP)
        return np.concatenate([self._shade_strip(cast.rows(slice(start, start + _STRIP)), eye) for start in starts])

    def _shade_strip(self, cast: Cast, eye: Floats) -> Reals:
        """Return the colours of some rows, as `shade` does. The arrays in this function have the axis of x, y, z or of the
        colours first, because NumPy is fast with this order."""
        albedo, gloss = self._albedo(cast)
        point, normal = (np.ascontiguousarray(np.moveaxis(values, -1, 0)) for values in (cast.point, cast.normal))
        view = _unit(_column(eye) - point)
        facing = _dot(normal, view)
        normal *= np.where(facing < 0, np.float32(-1), np.float32(1))
        facing = np.abs(facing)
        light = _column(self.room.ambient) * (0.8 + 0.2 * normal[2])
        shine = np.zeros_like(albedo)
        start = point + np.float32(2e-3) * normal
        for lamp in self.room.lamps:
            to = _column(lamp.position) - start
            rays = np.moveaxis(np.concatenate([start, to]), 0, -1)
            dark = self._scene.test_occlusions(_tensor(rays), 0.0, 1.0, 1).numpy()
            squared = _dot(to, to)
            power = np.where(dark, np.float32(0), 1 / (np.float32(0.4) + np.float32(0.3) * squared))
            near = 1 / np.sqrt(squared + np.float32(1e-12))
            slope, ahead = _dot(to, normal) * near, _dot(to, view) * near
            # The half vector is the sum of the unit vectors to the lamp and to the eye. 2 + 2 ahead is its squared length.
            half = (slope + facing) / np.sqrt(np.maximum(2 + 2 * ahead, np.float32(1e-12)))
            glint = np.maximum(half, 0) ** 2
            glint *= glint
            glint *= glint
            glint *= glint
            colour = _column(lamp.power)
            light += power * np.maximum(slope, 0) * colour
            shine += power * glint**2 * gloss * colour
        shaded = np.where(cast.part >= 0, albedo * light + shine, np.float32(0))
        return np.ascontiguousarray(np.moveaxis(shaded, 0, -1))

    def _albedo(self, cast: Cast) -> tuple[Reals, Reals]:
        """Return the colour (3, H, W) and the gloss (H, W) of the surface at each pixel."""
        first, second, gloss, scale, pattern = (column.T.take(cast.part, axis=-1) for column in self._materials)
        share = np.zeros(cast.part.shape, dtype=np.float32)
        for kind in (1, 2, 3):
            chosen = pattern == kind
            if chosen.any():
                share[chosen] = self._pattern(kind, cast.point[chosen] / scale[chosen][:, None])
        return first + share * (second - first), gloss

    def _pattern(self, kind: int, at: Reals) -> Reals:
        """Return the share (M,) of the second colour at points. at: (M, 3) in units of the pattern's scale."""
        if kind == 3:
            return (np.floor(at + 0.37).astype(np.int64).sum(axis=1) & 1).astype(np.float32)
        cell = np.floor(at * 2).astype(np.int64) & (_NOISE - 1)
        grain = self._grain[(cell[:, 0] * _NOISE + cell[:, 1]) * _NOISE + cell[:, 2]]
        if kind == 1:
            return grain
        return np.asarray(0.5 + 0.5 * np.sin(2 * np.pi * (at @ np.array([0.31, 1.0, 0.83], dtype=np.float32)) + 4 * grain))


def _rays(directions: Reals, map_T_camera: Floats) -> Reals:
    turned = directions @ map_T_camera[:3, :3].T.astype(np.float32)
    return np.concatenate([np.broadcast_to(map_T_camera[:3, 3].astype(np.float32), turned.shape), turned], axis=-1)


def _column(values: Floats) -> Reals:
    """Return a point or a colour (3,) as an array (3, 1, 1)."""
    return values.astype(np.float32)[:, None, None]


def _dot(a: Reals, b: Reals) -> Reals:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _unit(v: Reals) -> Reals:
    return np.asarray(v / np.sqrt(_dot(v, v) + np.float32(1e-12)))


def _open3d() -> Any:
    try:
        import open3d
    except ImportError as error:
        hint = 'pip install "objslam[open3d]", or render nothing: objslam demo --boxes'
        raise ObjslamError(f"Open3D, which renders the drive, cannot be imported ({error})", hint=hint) from error
    return open3d


def _tensor(values: NDArray[Any]) -> Any:
    o3d = _open3d()
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values))


def _scene(room: Room, chosen: Any) -> Any:
    o3d = _open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for p in chosen:
        part = room.parts[p]
        scene.add_triangles(_tensor(part.vertices.astype(np.float32)), _tensor(part.triangles.astype(np.uint32)))
    # The first ray makes Open3D build its search tree. Two threads must not build the tree at the same time.
    scene.cast_rays(_tensor(np.array([[0, 0, 0, 0, 0, 1]], dtype=np.float32)), 1)
    return scene

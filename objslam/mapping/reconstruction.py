"""Reconstruct the surroundings: fuse depth images at the solved poses into one coloured surface.

Open3D's VoxelBlockGrid fuses truncated signed distances (Curless & Levoy, SIGGRAPH 1996) in blocks of 6^3 voxels. The blocks
exist only near surfaces (Dong et al., ASH, T-PAMI 2022).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse
from objslam.core.result import Surface
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.errors import LogError
from objslam.frontend.box_depths import MAX_IMAGE_LAG, nearest_stamps, read_depth
from objslam.io.images import decode_colour
from objslam.io.text import read_bytes
from objslam.io.threads import ahead
from objslam.mapping.progress import Progress

_BLOCK = 6
"""The number of voxels along the edge of a block. Compared with 8, a value of 6 takes a tenth less time and a quarter less
memory. With a larger number, the fusion is slower. With 16, it takes twice the time."""
_FIRST_BLOCKS = 32_768
"""The number of blocks for which a new grid has memory. It is enough for one room of a house. A full grid doubles its
memory. A larger number takes more memory in a small scene."""
_SPARE = 1024
"""The number of blocks that always stay free in the grid. If one call touched more blocks than are free, Open3D would
enlarge the grid, even beyond `reconstruction.max_blocks`. A larger number takes more memory."""
_AHEAD = 4
"""The number of images that are decoded ahead. A larger number takes more memory."""
_TOUCH = 4
"""The step (px) at which Open3D itself samples a depth image to find the blocks that it touches. An image without depth at
these pixels is dropped. A larger step would drop images that Open3D can use."""


@dataclass(frozen=True)
class Shot:
    """A depth image to fuse. camera: the index of its camera. depth: the file of the depth image. rgb: the file of the
    colour image, None without colour. map_T_camera: (4, 4) the pose of the camera."""

    camera: int
    depth: Path
    rgb: Path | None
    map_T_camera: Floats


def reconstruct(
    log: Log, path: Trajectory, settings: Settings, ledger: Ledger, progress: Progress = lambda stage, done, total: None
) -> Surface | None:
    """Fuse the depth images of a log into a surface. If there is no surface, return None, and warn in the ledger.

    A pixel of a depth image is the z coordinate in the camera frame. path: the poses map_T_base. The ledger counts the depth
    images that are not used. These have no pose, no colour image within 20 ms, or no depth up to reconstruction.max_depth.
    Or they are damaged, or have not the size of the camera's images. Blocks beyond reconstruction.max_blocks are left out
    with a warning.
    """
    shots = choose_shots(log, path, settings, ledger)
    if not shots:
        ledger.warn("no reconstruction: no depth image has a pose")
        return None
    try:
        return _fuse(shots, tuple(c.camera for c in log.cameras), settings, ledger, progress)
    except ImportError as error:
        ledger.warn(f'no reconstruction: Open3D cannot be imported ({error}); pip install "objslam[open3d]"')
    except RuntimeError as error:  # For example a GPU without enough memory.
        reason = str(error).strip().splitlines()[-1].rpartition("): ")[2][:200]  # Without colour codes and C++ signature.
        ledger.warn(f"no reconstruction: Open3D failed ({reason})")
    return None


def choose_shots(log: Log, path: Trajectory, settings: Settings, ledger: Ledger) -> list[Shot]:
    """Return the depth images to fuse, in the order of time. Each has a pose. If all cameras have colour, each also has a
    colour image.

    One image in reconstruction.stride is taken. If more than reconstruction.max_frames are taken, images at even intervals
    among them are used.
    """
    chosen = settings.reconstruction
    colour = all(c.rgb is not None for c in log.cameras if c.depth is not None)
    shots: list[tuple[float, Shot]] = []
    for number, camera_log in enumerate(log.cameras):
        if camera_log.depth is None:
            continue
        stamps = camera_log.depth.stamps
        poses, valid = interpolate(path.stamps, path.poses, stamps, settings.poses.max_gap)
        base_T_camera, mount = camera_log.camera.base_T_camera, camera_log.mount
        if mount is not None:
            base_T_camera, mounted = interpolate(mount.stamps, mount.poses, stamps, settings.poses.max_gap)
            valid &= mounted
        poses = poses @ base_T_camera
        ledger.drop("depth images off the path", int((~valid).sum()), _first(stamps, ~valid))
        rgb: list[Path | None] = [None] * len(stamps)
        if colour and camera_log.rgb is not None:
            index = nearest_stamps(camera_log.rgb.stamps, stamps)
            near = np.abs(camera_log.rgb.stamps[index] - stamps) <= MAX_IMAGE_LAG
            ledger.drop("depth images without a colour image", int((valid & ~near).sum()), _first(stamps, valid & ~near))
            valid &= near
            rgb = [camera_log.rgb.paths[i] for i in index.tolist()]
        for i in np.flatnonzero(valid).tolist():
            shots.append((stamps[i], Shot(number, camera_log.depth.paths[i], rgb[i], poses[i])))
    shots.sort(key=lambda shot: shot[0])
    taken = [shot for _, shot in shots[:: chosen.stride]]
    return taken[:: -(-len(taken) // chosen.max_frames)] if taken else []


def _fuse(
    shots: list[Shot], cameras: tuple[Camera, ...], settings: Settings, ledger: Ledger, progress: Progress
) -> Surface | None:
    import open3d as o3d

    chosen = settings.reconstruction
    grid: Grid | None = None
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):  # Open3D warns on stdout.
        lenses = [Lens.of(camera) for camera in cameras]

        def load(shot: Shot) -> tuple[Shot, NDArray[np.float32] | None, NDArray[np.float32] | None, Ledger]:
            noted = Ledger()  # Threads cannot write to one ledger.
            return shot, *load_shot(shot, cameras[shot.camera], lenses[shot.camera], chosen.max_depth, noted), noted

        for done, (shot, depth, colour, noted) in enumerate(ahead(load, shots, _AHEAD)):
            ledger.add(noted)
            if depth is not None:
                if grid is None:
                    grid = Grid(settings, coloured=colour is not None)
                grid.add(depth, colour, cameras[shot.camera].matrix, shot.map_T_camera)
            progress("reconstruction", done + 1, len(shots))
        if grid is None:
            ledger.warn("no reconstruction: no depth image could be used")
            return None
        if grid.left_out:
            ledger.warn(
                f"the reconstruction is not whole: {grid.left_out} blocks did not fit. A block counts once for each image "
                "(raise reconstruction.max_blocks or reconstruction.voxel)"
            )
        surface = grid.surface(chosen.min_views)
    if surface is None:
        ledger.warn(f"no reconstruction: no surface was seen by {chosen.min_views} depth images (reconstruction.min_views)")
    return surface


@dataclass(frozen=True)
class Lens:
    """The undistortion of a camera's images. maps: the two maps for cv2.remap, or None for a camera without distortion."""

    maps: tuple[NDArray[Any], NDArray[Any]] | None

    @classmethod
    def of(cls, camera: Camera) -> Lens:
        """Make the maps that turn the camera's images into images of a pinhole camera with the same matrix."""
        import cv2

        fisheye = camera.distortion_model == "equidistant"
        if not fisheye and not camera.distortion.any():
            return cls(None)
        make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
        size = (camera.width, camera.height)
        return cls(make(camera.matrix, camera.distortion, np.eye(3), camera.matrix, size, cv2.CV_16SC2))

    def straighten(self, image: NDArray[Any], *, smooth: bool) -> NDArray[Any]:
        """Undistort an image. smooth: whether to interpolate between pixels, which suits colour but falsifies depth."""
        import cv2

        if self.maps is None:
            return image
        return np.asarray(cv2.remap(image, *self.maps, cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST))


def load_shot(
    shot: Shot, camera: Camera, lens: Lens, max_depth: float, ledger: Ledger
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Return the undistorted depth (H, W), m, and the undistorted RGB image (H, W, 3) in [0, 1] of a shot.

    Depth beyond `max_depth` (m) is 0. If one of the two images cannot be used, both results are None. If the shot has no
    colour image, the RGB image alone is None.
    """
    raw = read_depth(shot.depth, camera, ledger)
    if raw is None:
        return None, None
    depth = lens.straighten(raw, smooth=False).astype(np.float32) / np.float32(camera.depth_scale)
    depth = np.where((depth > 0) & (depth <= max_depth), depth, np.float32(0))  # NaN becomes 0 too.
    if not depth[::_TOUCH, ::_TOUCH].any():
        ledger.drop("depth images without a depth up to reconstruction.max_depth", where=str(shot.depth))
        return None, None
    if shot.rgb is None:
        return depth, None
    try:
        image = decode_colour(read_bytes(shot.rgb))
    except LogError:
        image = None
    if image is None or image.shape[:2] != (camera.height, camera.width):
        ledger.drop("colour image that cannot be decoded or does not have the camera's size", where=str(shot.rgb))
        return None, None
    return depth, np.ascontiguousarray(lens.straighten(image, smooth=True)[..., ::-1], dtype=np.float32) / np.float32(255)


class Grid:
    """A voxel block grid that grows up to reconstruction.max_blocks blocks. A voxel takes 20 bytes (8 without colour).

    left_out: the number of blocks for which the grid had no room. A block counts once for each image that touches it.
    """

    def __init__(self, settings: Settings, *, coloured: bool) -> None:
        import open3d as o3d

        chosen = settings.reconstruction
        self._core: Any = o3d.core
        self._geometry: Any = o3d.t.geometry
        cuda = chosen.device == "cuda" or (chosen.device == "auto" and o3d.core.cuda.is_available())
        self._device = o3d.core.Device("CUDA:0" if cuda else "CPU:0")
        self._max_blocks = chosen.max_blocks
        self._max_depth = chosen.max_depth
        self._truncation = max(chosen.truncation / chosen.voxel, 2.0)  # voxels
        # Colours are floats. With 16-bit colours, Open3D rounds averages down, which darkens walls by a tenth.
        names, channels = (("tsdf", "weight", "color"), (1, 1, 3)) if coloured else (("tsdf", "weight"), (1, 1))
        first = min(_FIRST_BLOCKS, self._max_blocks)
        dtypes = (o3d.core.float32,) * len(names)
        self._grid = self._geometry.VoxelBlockGrid(names, dtypes, channels, chosen.voxel, _BLOCK, first, self._device)
        self.left_out = 0

    @property
    def blocks(self) -> int:
        """The number of blocks in use."""
        return int(self._grid.hashmap().size())

    def add(self, depth: NDArray[np.float32], colour: NDArray[np.float32] | None, matrix: Floats, pose: Floats) -> None:
        """Fuse a depth image (H, W), m, and a colour image (H, W, 3) in [0, 1] of a pinhole camera. matrix: (3, 3) of the
        camera, px. pose: (4, 4) map_T_camera."""
        tensor, image_of = self._core.Tensor.from_numpy, self._geometry.Image
        images = [image_of(tensor(image)).to(self._device) for image in (depth, colour) if image is not None]
        # Open3D rounds a pixel position down. With half a pixel added, it takes the nearest pixel.
        shift = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
        k, camera_T_map = self._core.Tensor(matrix + shift), self._core.Tensor(inverse(pose))
        reach = (1.0, self._max_depth, self._truncation)
        touched = self._grid.compute_unique_block_coordinates(images[0], k, camera_T_map, *reach)
        for part in self._with_room(touched):
            self._grid.integrate(part, *images, *[k] * len(images), camera_T_map, *reach)

    def _with_room(self, touched: Any) -> Iterator[Any]:
        """Yield the touched blocks (M, 3) that exist or still fit. Each portion is small enough that Open3D does not enlarge
        the grid."""
        hashmap = self._grid.hashmap()

        def room() -> int:
            return int(hashmap.capacity() - _SPARE - hashmap.size())

        while len(touched) > room() and hashmap.capacity() < self._max_blocks:
            hashmap.reserve(min(2 * hashmap.capacity(), self._max_blocks))
        if len(touched) <= room():
            yield touched
            return
        known = hashmap.find(touched)[1].cpu().numpy()
        new, fitting = np.flatnonzero(~known), max(room(), 0)
        self.left_out += len(new[fitting:])
        kept = np.concatenate([np.flatnonzero(known), new[:fitting]])
        for start in range(0, len(kept), _SPARE):
            yield touched[self._core.Tensor(kept[start : start + _SPARE], device=self._device)]

    def surface(self, min_views: int) -> Surface | None:
        """Return the surface through voxels that at least `min_views` depth images saw, or None if it has no triangles."""
        if not self.blocks:
            return None
        mesh = self._grid.extract_triangle_mesh(min_views - 0.5).cpu()  # Open3D keeps weights above the limit.
        if not len(mesh.triangle.indices):
            return None
        colours = None
        if "colors" in mesh.vertex:
            colours = np.clip(255 * mesh.vertex.colors.numpy() + 0.5, 0, 255).astype(np.uint8)
        triangles = mesh.triangle.indices.numpy().astype(np.int32)
        return Surface(mesh.vertex.positions.numpy().copy(), mesh.vertex.normals.numpy().copy(), colours, triangles)


def _first(stamps: Floats, mask: Bools) -> str | None:
    return f"stamp {stamps[mask][0]:.3f}" if mask.any() else None

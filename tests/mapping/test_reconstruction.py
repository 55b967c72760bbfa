"""The fused surface against planes known in closed form and against the rendered room, and what the files hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from quick import HELD

from objslam import config
from objslam.config import Settings, load_settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera, undistort
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3, inverse, make_pose
from objslam.core.result import Surface
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log
from objslam.io.detections_jsonl import read_detections
from objslam.io.ply import write_cloud, write_mesh
from objslam.mapping import pipeline
from objslam.mapping.reconstruction import Grid, choose_shots, reconstruct
from objslam.output.result_folder import write_result
from objslam.simulation import make_camera
from objslam.simulation.render import TRUTH_BOXES, BoxLimits, RenderSettings, drive_room, render_drive
from objslam.sources.log_folder import read_log_folder

NORMAL, OFFSET = np.array([-0.8, 0.36, 0.48]), -2.0  # the wall: NORMAL @ point = OFFSET, in map
ORANGE = (240, 140, 20)
PINHOLE = make_camera(width=320, height=240, focal=200.0, position=(0.1, 0.0, 0.5))
PLUMB = replace(PINHOLE, distortion=np.array([-0.25, 0.08, 0.002, -0.001, 0.0]))
FISHEYE = replace(PINHOLE, distortion_model="equidistant", distortion=np.array([0.02, -0.01, 0.003, 0.0]))
PATH = Trajectory(np.arange(8) * 0.2 + 10.0, exp_se3(np.outer(np.arange(8), [0, 0, 0.03, 0.05, -0.04, 0.0])))


def wall_depth(camera: Camera, map_T_camera: Floats) -> Floats:
    """The z-depth (H, W), m, of the wall at every raw pixel, 0 where a ray misses it."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays, valid = undistort(camera, np.column_stack([u.ravel(), v.ravel()]).astype(float))
    towards = rays @ map_T_camera[:3, :3].T @ NORMAL
    along = (OFFSET - NORMAL @ map_T_camera[:3, 3]) / towards
    z = np.where(valid & (along > 0), along * rays[:, 2], 0.0)
    return z.reshape(camera.height, camera.width)


def wall_log(folder: Path, camera: Camera = PINHOLE, *, mount: Trajectory | None = None, name: str = "a") -> Log:
    """A drive past the wall: a depth image and an orange picture a pose."""
    stamps = PATH.stamps
    on_robot = camera.base_T_camera if mount is None else mount.poses
    depth, rgb = [], []
    for i, pose in enumerate(PATH.poses @ on_robot):
        depth.append(folder / f"{name}{i}.png")
        rgb.append(folder / f"{name}{i}c.png")
        units = np.rint(wall_depth(camera, pose) * camera.depth_scale)
        cv2.imwrite(str(depth[-1]), np.clip(units, 0, 65535).astype(np.uint16))
        cv2.imwrite(str(rgb[-1]), np.full((camera.height, camera.width, 3), ORANGE[::-1], np.uint8))
    images = {"rgb": Images(stamps, tuple(rgb)), "depth": Images(stamps, tuple(depth))}
    return Log("wall", (CameraLog(camera, **images, mount=mount),), odometry=PATH)


def off_the_wall(surface: Surface) -> Floats:
    return np.abs(surface.vertices @ NORMAL - OFFSET)


def bias(surface: Surface) -> float:
    """How far the surface is behind the wall on average, m: half a pixel amiss would be 7 mm."""
    return float((surface.vertices @ NORMAL - OFFSET).mean())


def with_(**changes: object) -> Settings:
    return Settings(reconstruction=config.Reconstruction(**changes))


@pytest.mark.parametrize("camera", [PINHOLE, PLUMB, FISHEYE], ids=["pinhole", "plumb_bob", "fisheye"])
def test_a_wall(tmp_path: Path, camera: Camera) -> None:
    ledger = Ledger()
    surface = reconstruct(wall_log(tmp_path, camera), PATH, Settings(), ledger)
    assert surface is not None
    assert not ledger.lines()
    assert off_the_wall(surface).max() < 0.03  # a voxel is 20 mm; across a pixel, the depth changes by as much
    assert np.median(off_the_wall(surface)) < 0.003
    assert abs(bias(surface)) < 0.001
    assert len(surface.vertices) > 2000
    assert np.median(surface.normals @ NORMAL) > 0.99  # towards the camera
    assert surface.colours is not None
    np.testing.assert_array_equal(np.median(surface.colours, axis=0), ORANGE)
    corners = surface.vertices[surface.triangles]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = PATH.poses[0] @ camera.base_T_camera
    picture = wall_depth(camera, seen)
    patch = np.median(picture[picture > 0])
    assert 0.3 < 0.5 * np.linalg.norm(crossed, axis=1).sum() / patch**2 < 6.0  # about what the camera's view covers


def test_the_pose_is_that_of_the_moving_mount(tmp_path: Path) -> None:
    turned = exp_se3(np.outer(np.arange(8), [0, 0.05, 0.04, 0, 0, 0.02]))
    mount = Trajectory(PATH.stamps, PINHOLE.base_T_camera @ turned)
    surface = reconstruct(wall_log(tmp_path, mount=mount), PATH, Settings(), Ledger())
    assert surface is not None
    assert off_the_wall(surface).max() < 0.03


def test_two_cameras_make_one_surface(tmp_path: Path) -> None:
    other = replace(make_camera("other", width=320, height=240, focal=180.0, yaw=0.6), depth_scale=5000.0)
    logs = wall_log(tmp_path), wall_log(tmp_path, other, name="b")
    both = replace(logs[0], cameras=logs[0].cameras + logs[1].cameras)
    shots = choose_shots(both, PATH, Settings(), Ledger())
    assert [shot.camera for shot in shots] == [0, 1] * 8
    surfaces = [reconstruct(log, PATH, Settings(), Ledger()) for log in (*logs, both)]
    assert all(s is not None and off_the_wall(s).max() < 0.03 for s in surfaces)
    areas = [np.prod(np.ptp(s.vertices[:, 1:], axis=0)) for s in surfaces if s is not None]
    assert areas[2] > 1.1 * max(areas[:2])


def test_a_surface_counts_once_it_was_seen_often_enough(tmp_path: Path) -> None:
    log = wall_log(tmp_path)
    first = log.cameras[0]
    assert first.depth is not None
    assert first.rgb is not None
    three = replace(
        first,
        depth=Images(first.depth.stamps[:3], first.depth.paths[:3]),
        rgb=Images(first.rgb.stamps[:3], first.rgb.paths[:3]),
    )
    still = Trajectory(PATH.stamps, PATH.poses[:1].repeat(8, axis=0))
    seen = reconstruct(replace(log, cameras=(three,)), still, with_(min_views=3), Ledger())
    assert seen is not None
    ledger = Ledger()
    assert reconstruct(replace(log, cameras=(three,)), still, with_(min_views=4), ledger) is None
    assert ledger.warnings == ["no reconstruction: no surface was seen by 4 depth images (reconstruction.min_views)"]


def test_which_frames_are_taken(tmp_path: Path) -> None:
    log = wall_log(tmp_path)
    numbers = {path: i for i, path in enumerate(log.cameras[0].depth.paths)}  # type: ignore[union-attr]

    def taken(path: Trajectory = PATH, **changes: object) -> tuple[list[int], Ledger]:
        ledger = Ledger()
        return [numbers[shot.depth] for shot in choose_shots(log, path, with_(**changes), ledger)], ledger

    assert taken()[0] == list(range(8))
    assert taken(stride=3)[0] == [0, 3, 6]
    assert taken(max_frames=5)[0] == [0, 2, 4, 6]
    assert taken(stride=2, max_frames=2)[0] == [0, 4]
    numbers_taken, ledger = taken(Trajectory(PATH.stamps[2:6], PATH.poses[2:6]))
    assert numbers_taken == [2, 3, 4, 5]
    assert ledger.dropped == {"depth images off the path": 4}


def test_what_cannot_be_used_is_counted(tmp_path: Path) -> None:
    log = wall_log(tmp_path)
    camera_log = log.cameras[0]
    assert camera_log.depth is not None
    assert camera_log.rgb is not None
    depth, rgb = camera_log.depth.paths, camera_log.rgb.paths
    depth[0].write_bytes(b"no image")
    cv2.imwrite(str(depth[1]), np.full((60, 80), 1000, np.uint16))
    cv2.imwrite(str(depth[2]), np.full((240, 320), 9000, np.uint16))  # all of it beyond max_depth
    rgb[3].write_bytes(rgb[3].read_bytes()[:50])
    late = replace(camera_log.rgb, stamps=camera_log.rgb.stamps + np.eye(8)[4] * 0.1)
    ledger = Ledger()
    surface = reconstruct(replace(log, cameras=(replace(camera_log, rgb=late),)), PATH, Settings(), ledger)
    assert surface is not None
    assert off_the_wall(surface).max() < 0.03
    assert ledger.dropped == {
        "depth images without a colour image": 1,
        "depth image that cannot be decoded": 1,
        "depth image that is in colour or does not have the camera's size": 1,
        "depth images without a depth up to reconstruction.max_depth": 1,
        "colour image that cannot be decoded or does not have the camera's size": 1,
    }
    for path in depth:
        path.write_bytes(b"")
    ledger = Ledger()
    assert reconstruct(log, PATH, Settings(), ledger) is None
    assert ledger.warnings == ["no reconstruction: no depth image could be used"]


def test_without_colour_and_with_depth_in_floats(tmp_path: Path) -> None:
    camera = replace(PINHOLE, depth_scale=1.0)
    log = wall_log(tmp_path, camera)
    camera_log = log.cameras[0]
    assert camera_log.depth is not None
    paths = []
    for i, pose in enumerate(PATH.poses @ camera.base_T_camera):
        z = wall_depth(camera, pose).astype(np.float32)
        z[:10, :10] = [np.nan, np.inf, -1.0, 0.0, np.nan, 2.0e9, -np.inf, 0.0, 0.0, 0.0]
        paths.append(tmp_path / f"{i}.tiff")
        assert cv2.imwrite(str(paths[-1]), z)
    plain = replace(camera_log, rgb=None, depth=replace(camera_log.depth, paths=tuple(paths)))
    surface = reconstruct(replace(log, cameras=(plain,)), PATH, Settings(), Ledger())
    assert surface is not None
    assert surface.colours is None
    assert off_the_wall(surface).max() < 0.03
    write_mesh(surface, tmp_path / "a.ply")
    assert not o3d.io.read_triangle_mesh(tmp_path / "a.ply").has_vertex_colors()


def test_the_grid_grows_and_keeps_what_it_had(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("objslam.mapping.reconstruction._FIRST_BLOCKS", 2048)
    towards, _ = undistort(PINHOLE, np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2))
    depth = (3.9 * towards[:, 2]).reshape(240, 320).astype(np.float32)  # from the middle of a ball
    poses = [make_pose(exp_se3(np.array([0, 0.9 * i, 0, 0, 0, 0.0]))[:3, :3], np.zeros(3)) for i in range(7)]
    grids = Grid(Settings(), coloured=False), Grid(with_(max_blocks=2048), coloured=False)
    for pose in poses:
        for grid in grids:
            grid.add(depth, None, PINHOLE.matrix, pose)
    grown, bounded = grids
    assert grown.blocks > 4096
    assert not grown.left_out
    assert bounded.blocks <= 2048
    assert bounded._grid.hashmap().capacity() == 2048
    assert bounded.left_out > 1000
    whole, part = grown.surface(1), bounded.surface(1)
    assert whole is not None
    assert part is not None
    for surface in (whole, part):
        assert np.abs(np.linalg.norm(surface.vertices, axis=1) - 3.9).max() < 0.02
    # what was there before it grew is there still: nothing is missing all round
    around = np.arctan2(whole.vertices[:, 0], whole.vertices[:, 2])
    assert np.diff(np.sort(around[np.abs(whole.vertices[:, 1]) < 0.5])).max() < 0.01
    assert 0.05 * len(whole.vertices) < len(part.vertices) < 0.6 * len(whole.vertices)


def test_what_has_no_room_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("objslam.mapping.reconstruction._SPARE", 2000)
    ledger = Ledger()
    surface = reconstruct(wall_log(tmp_path), PATH, with_(max_blocks=2048, voxel=0.01, truncation=0.04), ledger)
    assert surface is not None
    (warning,) = ledger.warnings
    assert warning.startswith("the reconstruction is not whole: ")


def test_without_open3d_the_map_is_still_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    ledger = Ledger()
    assert reconstruct(wall_log(tmp_path), PATH, Settings(), ledger) is None
    (warning,) = ledger.warnings
    assert warning.startswith("no reconstruction: Open3D cannot be imported")


def test_the_files_hold_the_surface(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    vertices, normals = rng.normal(size=(2, 50, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = rng.permuted(np.tile(np.arange(50), (30, 1)), axis=1)[:, :3].astype(np.int32)
    surface = Surface(vertices, normals, rng.integers(0, 256, (50, 3), dtype=np.uint8), triangles)
    write_mesh(surface, tmp_path / "mesh.ply")
    write_cloud(surface, tmp_path / "cloud.ply")
    mesh, cloud = o3d.io.read_triangle_mesh(tmp_path / "mesh.ply"), o3d.io.read_point_cloud(tmp_path / "cloud.ply")
    for read in (mesh.vertices, cloud.points):
        np.testing.assert_array_equal(np.asarray(read, dtype=np.float32), vertices)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), triangles)
    np.testing.assert_array_equal(np.asarray(cloud.normals, dtype=np.float32), normals)
    for read in (mesh.vertex_colors, cloud.colors):
        np.testing.assert_array_equal(np.rint(255 * np.asarray(read)), surface.colours)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[RenderSettings, Log]:
    settings = RenderSettings(
        camera=make_camera(width=160, height=120, focal=100.0, position=(0.0, 0.0, 1.0), pitch=-0.25),
        frames=60,
        min_views=3,
        min_parallax_deg=10.0,
        limits=BoxLimits(long_side=5, short_side=3),
    )
    folder = render_drive(settings, 0, tmp_path_factory.mktemp("rendered") / "log")
    log = read_log_folder(folder, Ledger())
    boxes = read_detections(folder / "groundtruth" / TRUTH_BOXES, Ledger())
    return settings, replace(log, cameras=(replace(log.cameras[0], detections=boxes),))


def room_distance(settings: RenderSettings, surface: Surface) -> float:
    """Mean distance of the vertices from the true room, m."""
    scene = o3d.t.geometry.RaycastingScene()
    for part in drive_room(settings, 0).parts:
        scene.add_triangles(
            o3d.core.Tensor(part.vertices.astype(np.float32)), o3d.core.Tensor(part.triangles.astype(np.uint32))
        )
    return float(scene.compute_distance(o3d.core.Tensor(surface.vertices)).numpy().mean())


def test_a_run_fuses_at_the_solved_poses(drive: tuple[RenderSettings, Log], tmp_path: Path) -> None:
    settings, log = drive
    # the drifting odometry is laid where the drive begins: then the map's frame is the room's
    assert log.odometry is not None
    assert log.truth is not None
    assert log.truth.trajectory is not None
    start = log.truth.trajectory.poses[0] @ inverse(log.odometry.poses[0])
    log = replace(log, localization=None, odometry=replace(log.odometry, poses=start @ log.odometry.poses))
    chosen = config.Reconstruction(before=True, cloud=True, min_views=2)
    ledger = Ledger()
    held = load_settings(None, ("mode=joint", *HELD))
    result = pipeline.run(log, held.model_copy(update={"reconstruction": chosen}), ledger)
    assert result.surface is not None
    assert result.surface_before is not None
    after, before = (room_distance(settings, surface) for surface in (result.surface, result.surface_before))
    assert after < 0.05
    assert after < 0.6 * before
    assert result.summary["seconds"]["reconstruction"] > 0
    write_result(result, tmp_path / "out")
    for name, surface in (("reconstruction.ply", result.surface), ("reconstruction_before.ply", result.surface_before)):
        mesh = o3d.io.read_triangle_mesh(tmp_path / "out" / name)
        np.testing.assert_array_equal(np.asarray(mesh.triangles), surface.triangles)
    assert len(o3d.io.read_point_cloud(tmp_path / "out" / "reconstruction_cloud.ply").points) == len(result.surface.vertices)
    plain = pipeline.run(log, held.model_copy(update={"reconstruction": config.Reconstruction(use=False)}), Ledger())
    assert plain.surface is None
    write_result(plain, tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.ply"))

"""recording.rrd, read back with rerun's own reader."""

from __future__ import annotations

import dataclasses
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest
from rrd import Recording, rgb
from scipy.spatial.transform import Rotation
from synthetic_result import clusters, synthetic_result
from waiting import LIMIT

from objslam.config import Settings
from objslam.core.calibration import Calibration
from objslam.core.geometry import inverse
from objslam.core.result import Doubt, RunResult, Surface
from objslam.core.trace import Iteration, Parameters, Round
from objslam.core.types import Association, Images, Truth
from objslam.output.plot.style import object_colours, ray_kinds
from objslam.output.viewer.application import program
from objslam.output.viewer.recording import write_recording
from objslam.output.viewer.surface import coarser


@pytest.fixture
def record(tmp_path: Path) -> Any:
    def write(result: RunResult, truth: Truth | None = None) -> Recording:
        write_recording(result, tmp_path / "a.rrd", truth)
        return Recording(tmp_path / "a.rrd")

    return write


def whole(tmp_path: Path, keyframes: int = 30) -> tuple[RunResult, Truth]:
    """A result with everything that a recording may hold."""
    result, truth = synthetic_result(*clusters(), keyframes=keyframes, unresolved=(4,))
    return dataclasses.replace(
        result,
        trace=rounds(result),
        images=(images(tmp_path, result.keyframes.stamps),),
        surface=sheet(20),
        summary={**result.summary, "log": "a drive", "seconds": {"rays": 0.1, "solve": 2.0}, "dropped": {"cut off": 3}},
    ), truth


def images(folder: Path, stamps: np.ndarray) -> Images:
    paths = []
    for k in range(len(stamps)):
        pixels = np.full((480, 640, 3), (k, 128, 255 - k), dtype=np.uint8)
        paths.append(folder / f"{k}.png")
        cv2.imwrite(str(paths[-1]), pixels)
    return Images(stamps, tuple(paths))


def rounds(result: RunResult) -> tuple[Round, ...]:
    """Two rounds: in the first, object 0 is two, and object 1 does not exist yet."""
    now = result.association
    before = now.object.copy()
    before[now.object == 1] = -1
    mine = np.flatnonzero(now.object == 0)
    before[mine[: len(mine) // 3]] = now.count
    labels = np.append(now.label, now.label[0])
    positions = np.stack([o.position for o in result.map.objects])
    path = result.map_T_base[:, :3, 3].astype(np.float32)
    first = [Iteration("grow", 5.0, path[:10], np.full((now.count + 1, 3), np.nan, dtype=np.float32))]
    first += [Iteration("solve", c, path, np.vstack([positions, positions[:1]]).astype(np.float32)) for c in (90.0, 70.0)]
    second = [Iteration("solve", c, path, positions.astype(np.float32)) for c in (60.0, 50.0)]
    return (
        Round(
            "association", Association(before, labels), tuple(first), result.map_T_base,
            np.vstack([positions, positions[0] + np.array([0.0, 0.3, 0.0])]), result.weight,
        ),
        Round("merge", now, tuple(second), result.map_T_base, positions, result.weight),
    )  # fmt: skip


def sheet(size: int) -> Surface:
    """A flat, finely meshed square of 1 m, red on the left, blue on the right."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size)))
    vertices = np.column_stack([x, y, np.zeros(len(x))]).astype(np.float32)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    triangles = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + size]),
            np.column_stack([corner + 1, corner + size + 1, corner + size]),
        ]
    )
    normals = np.tile(np.float32([0, 0, 1]), (len(x), 1))
    colours = np.where((x < 0.5)[:, None], [255, 0, 0], [0, 0, 255]).astype(np.uint8)
    return Surface(vertices, normals, colours, triangles.astype(np.int32))


def test_the_whole_story_is_in_the_recording(record: Any, tmp_path: Path) -> None:
    positions, labels = clusters()
    result, truth = whole(tmp_path)
    r = record(result, truth)
    assert r.paths() == {
        "/map", "/map/path/before", "/map/path/after", "/map/path/truth", "/map/objects", "/map/objects/uncertainty",
        "/map/objects/extent", "/map/objects/labels", "/map/objects/labels/lines", "/map/objects/unresolved", "/map/truth",
        "/map/base", "/map/rays/used", "/map/rays/rejected", "/map/rays/unexplained", "/map/rays/now",
        "/map/reconstruction/after", "/map/camera/front", "/map/camera/front/image", "/map/camera/front/boxes",
        "/map/camera/front/map", "/map/camera/front/map/labels", "/map/steps/path", "/map/steps/objects",
        "/plots/residual/median", "/plots/residual/worst", "/plots/boxes/used", "/plots/boxes/rejected",
        "/plots/boxes/unexplained", "/plots/cost/solve", "/plots/cost/grow", "/plots/rounds/objects",
        "/plots/rounds/unexplained", "/plots/seconds", "/log", "/summary",
    }  # fmt: skip
    for path in ("/map/objects", "/map/path/after", "/map/rays/used", "/map/reconstruction/after"):
        assert r.static[path] == {True}
    assert r.get("/map", "ViewCoordinates:xyz") == [[[3, 5, 1]]]  # right, forward, up: z up

    resolved = result.map.resolved()
    np.testing.assert_allclose(r.get("/map/objects", "Points3D:positions")[0], [o.position for o in resolved], rtol=1e-6)
    assert r.get("/map/objects", "Points3D:labels")[0] == [o.label for o in resolved]
    assert r.get("/map/objects/labels", "Points3D:labels")[0][4] == f"{labels[4]}, unresolved"
    np.testing.assert_allclose(r.get("/map/truth", "Points3D:positions")[0], positions, rtol=1e-6)
    for name, poses in (("before", result.path.poses), ("after", result.map_T_base), ("truth", truth.trajectory.poses)):
        (strip,) = r.get(f"/map/path/{name}", "LineStrips3D:strips")[0]
        np.testing.assert_allclose(strip, poses[:, :3, 3], rtol=1e-5, atol=1e-6)
    (unresolved,) = r.get("/map/objects/unresolved", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(unresolved[1], result.map.objects[4].position, rtol=1e-6)
    sized = [o for o in resolved if o.extent is not None]
    np.testing.assert_allclose(
        r.get("/map/objects/extent", "Boxes3D:half_sizes")[0], np.tile([0.1, 0.1, 0.15], (len(sized), 1)), rtol=1e-6
    )
    subprocess.run([program(), "rrd", "verify", tmp_path / "a.rrd"], check=True, capture_output=True, timeout=LIMIT)


def test_the_ellipsoids_are_the_covariances(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=5)
    r = record(result)
    half = np.array(r.get("/map/objects/uncertainty", "Ellipsoids3D:half_sizes")[0])
    turn = Rotation.from_quat(r.get("/map/objects/uncertainty", "Ellipsoids3D:quaternions")[0]).as_matrix()
    covariance = np.einsum("nij,nj,nkj->nik", turn, (half / 2) ** 2, turn)
    np.testing.assert_allclose(covariance, [o.covariance for o in result.map.objects], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(
        r.get("/map/objects/uncertainty", "Ellipsoids3D:centers")[0], [o.position for o in result.map.objects], rtol=1e-6
    )


def test_each_moment_has_its_rays_and_no_other(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20)
    result = drop_rays(result, result.rays.keyframe != 7)
    r = record(result)
    strips = r.get("/map/rays/now", "LineStrips3D:strips")
    counts = np.bincount(result.rays.keyframe, minlength=20)
    assert [len(row) for row in strips] == counts.tolist()
    assert counts[7] == 0
    np.testing.assert_allclose(np.array([s[0] for row in strips for s in row]), result.origins, rtol=1e-5, atol=1e-6)
    # blue, red, grey: which channel leads
    colours = [rgb(c) for row in r.get("/map/rays/now", "LineStrips3D:colors") for c in row]
    for (red, green, blue), held, weight in zip(colours, result.association.object >= 0, result.weight, strict=True):
        assert (red == green == blue) if not held else (blue > red) if weight >= 0.5 else (red > blue)
    assert len(r.get("/map/base", "Transform3D:translation")) == 20
    np.testing.assert_allclose(
        np.array([row[0] for row in r.get("/map/base", "Transform3D:translation")]), result.map_T_base[:, :3, 3], atol=1e-5
    )


def test_boxes_have_the_colour_of_their_object_grey_or_red(record: Any, tmp_path: Path) -> None:
    result, _ = whole(tmp_path, keyframes=12)
    r = record(result)
    rows = r.get("/map/camera/front/boxes", "Boxes2D:colors")
    assert [len(row) for row in rows] == [15] * 12
    colours = [rgb(c) for row in rows for c in row]
    kinds, palette = ray_kinds(result), np.array(object_colours(result.map))
    assert all(sum(mask) > 3 for mask in kinds.values())
    seen: dict[int, set[tuple[int, int, int]]] = {}
    for colour, j, used, rejected in zip(
        colours, result.association.object.tolist(), kinds["used"], kinds["rejected"], strict=True
    ):
        if used:
            seen.setdefault(j, set()).add(colour)
            lightened = 255 * palette[j] + 0.35 * (255 - 255 * palette[j])
            np.testing.assert_allclose(colour, lightened, atol=2)
        else:
            red, green, blue = colour
            assert (red > 2 * green and red > 2 * blue) if rejected else (red == green == blue)
    assert all(len(c) == 1 for c in seen.values())
    assert len({c for some in seen.values() for c in some}) == 15
    # images are half as wide, and all pixels with them
    np.testing.assert_allclose(r.get("/map/camera/front/boxes", "Boxes2D:centers")[0][0], [12.5, 12.5])
    np.testing.assert_allclose(r.get("/map/camera/front", "Pinhole:resolution")[0][0], [320, 240])


def test_the_objects_are_where_the_camera_should_see_them(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=25, unresolved=(2,))
    r = record(result)
    rows = r.get("/map/camera/front/map", "Points2D:positions")
    camera, poses = result.cameras[0], result.map_T_base @ result.keyframes.base_T_camera
    every = result.map.objects
    reach = np.zeros(len(every))
    for j, origin, used in zip(result.association.object, result.origins, ray_kinds(result)["used"], strict=True):
        if used:
            reach[j] = max(reach[j], 1.2 * np.linalg.norm(every[j].position - origin))
    total = 0
    for row, pose in zip(rows, poses, strict=True):
        expected = []
        for j, o in enumerate(every):
            x, y, z, _ = inverse(pose) @ np.append(o.position, 1.0)
            u, v, _ = camera.matrix @ [x / z, y / z, 1.0]
            near = np.linalg.norm(o.position - pose[:3, 3]) <= reach[j]
            if o.status == "ok" and z > 0.2 and near and 0 <= u < 640 and 0 <= v < 480:
                expected.append([u, v])
        np.testing.assert_allclose(np.array(row).reshape(-1, 2), np.array(expected).reshape(-1, 2), rtol=1e-4, atol=1e-2)
        total += len(expected)
    assert total > 20


def test_images_are_those_of_their_moment_and_never_more_than_asked_for(record: Any, tmp_path: Path) -> None:
    result, _ = whole(tmp_path, keyframes=20)
    assert result.images[0] is not None
    (tmp_path / "3.png").write_bytes(b"no image")  # the run has warned about it
    r = record(result)
    blobs = r.get("/map/camera/front/image", "EncodedImage:blob")
    assert [len(row) for row in blobs] == [1, 1, 1, 0] + [1] * 16
    for k, row in enumerate(blobs):
        if row:
            pixels = cv2.imdecode(np.array(row[0], dtype=np.uint8), cv2.IMREAD_COLOR)
            assert pixels.shape == (240, 320, 3)
            np.testing.assert_allclose(pixels[100, 100], (k, 128, 255 - k), atol=6)
    assert ["1 images could not be read"] in r.get("/log", "TextLog:text")
    few = dataclasses.replace(result, settings=Settings.model_validate({"output": {"images": 5, "image_width": 640}}))
    blobs = record(few).get("/map/camera/front/image", "EncodedImage:blob")
    assert sum(len(row) for row in blobs) == 5
    assert cv2.imdecode(np.array(blobs[0][0], dtype=np.uint8), cv2.IMREAD_COLOR).shape == (480, 640, 3)
    none = dataclasses.replace(result, settings=Settings.model_validate({"output": {"images": 0}}))
    assert "/map/camera/front/image" not in record(none).paths()


def test_one_can_step_through_the_iterations(record: Any, tmp_path: Path) -> None:
    result, _ = whole(tmp_path)
    r = record(result)
    assert r.columns["/map/steps/path", "iteration"] == [0, 1, 2, 3, 4]
    strips = r.get("/map/steps/path", "LineStrips3D:strips")
    assert [len(row[0]) for row in strips] == [10, 30, 30, 30, 30]
    points = r.get("/map/steps/objects", "Points3D:positions")
    assert [len(row) for row in points] == [0, 16, 16, 15, 15]
    np.testing.assert_allclose(points[-1], [o.position for o in result.map.objects], rtol=1e-5)
    assert r.get("/plots/cost/solve", "Scalars:scalars") == [[90.0], [70.0], [60.0], [50.0]]
    assert r.columns["/plots/cost/solve", "iteration"] == [1, 2, 3, 4]
    assert r.get("/plots/rounds/objects", "Scalars:scalars") == [[16.0]] * 3 + [[15.0]] * 2


def test_the_curves_are_the_residuals_of_each_frame(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=8)
    r = record(result)
    used = ray_kinds(result)["used"]
    for k, (median, worst) in enumerate(
        zip(
            r.get("/plots/residual/median", "Scalars:scalars"),
            r.get("/plots/residual/worst", "Scalars:scalars"),
            strict=True,
        )
    ):
        values = np.sort(np.degrees(result.residual[used & (result.rays.keyframe == k)]))
        assert worst[0] == pytest.approx(values[-1])
        assert median[0] == pytest.approx(values[len(values) // 2])
    for kind, mask in ray_kinds(result).items():
        counts = np.bincount(result.rays.keyframe[mask], minlength=8)
        assert [v[0] for v in r.get(f"/plots/boxes/{kind}", "Scalars:scalars")] == counts.tolist()


def test_the_curves_break_where_a_while_has_no_boxes(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=12)
    stamps = result.keyframes.stamps + np.where(np.arange(12) < 6, 0.0, 20.0)
    r = record(dataclasses.replace(result, keyframes=dataclasses.replace(result.keyframes, stamps=stamps)))
    curve = np.array(r.get("/plots/residual/median", "Scalars:scalars"))[:, 0]
    assert np.flatnonzero(np.isnan(curve)).tolist() == [6]
    assert len(curve) == 13


def test_two_cameras_at_one_stamp_show_their_rays_together(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=10)
    stamps = result.keyframes.stamps.copy()
    stamps[5] = stamps[4]
    camera = np.zeros(10, dtype=np.int64)
    camera[5] = 1
    keyframes = dataclasses.replace(result.keyframes, stamps=stamps, camera=camera)
    cameras = (result.cameras[0], dataclasses.replace(result.cameras[0], name="rear left"))
    r = record(dataclasses.replace(result, keyframes=keyframes, cameras=cameras))
    strips = r.get("/map/rays/now", "LineStrips3D:strips")
    assert [len(row) for row in strips] == [15] * 4 + [30] + [15] * 4
    assert [len(row) for row in r.get("/map/camera/front/boxes", "Boxes2D:centers")] == [15] * 9
    assert [len(row) for row in r.get("/map/camera/rear\\ left/boxes", "Boxes2D:centers")] == [15]


@pytest.mark.parametrize(("start", "kind"), [(100.0, pa.types.is_duration), (1.3e9, pa.types.is_timestamp)])
def test_unix_stamps_are_dates_others_durations(record: Any, start: float, kind: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=5, start=start)
    r = record(result)
    assert kind(r.types["/map/base", "stamp"])
    stamps = np.array([s for s in r.columns["/map/base", "stamp"] if s is not None])
    np.testing.assert_allclose(stamps * 1e-9, result.keyframes.stamps, rtol=0, atol=1e-6)


def test_a_long_run_makes_a_small_file(record: Any, tmp_path: Path) -> None:
    result, truth = synthetic_result(*clusters(), keyframes=2000)
    record(result, truth)
    # 15 boxes a keyframe here: each has a ray, a box and a label
    assert (tmp_path / "a.rrd").stat().st_size < 2000 * 10_000 / 3


def test_a_surface_is_drawn_coarser_than_it_is(record: Any) -> None:
    fine = sheet(150)
    few = coarser(fine, 2000)
    assert 500 < len(few.vertices) <= 2000
    a, b, c = (few.vertices[few.triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(1.0, rel=0.12)  # the rim is drawn in by half a cell
    np.testing.assert_allclose(few.normals, np.tile([0, 0, 1], (len(few.normals), 1)))
    assert few.colours is not None
    left = few.vertices[:, 0] < 0.45
    assert (few.colours[left] == [255, 0, 0]).all()
    assert coarser(fine, len(fine.vertices)) is fine
    assert coarser(dataclasses.replace(fine, colours=None), 2000).colours is None


def test_doubts_are_points_and_lines_between_pairs(record: Any) -> None:
    positions, labels = clusters()
    result, _ = synthetic_result(positions, labels)
    a, b = result.map.objects[0], result.map.objects[2]
    none = np.zeros(0, dtype=np.int64)
    pair = Doubt("pair", "may be one", "cup", "", (a.id, b.id), (a.position + b.position) / 2, none, {})
    boxes = Doubt("boxes", "apart", "mug", "", (), np.array([1.0, 2.0, 3.0]), np.arange(4), {})
    nowhere = Doubt("boxes", "follow", "dog", "", (), None, np.arange(2), {})
    r = record(dataclasses.replace(result, doubts=(pair, boxes, nowhere)))
    np.testing.assert_allclose(r.get("/map/doubts", "Points3D:positions")[0], [pair.position, boxes.position], atol=1e-6)
    assert r.get("/map/doubts", "Points3D:labels")[0] == ["cup: may be one", "4 mug: apart"]
    (line,) = r.get("/map/doubts/pairs", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(line, [a.position, b.position], atol=1e-6)
    assert "/map/doubts" not in record(result).paths()


@pytest.mark.parametrize("count", [0, 1])
def test_next_to_nothing_can_be_recorded(record: Any, count: int) -> None:
    result, _ = synthetic_result(np.ones((count, 3)), ["cup"] * count, keyframes=2, unresolved=(0,))
    assert ("/map/objects/unresolved" in record(result).paths()) == bool(count)
    lost = [dataclasses.replace(o, position=np.full(3, np.nan)) for o in result.map.objects]
    record(dataclasses.replace(result, map=dataclasses.replace(result.map, objects=tuple(lost))))


def test_a_recording_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=2)
    with pytest.raises(OSError, match="No such file"):
        write_recording(result, tmp_path / "none" / "a.rrd")


def drop_rays(result: RunResult, keep: np.ndarray) -> RunResult:
    """The result with a selection of its rays."""
    arrays = {name: getattr(result, name)[keep] for name in ("origins", "directions", "residual", "weight")}
    association = dataclasses.replace(result.association, object=result.association.object[keep])
    return dataclasses.replace(result, rays=result.rays.take(keep), association=association, **arrays)


def test_shared_errors_are_curves_over_the_iterations(record: Any, tmp_path: Path) -> None:
    result, _ = whole(tmp_path, keyframes=5)
    names, prior = ("odometry.scale", "front camera/left.clock"), np.array([0.03, 0.1])
    final = Calibration(names, np.array([0.012, -0.2]), np.diag([0.006, 0.004]) ** 2, prior)
    first, second = result.trace
    moved = Parameters(names, np.array([0.03, -0.1]), np.array([0.015, 0.05]))
    steps = (*first.iterations[:1], dataclasses.replace(first.iterations[1], parameters=moved), *first.iterations[2:])
    trace = (dataclasses.replace(first, iterations=steps), second)
    r = record(dataclasses.replace(result, trace=trace, calibration=final))
    for part, value, sigma in (
        ("odometry.scale", [1.0, 0.4], [1.0, 0.5, 0.2]),
        ("front\\ camera\\/left.clock", [-1.0, -2.0], [1.0, 0.5, 0.04]),
    ):
        at = r.get(f"/plots/calibration/{part}", "iteration")
        assert at == [1, 4]
        curve = r.get(f"/plots/calibration/{part}", "Scalars:scalars")
        np.testing.assert_allclose([row[0] for row in curve], value)
        assert r.get(f"/plots/calibration_sigma/{part}", "iteration") == [0, 1, 4]
        np.testing.assert_allclose([row[0] for row in r.get(f"/plots/calibration_sigma/{part}", "Scalars:scalars")], sigma)
    assert not [path for path in record(result).paths() if path.startswith("/plots/calibration")]

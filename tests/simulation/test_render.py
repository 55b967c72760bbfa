from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2, widest_angle
from objslam.errors import ConfigError, OutputError
from objslam.io.detections_jsonl import read_detections
from objslam.simulation import make_camera
from objslam.simulation.furniture import CEILING, Lamp, Room, furnish_room
from objslam.simulation.raycast import Caster
from objslam.simulation.render import BoxLimits, RenderSettings, render_drive, true_boxes
from objslam.simulation.sensor import Sensor, expose, exposures, measure_depth
from objslam.simulation.shapes import LABELS, Material, ball, box, make_object, torus, turned
from objslam.sources.log_folder import read_log_folder

GREY = Material(np.full(3, 0.5), np.full(3, 0.5))
CAMERA = make_camera(width=160, height=120, focal=100.0, position=(0.0, 0.0, 1.0), pitch=-0.25)
ALL = BoxLimits(visible=0, inside=0, long_side=0, short_side=0)
CLEAN = Sensor(exposure=0, white=0, blur=0, vignette=0, shot=0, read=0, depth_sigma=0, depth_sigma_per_m2=0, depth_missing=0)
SMALL = RenderSettings(
    camera=CAMERA,
    frames=30,
    laps=1.0,
    min_views=3,
    min_parallax_deg=10.0,
    limits=BoxLimits(long_side=5, short_side=3),
)


def room_of(*things, lamps=(Lamp(np.array([0.0, 0.0, 2.4]), np.ones(3)),)):
    """A room of things, each one part; those with a label are objects, numbered in their order."""
    parts = tuple(part for _, part in things)
    labels = tuple(label for label, _ in things if label is not None)
    owner = np.cumsum([label is not None for label, _ in things]) - 1
    owner[[label is None for label, _ in things]] = -1
    middles = [(p.vertices.min(axis=0) + p.vertices.max(axis=0)) / 2 for label, p in things if label is not None]
    return Room(parts, owner, labels, np.array(middles).reshape(-1, 3), lamps, np.full(3, 0.3))


def look_from(x, y, yaw, camera=CAMERA):
    return lift_se2(np.array([x, y, yaw])) @ camera.base_T_camera


@pytest.fixture(scope="module")
def furnished():
    return furnish_room((6.0, 5.0), LABELS, np.random.default_rng(4))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return render_drive(SMALL, 3, tmp_path_factory.mktemp("rendered") / "drive")


@pytest.mark.parametrize(
    ("part", "volume"),
    [
        (box((0.2, 0.3, 0.5), (1, 2, 3), GREY), 0.03),
        (turned([(0.1, 0.0), (0.1, 0.4)], GREY, segments=400), np.pi * 0.01 * 0.4),
        (turned([(0.2, 0.0), (0.1, 0.3)], GREY, segments=400), np.pi * 0.3 / 3 * (0.04 + 0.02 + 0.01)),
        (torus(0.3, 0.05, 0.05, GREY, segments=400), 2 * np.pi**2 * 0.3 * 0.05**2),
        (ball(0.2, 0.2, GREY), 4 / 3 * np.pi * 0.2**3),
    ],
    ids=["box", "cylinder", "frustum", "torus", "ball"],
)
def test_meshes_are_closed_and_face_outwards(part, volume):
    a, b, c = (part.vertices[part.triangles[:, i]] for i in range(3))
    signed = np.einsum("ti,ti->t", a, np.cross(b, c)).sum() / 6  # divergence theorem: positive when faces look outwards
    assert signed == pytest.approx(volume, rel=0.06)


@pytest.mark.parametrize("label", LABELS)
def test_each_object_stands_on_the_ground_and_has_a_size_that_can_be_seen(label):
    points = np.concatenate([part.vertices for part in make_object(label, np.random.default_rng(0))])
    size = np.ptp(points, axis=0)
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    assert 0.08 <= size.max() <= 0.28
    assert np.abs((points.min(axis=0) + points.max(axis=0))[:2]).max() < 0.02


def test_the_depth_of_a_wall_is_its_distance_along_the_optical_axis():
    camera = make_camera(width=160, height=120, focal=100.0, position=(0.0, 0.0, 1.0))
    caster = Caster(room_of((None, box((0.2, 20, 20), (3.1, 0, 0), GREY))), camera)
    cast = caster.cast(look_from(0.5, 0.0, 0.0, camera))
    np.testing.assert_allclose(cast.depth, 2.5, atol=1e-5)
    np.testing.assert_allclose(cast.point[..., 0], 3.0, atol=1e-5)


def test_the_depth_of_the_floor_follows_from_the_pitch():
    caster = Caster(room_of((None, box((40, 40, 0.2), (0, 0, -0.1), GREY))), CAMERA)
    cast = caster.cast(look_from(0.0, 0.0, 0.7))
    down = (CAMERA.base_T_camera[:3, :3] @ caster.directions[..., None])[..., 2, 0]
    below = down < -0.1
    np.testing.assert_allclose(cast.depth[below], 1.0 / -down[below], rtol=1e-4)
    assert np.isinf(cast.depth[down > 0.01]).all()
    assert (cast.part[down > 0.01] == -1).all()


def test_a_distorted_camera_sees_points_where_opencv_projects_them():
    camera = replace(CAMERA, distortion=np.array([-0.2, 0.05, 0.001, -0.001, 0.0]))
    caster = Caster(room_of(("ball", ball(0.1, 1.0, GREY).moved(lift_se2(np.array([2.0, 0.4, 0.0]))))), camera)
    pose = look_from(0.0, 0.0, 0.0, camera)
    found = true_boxes(caster, caster.cast(pose), pose, ALL)
    local = inverse(pose) @ np.append(caster.room.middle[0], 1.0)
    pixel = cv2.projectPoints(local[None, :3], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0].ravel()
    middle = (found.box[0, :2] + found.box[0, 2:] - 1) / 2  # boxes count edges, OpenCV the middles of pixels
    np.testing.assert_allclose(middle, pixel, atol=0.6)


def test_boxes_are_those_of_the_instance_ids(furnished):
    caster = Caster(furnished, CAMERA)
    seen = 0
    for yaw in np.linspace(0, 2 * np.pi, 9):
        pose = look_from(0.3, -0.2, yaw)
        cast = caster.cast(pose)
        found = true_boxes(caster, cast, pose, ALL)
        owner = furnished.owner[cast.part]
        owner[cast.part < 0] = -1
        assert set(found.object) == set(owner[owner >= 0])
        for number, rectangle, depth in zip(found.object, found.box, found.depth, strict=True):
            rows, columns = np.nonzero(owner == number)
            assert rectangle.tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            assert depth in cast.depth[owner == number]
            seen += 1
    assert seen > 10


def test_the_middle_of_an_object_projects_into_its_box(furnished):
    caster = Caster(furnished, CAMERA)
    checked = 0
    for yaw in np.linspace(0, 2 * np.pi, 9):
        pose = look_from(0.0, 0.0, yaw)
        found = true_boxes(caster, caster.cast(pose), pose, BoxLimits(visible=0.9, long_side=5, short_side=3))
        for number, rectangle in zip(
            found.object[found.counts & ~found.cut], found.box[found.counts & ~found.cut], strict=True
        ):
            local = (inverse(pose) @ np.append(furnished.middle[number], 1.0))[:3]
            pixel = (CAMERA.matrix @ local)[:2] / local[2] + 0.5
            middle, half = (rectangle[:2] + rectangle[2:]) / 2, (rectangle[2:] - rectangle[:2]) / 2
            assert (np.abs(pixel - middle) <= 0.35 * half + 1).all()
            checked += 1
    assert checked > 7


def test_hidden_small_and_cut_objects_do_not_count():
    wall = box((0.02, 1.0, 0.3), (1.5, 0.06, 0.85), GREY)
    things = (
        ("front", box((0.2, 0.2, 0.2), (2, 0, 0.8), GREY)),
        ("tiny", box((0.02, 0.02, 0.02), (3, -0.6, 0.8), GREY)),
        ("edge", box((0.4, 0.4, 0.4), (2, 1.55, 0.8), GREY)),
        ("behind", box((0.4, 0.4, 0.4), (-2, 0, 0.8), GREY)),
    )
    pose = look_from(0.0, 0.0, 0.0)
    limits = BoxLimits(long_side=6, short_side=6)
    free = Caster(room_of(*things), CAMERA)
    found = true_boxes(free, free.cast(pose), pose, limits)
    assert dict(zip(found.object.tolist(), found.counts.tolist(), strict=True)) == {0: True, 1: False, 2: False}
    assert found.cut.tolist() == [False, False, True]
    hidden = Caster(room_of(*things, (None, wall.moved(lift_se2(np.array([0, -0.5, 0]))))), CAMERA)
    half = true_boxes(hidden, hidden.cast(pose), pose, limits)
    whole = hidden.silhouettes(pose, np.array([0]))[0]
    assert whole == free.silhouettes(pose, np.array([0]))[0] == (free.owners(free.cast(pose)) == 0).sum()
    assert not half.counts[half.object == 0].any()


def test_light_falls_off_and_shadows_are_darker():
    floor = (None, box((8, 8, 0.2), (0, 0, -0.1), GREY))
    blocker = (None, box((0.5, 0.5, 0.05), (2.0, 0, 1.2), GREY))
    lamp = (Lamp(np.array([2.0, 0.0, 2.4]), np.ones(3)),)
    pose = look_from(0.0, 0.0, 0.0)
    open_room, shaded_room = (Caster(room_of(*things, lamps=lamp), CAMERA) for things in ((floor,), (floor, blocker)))
    cast = shaded_room.cast(pose)
    below = (cast.part == 0) & (np.abs(cast.point[..., :2] - [2.0, 0.0]) < 0.3).all(axis=-1)
    far = (cast.part == 0) & (cast.point[..., 0] > 3.5)
    shaded, free = (c.shade(c.cast(pose), pose[:3, 3]).mean(axis=-1) for c in (shaded_room, open_room))
    assert below.sum() > 50
    assert shaded[below].max() < 0.6 * free[below].min()
    assert free[far].mean() < 0.8 * free[below].mean()


@pytest.mark.parametrize("seed", range(3))
def test_furniture_keeps_to_the_walls_and_objects_stand_apart_on_it(seed):
    size = (6.0, 5.0)
    room = furnish_room(size, LABELS, np.random.default_rng(seed))
    for part in room.parts[6:]:
        low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
        gap = np.max([np.abs([low[:2], high[:2]]).min(axis=0) - (np.array(size) / 2 - 0.75)])
        assert gap >= 0, "something stands in the middle of the room"
        assert high[2] <= CEILING
    apart = np.linalg.norm(room.middle[:, None] - room.middle[None], axis=2)[np.triu_indices(len(LABELS), 1)]
    assert apart.min() > 0.2
    assert ((room.middle[:, 2] > 0.35) & (room.middle[:, 2] < 0.95)).all()


def test_a_room_too_small_for_its_objects_is_refused():
    with pytest.raises(ConfigError, match=r"places, not the 700 needed.*larger room"):
        furnish_room((6.0, 5.0), LABELS * 100, np.random.default_rng(0))


def test_a_clean_sensor_gives_back_the_light_and_the_depth():
    rng = np.random.default_rng(0)
    light = rng.uniform(0.1, 0.4, (60, 80, 3)).astype(np.float32)
    light *= 0.25 / light.mean()
    image = expose(CLEAN, light, np.ones(3), rng)
    np.testing.assert_allclose((image / 255) ** 2.2, light, atol=0.006)
    depth = np.full((60, 80), 2.0, dtype=np.float32)
    np.testing.assert_allclose(measure_depth(CLEAN, depth, rng), 2.0)


def test_depth_noise_grows_with_the_square_and_has_holes_at_edges_and_out_of_range():
    sensor = CLEAN.model_copy(update={"depth_sigma_per_m2": 0.004, "depth_missing": 0.05})
    rng = np.random.default_rng(1)
    depth = np.full((200, 200), 1.0, dtype=np.float32)
    depth[:, 100:] = 4.0
    depth[:20] = np.inf
    depth[20:40] = 9.0
    measured = measure_depth(sensor, depth, rng)
    assert (measured[:40] == 0).all()
    assert (measured[:, 99:101] == 0).all()
    for columns, z in ((slice(0, 99), 1.0), (slice(101, 200), 4.0)):
        inner = measured[42:, columns]
        assert (inner == 0).mean() == pytest.approx(0.05, abs=0.01)
        assert (inner[inner > 0] - z).std() == pytest.approx(0.004 * z**2, rel=0.05)


def test_exposure_wanders_slowly_and_as_far_as_it_should():
    gains = np.log(exposures(Sensor(exposure=0.3, white=0.0), 20_000, np.random.default_rng(0)))
    assert gains[:, 0].std() == pytest.approx(0.3, rel=0.15)
    assert np.abs(np.diff(gains[:, 0])).mean() < 0.1
    assert np.ptp(gains, axis=1).max() < 1e-12


def test_a_drive_is_a_log_with_images_depth_and_truth(drive):
    ledger = Ledger()
    log = read_log_folder(drive, ledger)
    assert ledger.lines() == []
    camera = log.cameras[0]
    assert camera.detections is None
    assert len(camera.rgb.paths) == len(camera.depth.paths) == SMALL.frames
    image = cv2.imread(str(camera.rgb.paths[0]))
    depth = cv2.imread(str(camera.depth.paths[0]), cv2.IMREAD_UNCHANGED)
    assert image.shape == (120, 160, 3)
    assert depth.shape == (120, 160)
    assert depth.dtype == np.uint16
    assert 0.3 < np.median(depth[depth > 0]) / camera.camera.depth_scale < 6.0
    assert sorted(o.label for o in log.truth.objects) == sorted(LABELS)
    assert len(log.odometry) > SMALL.frames
    error = np.linalg.norm(log.localization.poses[:1, :3, 3] - log.truth.trajectory.poses[:1, :3, 3])
    assert 0 < error < 0.2
    assert [path.name for path in drive.parent.iterdir()] == [drive.name], "something was left beside the log"


def test_every_object_of_a_drive_is_seen_often_and_from_several_sides(drive):
    log = read_log_folder(drive, Ledger())
    boxes = read_detections(drive / "groundtruth" / "boxes.jsonl", Ledger())
    poses = log.truth.trajectory.poses
    for thing in log.truth.objects:
        mine = boxes.take(boxes.track_ids == thing.id)
        assert {boxes.label_names[i] for i in mine.label} == {thing.label}
        assert len(mine) >= SMALL.min_views
        towards = thing.position - (poses @ CAMERA.base_T_camera)[mine.frame, :3, 3]
        directions = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        assert widest_angle(directions) >= np.deg2rad(SMALL.min_parallax_deg)


def test_true_depths_and_boxes_agree_with_the_true_positions(drive):
    log = read_log_folder(drive, Ledger())
    boxes = read_detections(drive / "groundtruth" / "boxes.jsonl", Ledger())
    places = np.array([thing.position for thing in log.truth.objects])[boxes.track_ids]
    camera_T_map = inverse(log.truth.trajectory.poses @ CAMERA.base_T_camera)[boxes.frame]
    local = np.einsum("nij,nj->ni", camera_T_map[:, :3, :3], places) + camera_T_map[:, :3, 3]
    assert np.abs(local[:, 2] - boxes.depths).max() < 0.2  # half an object
    pixels = local[:, :2] / local[:, 2:] * CAMERA.focal + CAMERA.matrix[:2, 2] + 0.5
    sides = boxes.boxes[:, 2:] - boxes.boxes[:, :2]
    inside = (pixels >= boxes.boxes[:, :2] - 0.2 * sides) & (pixels <= boxes.boxes[:, 2:] + 0.2 * sides)
    assert inside.all(axis=1).mean() > 0.9  # the middles of objects half outside the image are outside as well


def test_the_same_seed_gives_the_same_drive_on_any_number_of_threads_and_another_another(tmp_path):
    short = SMALL.model_copy(update={"frames": 8, "min_views": 0, "min_parallax_deg": 0.0})
    drives = ((1, "a", 1), (1, "b", 3), (2, "c", 1))
    first, again, other = (render_drive(short, seed, tmp_path / name, workers=workers) for seed, name, workers in drives)
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert len(files) > 2 * short.frames
    assert all((first / file).read_bytes() == (again / file).read_bytes() for file in files)
    assert (first / "rgb/000000.jpg").read_bytes() != (other / "rgb/000000.jpg").read_bytes()


def test_what_is_there_is_not_written_over(drive):
    with pytest.raises(OutputError, match="there is a log already"):
        render_drive(SMALL, 3, drive)


def test_a_drive_that_cannot_see_its_objects_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("objslam.simulation.render.ROUNDS", 1)
    blind = SMALL.model_copy(update={"frames": 4, "min_views": 50})
    with pytest.raises(ConfigError, match=r"not seen well enough.*more frames"):
        render_drive(blind, 0, tmp_path / "blind")
    assert not (tmp_path / "blind").exists()


def test_settings_that_make_no_drive_are_refused():
    with pytest.raises(ValidationError, match="no object is called 'spoon'"):
        RenderSettings(labels=("ring", "spoon"))
    with pytest.raises(ValidationError, match="margin leaves no room"):
        RenderSettings(margin=2.6)

"""The offline driver on whole logs: what it finds, what it tells, and logs of every shape."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from added_errors import add_shared_errors
from quick import HELD
from small_log import THINGS, crowded, small_log

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3, interpolate, inverse, lift_se2
from objslam.core.object_map import ObjectMap
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, CameraLog, Detections, Log, Truth, TruthObject
from objslam.errors import LogError, SolveError
from objslam.frontend.boxes.nested_boxes import PARTS
from objslam.mapping import pipeline
from objslam.mapping.describe import counted_weights
from objslam.simulation import DepthNoise, make_camera, pair, preset, simulate
from objslam.simulation.trajectory import START

MODES = ["fixed", "joint"]
WHOLE = ("noise.localization=true", "bodies.use=true")
AS_SAID = ("noise.localization=false", "bodies.use=false")


def run(log: Log, mode: str = "fixed", *overrides: str, ledger: Ledger | None = None, **more):
    """A run that does not look for wrong input, unless it is told to.

    Joint mode at a localisation takes the noise that the settings say, which is that of the simulation. It looks for no
    bodies either: fixed mode does so in the same way. These two take most of its time. `WHOLE` has them.
    """
    less = AS_SAID if mode == "joint" and log.localization is not None else ()
    settings = load_settings(None, (f"mode={mode}", "rays.pixel_sigma=2", "checks.use=false", *less, *overrides))
    return pipeline.run(log, settings, ledger or Ledger(), **more)


def worst_error(result, log: Log) -> float:
    """The largest error (m) of the objects, which must be those of the log, one each."""
    place = {o.label: o.position for o in log.truth.objects}
    resolved = result.map.resolved()
    assert Counter(o.label for o in resolved) == Counter(place.keys())
    return max(float(np.linalg.norm(o.position - place[o.label])) for o in resolved)


@pytest.mark.parametrize("mode", MODES)
def test_a_crowd_of_one_label_does_no_harm(mode):
    log, ledger = small_log(), Ledger()
    crowd = crowded(log, np.arange(0, 80, 16), 10_000)
    result = run(crowd, mode, ledger=ledger)
    beyond = ledger.dropped["boxes beyond the 1000 surest of their label in a frame"]
    assert beyond + ledger.dropped[PARTS] == 5 * 9000  # A few boxes lie on others, as a second box of one thing does.
    assert beyond > 5 * 8990
    assert worst_error(replace(result, map=ObjectMap(tuple(o for o in result.map.objects if o.label != "leaf"))), log) < 0.05


@cache
def with_false_boxes(mode: str) -> tuple[Log, RunResult, Ledger]:
    """A small log with false boxes, its result, and what the run warned of."""
    log, ledger = small_log(false=0.1), Ledger()
    return log, run(log, mode, *WHOLE, ledger=ledger), ledger


@pytest.mark.parametrize("mode", MODES)
def test_what_a_result_holds_fits_together(mode):
    log, result, ledger = with_false_boxes(mode)
    assert worst_error(result, log) < 0.05
    rays, keyframes, k, r = result.rays, result.keyframes, len(result.keyframes), len(result.rays)
    assert result.map_T_base.shape == (k, 4, 4)
    assert len(np.unique(rays.keyframe)) == k  # every keyframe has a ray
    origins, directions = rays.in_map(result.map_T_base @ keyframes.base_T_camera)
    np.testing.assert_allclose(result.origins, origins, atol=1e-12)
    np.testing.assert_allclose(result.directions, directions, atol=1e-12)
    owner = result.association.object
    assert owner.max() < len(result.map)
    # Rays meet at the ray point, which is the position unless the object has a body.
    positions = np.array([o.position if o.ray_point is None else o.ray_point for o in result.map.objects])
    held = owner >= 0
    to = positions[owner[held]] - origins[held]
    angle = np.arccos(np.clip((to * directions[held]).sum(axis=1) / np.linalg.norm(to, axis=1), -1, 1))
    np.testing.assert_allclose(result.residual[held], angle, atol=1e-7)
    assert np.isnan(result.residual[~held]).all()
    assert (result.weight[~held] == 0).all()
    for j, o in enumerate(result.map.objects):
        mine = (owner == j) & (result.weight > 0)
        stamps = keyframes.stamps[rays.keyframe[owner == j]]
        assert (o.id, o.rays, o.frames) == (j, mine.sum(), len(np.unique(rays.keyframe[mine])))
        assert (o.first_seen, o.last_seen) == (stamps.min(), stamps.max())
        assert o.rms_deg == pytest.approx(np.degrees(np.sqrt((result.residual[mine] ** 2).mean())), abs=1e-3)
        apart = np.degrees(np.arccos(np.clip(np.abs(directions[mine] @ directions[mine].T), 0, 1))).max()
        assert o.parallax_deg == pytest.approx(apart, abs=1e-2)
        assert {rays.label_names[i] for i in rays.label[owner == j]} == {o.label}
    counts = result.summary["counts"]
    dropped_boxes = sum(n for reason, n in ledger.dropped.items() if reason.startswith("boxes"))
    assert counts["rays"] == r
    assert counts["detections"] == len(log.cameras[0].detections) == r + dropped_boxes
    assert counts["rays_unexplained"] == (~held).sum()
    assert counts["rays_rejected"] == (result.weight[held] == 0).sum()
    assert counts["keyframes"] == k
    assert (counts["objects"], counts["unresolved"]) == (4, 0)
    assert result.summary["dropped"] == ledger.dropped
    assert result.summary["mode"] == mode
    assert result.summary["cost_after"] <= result.summary["cost_before"]
    assert {"rays", "solve"} <= result.summary["seconds"].keys()
    assert {"objslam", "gtsam", "torch", "numpy"} <= result.summary["versions"].keys()
    np.testing.assert_array_equal(result.path.stamps, log.localization.stamps)
    np.testing.assert_array_equal(result.path_after.stamps, log.localization.stamps)


def test_fixed_mode_leaves_the_path_and_joint_mode_corrects_it():
    log = small_log()
    fixed, joint = run(log), run(log, "joint")
    np.testing.assert_array_equal(fixed.map_T_base, fixed.keyframes.map_T_base)
    np.testing.assert_allclose(fixed.path_after.poses, log.localization.poses, atol=1e-12)
    true = log.truth.trajectory

    def off(path):
        poses, valid = interpolate(true.stamps, true.poses, path.stamps, 1.0)
        return np.sqrt((np.linalg.norm((path.poses - poses)[valid, :3, 3], axis=1) ** 2).mean())

    at_keyframes = Trajectory(joint.keyframes.stamps, joint.map_T_base)
    assert off(at_keyframes) < 0.6 * off(Trajectory(fixed.keyframes.stamps, fixed.map_T_base))


@pytest.mark.parametrize("mode", MODES)
def test_the_same_log_gives_the_same_map(mode):
    log, first, _ = with_false_boxes(mode)
    second = run(log, mode, *WHOLE)
    for a, b in zip(first.map.objects, second.map.objects, strict=True):
        assert (a.label, a.rays) == (b.label, b.rays)
        np.testing.assert_array_equal(a.position, b.position)
        np.testing.assert_array_equal(a.covariance, b.covariance)
    np.testing.assert_array_equal(first.map_T_base, second.map_T_base)


def test_progress_is_told_by_stage():
    told = []
    run(small_log(localization=None), "joint", progress=lambda *step: told.append(step))
    stages = [stage for stage, _, _ in told]
    assert stages[0] == "load"
    assert "solve" in stages
    assert all(0 <= done <= max(total, done) for _, done, total in told)
    assert any(total and done == total for _, done, total in told)


def test_the_poses_taken_as_they_are_are_warned_about():
    ledger = Ledger()
    run(small_log(localization=None), "fixed", ledger=ledger)
    assert any("--mode joint" in warning for warning in ledger.warnings)


@pytest.mark.parametrize("mode", MODES)
def test_no_usable_box_is_an_error_that_says_why(mode):
    log = small_log()
    with pytest.raises(SolveError, match=r"no box gives a usable ray.*below rays.min_score"):
        run(log, mode, "rays.min_score=2")


def test_few_boxes_between_0_and_1_are_refused_as_shares_of_the_image():
    log = small_log(frames=3)
    (camera_log,) = log.cameras
    boxes = camera_log.detections.boxes / np.tile(camera_log.camera.size, 2)
    assert 0 < len(boxes) < 20
    shares = replace(log, cameras=(replace(camera_log, detections=replace(camera_log.detections, boxes=boxes)),))
    with pytest.raises(LogError, match="are shares of the image, not px: all lie between 0 and 1"):
        run(shares, "fixed", "checks.use=true")


# Logs of every shape


def test_odometry_that_begins_elsewhere_after_a_gap():
    log = small_log()
    stamps, begin = log.odometry.stamps, log.odometry.stamps[0]
    late = stamps > begin + 8
    poses = np.where(late[:, None, None], lift_se2(np.array([3.0, -2.0, 0.8])) @ log.odometry.poses, log.odometry.poses)
    heard = late | (stamps < begin + 6)
    result = run(replace(log, odometry=Trajectory(stamps[heard], poses[heard])), "joint")
    assert worst_error(result, log) < 0.05
    true = log.truth.trajectory
    there, _ = interpolate(true.stamps, true.poses, result.keyframes.stamps, 1.0)
    assert np.linalg.norm((result.map_T_base - there)[:, :3, 3], axis=1).max() < 0.1


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("paths", ["both", "localization", "odometry"])
def test_several_cameras(mode, paths):
    places = (("left", (0.0, 0.1, 0.3), np.pi / 2), ("front", (0.1, 0.0, 0.4), 1.0), ("back", (-0.1, 0.0, 0.4), 2.2))
    cameras = tuple(make_camera(name, focal=380.0, position=place, yaw=yaw) for name, place, yaw in places)
    changes = {"both": {}, "localization": {"odometry": None}, "odometry": {"localization": None}}[paths]
    log = small_log(cameras=cameras, false=0.0, **changes)
    result = run(log, mode, *(() if paths == "both" else HELD))
    assert len(set(result.keyframes.camera)) == 3
    if (mode, paths) == ("fixed", "odometry"):  # as far off as the odometry, if not twice there
        assert {o.label for o in result.map.resolved()} == {label for label, _ in THINGS}
    else:
        assert worst_error(result, log) < 0.06


def seen_through(log: Log, map_T_base: Trajectory, mount: Trajectory, depth: bool = False) -> Log:
    """The log with boxes of its true objects as its camera on that mount would see them from that path, 2 px of noise."""
    rng, (camera_log,) = np.random.default_rng(0), log.cameras
    camera, stamps = camera_log.camera, camera_log.detections.frame_stamps
    base, on_path = interpolate(map_T_base.stamps, map_T_base.poses, stamps, 1.0)
    arm, on_mount = interpolate(mount.stamps, mount.poses, stamps, 1.0)
    assert on_path.all()
    assert on_mount.all()
    names = tuple(sorted(o.label for o in log.truth.objects))
    place = np.array([next(o.position for o in log.truth.objects if o.label == name) for name in names])
    to_camera = inverse(base @ arm)
    local = np.einsum("kij,nj->kni", to_camera[:, :3, :3], place) + to_camera[:, None, :3, 3]
    pixels = local @ camera.matrix.T
    pixels = pixels[..., :2] / pixels[..., 2:] + rng.normal(scale=2.0, size=(*local.shape[:2], 2))
    seen = (local[..., 2] > 0.3) & ((pixels > 30) & (pixels < [camera.width - 30, camera.height - 30])).all(axis=2)
    frame, label = np.nonzero(seen)
    centre, m = pixels[seen], int(seen.sum())
    detections = Detections(
        frame_stamps=stamps,
        frame=frame,
        boxes=np.hstack([centre - 20, centre + 20]),
        label=label,
        scores=np.ones(m),
        depths=local[seen][:, 2] if depth else np.full(m, np.nan),
        track_ids=np.full(m, -1),
        label_names=names,
    )
    return replace(log, cameras=(CameraLog(camera, detections, mount=mount),))


STAMPS = START + np.arange(-1, 21, 0.05)


def still(log: Log) -> Trajectory:
    return Trajectory(STAMPS, np.tile(log.cameras[0].camera.base_T_camera, (len(STAMPS), 1, 1)))


@pytest.mark.parametrize(("mode", "localised"), [("fixed", True), ("joint", True), ("joint", False)])
def test_a_camera_on_a_moving_arm(mode, localised):
    log, t = small_log(), STAMPS - START
    zero = np.zeros_like(t)
    swing = exp_se3(np.stack([zero, zero, 0.3 * np.sin(t), 0.1 * np.cos(t), zero, 0.05 * np.sin(2 * t)], axis=1))
    arm = Trajectory(STAMPS, swing @ log.cameras[0].camera.base_T_camera)
    log = seen_through(log, log.truth.trajectory, arm)
    log = log if localised else replace(log, localization=None)
    assert worst_error(run(log, mode), log) < 0.05
    forgotten = replace(log, cameras=(replace(log.cameras[0], mount=None),))
    with pytest.raises(AssertionError):  # it is the arm's pose that makes the difference
        assert worst_error(run(forgotten, mode, *HELD), log) < 0.05


def ramp(log: Log) -> Trajectory:
    """The true path with roll, pitch and height in it."""
    true = log.truth.trajectory
    t = true.stamps - true.stamps[0]
    zero = np.zeros_like(t)
    sway = np.stack([0.1 * np.sin(t), 0.15 * np.cos(0.7 * t), zero, zero, zero, 0.2 * np.sin(0.5 * t)], axis=1)
    return Trajectory(true.stamps, true.poses @ exp_se3(sway))


def test_odometry_in_space():
    log = small_log()
    true = ramp(log)
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(len(true) - 1, 6)) * [0.003, 0.003, 0.005, 0.004, 0.004, 0.004]
    steps = inverse(true.poses[:-1]) @ true.poses[1:] @ exp_se3(noise)
    poses = [true.poses[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    odometry = Trajectory(true.stamps, np.array(poses))
    log = replace(seen_through(log, true, still(log)), odometry=odometry, localization=None)
    result = run(log, "joint")
    assert worst_error(result, log) < 0.06
    after = np.linalg.norm((result.map_T_base - true.poses)[:, :3, 3], axis=1)
    before = np.linalg.norm((odometry.poses - true.poses)[:, :3, 3], axis=1)
    assert after.max() < 0.5 * before.max()


@pytest.mark.parametrize("mode", MODES)
def test_localisation_in_space(mode):
    """As a hand-held recording: the poses are what they are."""
    log = small_log()
    true = ramp(log)
    log = replace(seen_through(log, true, still(log)), odometry=None, localization=true)
    assert worst_error(run(log, mode), log) < 0.03


@pytest.mark.parametrize("mode", MODES)
def test_depths_in_detections(mode):
    log = small_log(depth=DepthNoise(missing=0.3, wrong=0.1))
    result = run(log, mode)
    assert 0.6 < np.isfinite(result.rays.range).mean() < 0.8
    assert worst_error(result, log) < 0.05


def test_depths_place_what_has_no_parallax():
    """A robot that stands, and sees how far things are."""
    log = small_log()
    stands = Trajectory(STAMPS, np.tile(log.truth.trajectory.poses[0], (len(STAMPS), 1, 1)))
    log = replace(log, localization=stands, odometry=None)
    assert not run(seen_through(log, stands, still(log)), "fixed").map.resolved()
    for mode in MODES:
        result = run(seen_through(log, stands, still(log), depth=True), mode)
        place = {o.label: o.position for o in log.truth.objects}
        assert len(result.map.resolved()) >= 3
        for o in result.map.resolved():
            assert np.linalg.norm(o.position - place[o.label]) < 0.1


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("localised", [True, False])
def test_a_frame_or_two(mode, frames, localised):
    log = small_log(false=0.0, missed=0.0)
    detections = log.cameras[0].detections
    few = replace(detections.take(detections.frame < frames), frame_stamps=detections.frame_stamps[:frames])
    log = replace(log, cameras=(replace(log.cameras[0], detections=few),))
    ledger = Ledger()
    result = run(log if localised else replace(log, localization=None), mode, ledger=ledger)
    assert len(result.keyframes) == frames
    if frames == 1:
        assert not result.map.resolved()
    unexplained = result.summary["counts"]["rays_unexplained"]
    assert sum(o.rays for o in result.map.objects) + unexplained == len(few)


@pytest.mark.parametrize("mode", MODES)
def test_labels_of_any_kind(mode):
    """Spaces, other scripts, quotes, what looks like YAML or markup."""
    odd = ["[bold]cup[/bold]", "стул", "杯子 № 2", 'a "b" \\ {c}: - #d']
    placed = tuple((label, place) for label, (_, place) in zip(odd, THINGS, strict=True))
    log = small_log(placed=placed)
    assert worst_error(run(log, mode), log) < 0.05


@pytest.mark.parametrize("mode", MODES)
def test_hundreds_of_labels(mode):
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(-1.5, 1.5, (150, 2)), rng.uniform(0.2, 1.0, 150)])
    log = small_log()
    many = tuple(TruthObject(i, f"part no. {i:03d}", place) for i, place in enumerate(places))
    log = replace(log, truth=replace(log.truth, objects=many))
    log = seen_through(log, log.truth.trajectory, still(log))
    detections = log.cameras[0].detections
    some = detections.take(np.random.default_rng(4).random(len(detections)) < 0.3)
    log = replace(log, cameras=(replace(log.cameras[0], detections=some),))
    result = run(log, mode, *HELD)
    errors = [np.linalg.norm(o.position - places[int(o.label[-3:])]) for o in result.map.resolved()]
    assert len(result.map.resolved()) >= 145
    assert np.median(errors) < 0.03
    assert len({o.label for o in result.map.resolved()}) == len(result.map.resolved())


def corridor(length: float = 28.0, every: float = 4.0) -> Log:
    """Straight ahead, with a camera that looks to the left at one thing after the other: never two at a time."""
    camera = make_camera("left", position=(0.0, 0.0, 0.5), yaw=np.pi / 2)
    x = np.arange(0.0, length, 0.2)
    poses = lift_se2(np.column_stack([x, np.zeros_like(x), np.zeros_like(x)]))
    things = np.array([[at, 3.0, 0.5] for at in np.arange(every / 2, length, every)])
    frame, thing = np.nonzero(np.abs(x[:, None] - things[:, 0]) < every / 2 - 0.1)
    u = camera.matrix[0, 2] + camera.matrix[0, 0] * (things[thing, 0] - x[frame]) / 3.0
    v = np.full(len(u), camera.matrix[1, 2])
    detections = Detections(
        frame_stamps=10 + 0.4 * np.arange(len(x)),
        frame=frame,
        boxes=np.column_stack([u - 15, v - 15, u + 15, v + 15]),
        label=thing,
        scores=np.ones(len(u)),
        depths=np.full(len(u), np.nan),
        track_ids=np.full(len(u), -1),
        label_names=tuple(f"door {i}" for i in range(len(things))),
    )
    path = Trajectory(detections.frame_stamps, poses)
    truth = Truth(tuple(TruthObject(i, f"door {i}", place) for i, place in enumerate(things)))
    return Log("corridor", (CameraLog(camera, detections),), path, None, truth)


def test_far_from_where_the_map_begins_an_object_is_still_known():
    """How far the map may have turned by then says nothing of how well the object is placed in it."""
    log = corridor()
    result = run(log, "joint", "odometry.yaw_per_m=0.03")
    assert len(result.map.resolved()) == len(result.map) == len(log.truth.objects)
    by_label = {o.label: o for o in result.map.objects}
    for true in log.truth.objects:
        o = by_label[true.label]
        np.testing.assert_allclose(o.position, true.position, atol=0.01)
    # the covariance is that in the map, all the way back to its beginning
    sigma = [np.sqrt(np.linalg.eigvalsh(by_label[true.label].covariance)[-1]) for true in log.truth.objects]
    assert sigma[-1] > 0.5 * 3.0 > 5 * sigma[0]
    assert (np.diff(sigma) > 0).all()


@pytest.mark.parametrize("mode", ["fixed", "joint"])
def test_every_label_is_one_object_where_that_is_said(mode):
    """Two cups: one object of that label, whatever the rays say; by default they are two."""
    log = simulate(pair(1.0, pixel_sigma=1.0), 0)
    said = pipeline.run(log, load_settings(None, (f"mode={mode}", "association.method=by_label", *HELD)), Ledger())
    assert [o.label for o in said.map.objects] == ["cup"]
    found = pipeline.run(log, load_settings(None, (f"mode={mode}", *HELD)), Ledger())
    assert [o.label for o in found.map.objects] == ["cup", "cup"]


def test_the_path_after_is_as_smooth_as_the_odometry_where_the_localisation_jitters():
    log = simulate(preset("demo", frames=300), 0)
    result = run(log, "joint")
    after, true = result.path_after, log.truth.trajectory
    where, _ = interpolate(true.stamps, true.poses, after.stamps, np.inf)
    error = np.linalg.norm((after.poses - where)[:, :2, 3], axis=1)
    jitter = np.linalg.norm(np.diff(after.poses[:, :2, 3], n=2, axis=0), axis=1)
    raw = np.linalg.norm(np.diff(result.path.poses[:, :2, 3], n=2, axis=0), axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.median(jitter) < 0.5 * np.median(raw)
    # and it goes through the poses that were solved
    at, _ = interpolate(after.stamps, after.poses, result.keyframes.stamps, np.inf)
    np.testing.assert_allclose(at[:, :3, 3], result.map_T_base[:, :3, 3], atol=0.01)


def test_a_shared_error_far_beyond_its_prior_names_its_cause():
    clean = small_log(localization=None, frames=120)
    tilted = add_shared_errors(clean, {f"{clean.cameras[0].camera.name}.tilt": 0.09})
    result = run(tilted, "joint", "bodies.use=false")
    (warning,) = [text for text in result.summary["warnings"] if "shared error" in text]
    assert "tilt" in warning
    assert "base_T_camera" in warning
    assert not any("shared error" in text for text in run(clean, "joint", "bodies.use=false").summary["warnings"])


def test_boxes_of_a_mirrored_image_are_said_to_be_wrong_input():
    def mirrored(camera):
        found, width = camera.detections, camera.camera.width
        boxes = found.boxes[:, [2, 1, 0, 3]] * [-1, 1, -1, 1] + [width - 1, 0, width - 1, 0]
        return replace(camera, detections=replace(found, boxes=boxes))

    log = simulate(preset("demo", objects=15, classes=5, frames=250), 0)
    for said, one in ((False, log), (True, replace(log, cameras=tuple(map(mirrored, log.cameras))))):
        result = run(one, "fixed", *HELD, "checks.use=true")
        assert any("the input may be wrong" in text for text in result.summary["warnings"]) == said


def test_rays_of_a_thing_without_parallax_are_not_rejected():
    """A thing straight ahead of a robot that drives along a line: no solve can place it, and its rays miss nothing."""
    line = lift_se2(np.column_stack([np.linspace(0, 1, 40), np.zeros((40, 2))]))
    camera, stamps = make_camera("ahead"), np.arange(40) / 10
    middle = np.tile([320.0, 240.0], (40, 1)) + np.random.default_rng(0).normal(scale=1.0, size=(40, 2))
    boxes = np.hstack([middle - 10, middle + 10])
    none = np.full(40, np.nan)
    ones = np.full(40, 1)
    found = Detections(stamps, np.arange(40), boxes, 0 * ones, 0.9 * ones, none, -ones, ("sign",))
    result = run(Log("line", (CameraLog(camera, found),), odometry=Trajectory(stamps, line)), "joint")
    (sign,) = result.map.objects
    assert (sign.status, sign.rays) == ("unresolved", 40)
    assert (result.weight == 1).all()
    assert result.summary["counts"]["rays_rejected"] == 0


def test_only_a_ray_that_misses_its_object_has_no_weight():
    """The second object has no place, so all its rays are outside the solve."""
    association = Association(object=np.array([0, 0, 0, 1, 1, -1]), label=np.array([0, 0]))
    weight = np.array([1.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    assert counted_weights(association, weight).tolist() == [1.0, 0.4, 0.0, 1.0, 1.0, 0.0]

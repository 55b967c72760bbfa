"""A robot that looks to and fro while it drives, with known errors of its clock or its odometry."""

from dataclasses import replace

import numpy as np

from objslam.config import load_settings
from objslam.core.camera import Camera, project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.shared_errors import SharedErrors

BASE_T_CAMERA = make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.0, 0.5]))


def drive(seed: int = 1, turns: float = 0.8, clock: float = 0.0, false: float = 0.0, labels: int = 40) -> Log:
    """A robot that looks to and fro (by `turns`, rad) while it drives, past objects of which some are out of view.

    clock: s, what the stamps of the camera lack. false: the share of boxes with a wrong label. labels: the number of labels
    of the 40 objects.
    """
    rng = np.random.default_rng(seed)
    at = np.arange(0.0, 60.0, 0.05)
    heading = turns * (np.sin(0.9 * at) + 0.5 * np.sin(1.7 * at + 1))
    path = np.column_stack([0.2 * at, np.zeros_like(at), heading])
    stamps = np.arange(1.0, 59.0, 0.2)
    poses = lift_se2(np.column_stack([np.interp(stamps, at, column) for column in path.T]))
    places = np.column_stack([rng.uniform(0, 16, 40), rng.uniform(-4, 4, 40), rng.uniform(0, 1, 40)])
    camera = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), base_T_camera=BASE_T_CAMERA)
    map_T_camera = poses @ BASE_T_CAMERA
    local = np.einsum("kji,knj->kni", map_T_camera[:, :3, :3], places - map_T_camera[:, None, :3, 3])
    with np.errstate(all="ignore"):
        pixels = project(camera, local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
    frame, label = np.nonzero((local[..., 2] > 0.5) & ((pixels > 20) & (pixels < [619, 459])).all(axis=2))
    centre = pixels[frame, label] + rng.normal(size=(len(frame), 2))
    wrong = rng.random(len(frame)) < false
    detections = Detections(
        frame_stamps=stamps - clock,
        frame=frame,
        boxes=np.concatenate([centre - 8, centre + 8], axis=1),
        label=np.where(wrong, rng.integers(0, 40, len(frame)), label) % labels,
        scores=np.ones(len(frame)),
        depths=np.full(len(frame), np.nan),
        track_ids=np.full(len(frame), -1),
        label_names=tuple(f"thing_{i}" for i in range(labels)),
    )
    return Log("turning", (CameraLog(camera, detections),), odometry=Trajectory(at, lift_se2(path)))


def of_two_clocks(offset: float) -> Log:
    """A drive with a noisy localisation, and an odometry whose stamps lack `offset`, s."""
    log, rng = drive(), np.random.default_rng(0)
    path = log.odometry
    assert path is not None
    noisy = path.poses[::2] @ lift_se2(rng.normal(size=(len(path.poses[::2]), 3)) * [0.01, 0.01, 0.005])
    localization = Trajectory(path.stamps[::2], noisy)
    return replace(_without_late_images(log), odometry=replace(path, stamps=path.stamps - offset), localization=localization)


def _without_late_images(log: Log) -> Log:
    """The log with the first 60 images, so that it is mapped fast."""
    (first,) = log.cameras
    boxes = first.detections
    assert boxes is not None
    early = boxes.frame < 60
    columns = ("frame", "boxes", "label", "scores", "depths", "track_ids")
    kept = {name: getattr(boxes, name)[early] for name in columns}
    return replace(log, cameras=(replace(first, detections=replace(boxes, frame_stamps=boxes.frame_stamps[:60], **kept)),))


def errors_of(log: Log, *overrides: str) -> SharedErrors:
    settings, ledger = load_settings(None, ("mode=joint", *overrides)), Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    found = shared_errors(log, keyframes, build_rays(log, keyframes, settings, ledger), settings)
    assert found is not None
    return found

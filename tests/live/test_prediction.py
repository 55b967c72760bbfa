"""Where a session expects the camera after a way on which it saw nothing, against the truth."""

from dataclasses import replace

import numpy as np
import pytest
from driving import feed

from objslam.config import load_settings
from objslam.core.geometry import interpolate
from objslam.live.mapper.prediction import PosePredictor
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate

BLIND = 100, 300  # The frames without boxes.


@pytest.mark.parametrize("rate", [10.0, 2.0])  # At 2 Hz, the newest localised pose is up to half a second old.
def test_the_localisation_gives_the_pose_after_a_way_without_boxes(rate, monkeypatch):
    log = simulate(preset("demo", localization_rate=rate), 1)
    camera = log.cameras[0]
    seen = camera.detections
    shown = np.flatnonzero((seen.frame < BLIND[0]) | (seen.frame >= BLIND[1]))
    log = replace(log, cameras=(replace(camera, detections=seen.take(shown)),))
    predicted, predict = [], PosePredictor.predict

    def recorded(self, before, stamp, *more):
        found = predict(self, before, stamp, *more)
        predicted.append((stamp, found))
        return found

    monkeypatch.setattr(PosePredictor, "predict", recorded)
    begin = float(seen.frame_stamps[BLIND[1]]) - 1e-6
    session = Session(load_settings(None, ("mode=joint",)), patient=True).start()
    feed(session, log, until=lambda: bool(predicted) and predicted[-1][0] >= begin).abort()
    stamp, first = next((stamp, found) for stamp, found in predicted if stamp >= begin)
    truth, _ = interpolate(log.truth.trajectory.stamps, log.truth.trajectory.poses, np.array([stamp]), np.inf)
    there = truth[0] @ camera.camera.base_T_camera
    off = first.map_T_camera[:3, 3] - there[:3, 3]
    turned = np.arccos(np.clip((np.trace(first.map_T_camera[:3, :3].T @ there[:3, :3]) - 1) / 2, -1, 1))
    variance = first.uncertainty.pose.diagonal()
    assert first.uncertainty.is_placed
    assert np.linalg.norm(off) < 3 * np.sqrt(variance[3:].sum())
    assert turned < 3 * np.sqrt(variance[:3].sum())

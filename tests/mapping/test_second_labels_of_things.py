"""A detector that gives things two labels in one image makes no second objects."""

import numpy as np
from more_boxes import with_second_labels

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.boxes.second_labels import SECOND_LABELS
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate


def test_each_thing_is_there_once_and_has_both_labels():
    """Half of all boxes have a second label. Each thing was there twice."""
    drive = simulate(preset("demo", frames=120, false=0.0, odometry=Odometry()), 4)
    count = len(drive.cameras[0].detections)
    some = np.sort(np.random.default_rng(0).choice(count, count // 2, replace=False))
    settings = load_settings(None, ("mode=fixed", "output.recording=false", "bodies.use=false", "checks.use=false"))
    result = pipeline.run(with_second_labels(drive, some), settings, Ledger())
    found = evaluate(result.map, drive.truth).objects
    assert len(found.matches) == len(drive.truth.objects)
    assert not found.false
    assert result.summary["dropped"][SECOND_LABELS] == len(some)
    for one in result.map.resolved():
        first, second = one.labels.items()
        assert (first[0], second[0]) == (one.label, f"like {one.label}")
        assert 0.55 < first[1] < 0.8
        assert abs(first[1] + second[1] - 1) < 1e-3

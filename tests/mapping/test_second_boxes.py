"""Second boxes of things, as a detector without suppression gives them, make no objects."""

import numpy as np
import pytest
from more_boxes import aside, with_second_boxes

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate


@pytest.mark.parametrize("seed", [4, 5])
def test_second_boxes_that_lie_beside_things_make_no_objects(seed):
    """Half of all boxes have a second one, whose overlap is less than detectors suppress. Each thing was there twice."""
    drive = simulate(preset("demo", frames=200, false=0.0, odometry=Odometry()), seed)
    count = len(drive.cameras[0].detections)
    some = np.sort(np.random.default_rng(seed).choice(count, count // 2, replace=False))
    settings = load_settings(None, ("mode=fixed", "output.recording=false", "bodies.use=false", "checks.use=false"))
    found = evaluate(pipeline.run(with_second_boxes(drive, some, aside), settings, Ledger()).map, drive.truth).objects
    assert len(found.matches) == len(drive.truth.objects)
    assert not found.false
    assert found.errors.max() < 0.08


def test_neighbours_whose_boxes_overlap_stay_two():
    """Pairs of equal things, 20 cm wide, with 4 cm between the two. From most sides, their boxes lie on each other."""
    at = [(x, y) for x in (-2.0, 0.0, 2.0) for y in (-1.0, 1.0)]
    placed = tuple(("box", (x + side, y, 0.5)) for x, y in at for side in (-0.12, 0.12))
    drive = simulate(preset("demo", frames=200, false=0.0, objects=0, placed=placed), 1)
    settings = load_settings(None, ("mode=fixed", "output.recording=false", "bodies.use=false", "checks.use=false"))
    found = evaluate(pipeline.run(drive, settings, Ledger()).map, drive.truth).objects
    assert len(found.matches) == len(placed)
    assert not found.false

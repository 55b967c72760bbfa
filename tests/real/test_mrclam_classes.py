"""Labels of a few landmarks each, as the classes of a detector have, with ranges and from the odometry of wheels."""

import numpy as np
import pytest
from log_parts import part, with_classes

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.sources import SourceOptions, read


@pytest.mark.long
def test_landmarks_of_eight_labels(data_dir):
    """With another draw of the labels, the filter for ranges was sure of a map with up to three copies of each landmark.

    `tools/bench_recordings.py --parts classes` maps whole drives.
    """
    whole = read(data_dir / "mrclam_ds7", Ledger(), SourceOptions(robot=3, with_range=True))
    log = with_classes(part(whole, 300.0, 700.0), 8)
    more = ("checks.use=false", "bodies.use=false", "output.recording=false")
    result = pipeline.run(log, load_settings(None, ("mode=joint", *more)), Ledger())
    found = evaluate(result.map, log.truth, align="se2", radius=0.5)
    assert (len(found.objects.matches), len(found.objects.false)) == (15, 0)
    assert found.objects.errors.max() < 0.08
    inside = [one.squared_3d < 7.815 for one in found.objects.matches if one.squared_3d is not None]
    assert np.mean(inside) >= 0.9

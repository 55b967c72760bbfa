"""A drive among things of four labels. A camera sees through those of one label, so their depths end behind them."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate

THROUGH = "cup"


def mapped(seen_through):
    log = simulate(preset("demo", false=0.0, depth={"sigma": 0.03, "sigma_per_m": 0.02}), 1)
    if seen_through:
        (camera,) = log.cameras
        found = camera.detections
        behind = np.random.default_rng(0).normal(0.8, 0.3, len(found.depths)).clip(min=0.0)
        behind *= found.label == list(found.label_names).index(THROUGH)
        log = replace(log, cameras=(replace(camera, detections=replace(found, depths=found.depths + behind)),))
    changes = ("output.recording=false", "mode=joint", "poses.use=odometry", "checks.use=false")
    return pipeline.run(log, load_settings(None, changes), Ledger())


@pytest.fixture(scope="module")
def maps():
    return mapped(seen_through=False), mapped(seen_through=True)


def test_depths_behind_the_things_of_one_label_do_not_widen_the_others(maps):
    """With one noise for all labels, the others had sigmas up to 1.6 times as large."""
    right, wrong = ({(o.label, o.id): o for o in one.map.objects if o.label != THROUGH} for one in maps)
    assert right.keys() == wrong.keys()
    assert len(right) == 9
    for name, one in right.items():
        grown = np.linalg.eigvalsh(wrong[name].covariance)[-1] / np.linalg.eigvalsh(one.covariance)[-1]
        assert grown**0.5 < 1.15
        assert np.linalg.norm(wrong[name].position - one.position) < 0.02


def test_the_summary_says_whose_depths_are_wrong(maps):
    for one, expected in zip(maps, ([], [THROUGH]), strict=True):
        noise = one.summary["range_noise_by_label"]
        assert set(noise) == {"book", "bottle", "cup", "plant"}
        assert [label for label, of in noise.items() if of["ranges"] > 2 and of["range_bias"] > 5] == expected
        assert one.summary["noise"]["range_bias"] < 1.0

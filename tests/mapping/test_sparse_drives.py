"""Objects that few boxes show, in a whole run at localised poses."""

import numpy as np

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.simulation import PoseNoise, preset, simulate

SPARSE = {"objects": 12, "classes": 3, "frames": 16, "frame_rate": 0.5, "pixel_sigma": 1.0, "missed": 0.4, "false": 0.05}
"""One image in two seconds, in which 40 % of the boxes are missed: most objects have two or three boxes."""


def run(log, *settings):
    return pipeline.run(log, load_settings(None, ("output.recording=false", "bodies.use=false", *settings)), Ledger())


def test_a_sparse_drive_has_more_objects_and_hardly_more_false_ones():
    found, without = np.zeros(2), np.zeros(2)
    for seed in (0, 1, 2, 3):
        log = simulate(preset("demo", **SPARSE, localization=PoseNoise(xy=0.03, yaw=0.01)), seed)
        for count, setting in ((found, "true"), (without, "false")):
            result = run(log, "mode=fixed", f"association.few_rays={setting}")
            score = evaluate(result.map, log.truth, align="none", radius=1.0).to_dict()
            count += score["matched"], score["false"]
    assert found[0] >= without[0] + 4
    assert found[1] <= without[1] + 0.2 * (found[0] - without[0])


def test_joint_mode_finds_them_too():
    log = simulate(preset("demo", **SPARSE, localization=PoseNoise(xy=0.03, yaw=0.01)), 0)
    found, without = (run(log, "mode=joint", f"association.few_rays={setting}") for setting in ("true", "false"))
    assert found.association.few_rays.any()
    assert without.association.few_rays is None
    more, fewer = (evaluate(one.map, log.truth, align="none", radius=1.0).to_dict() for one in (found, without))
    assert more["matched"] > fewer["matched"]
    assert more["false"] <= fewer["false"] + 1

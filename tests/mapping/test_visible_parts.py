"""Posts whose upper part is hidden in some images: each is one object, not two above each other."""

from dataclasses import replace

import numpy as np
import pytest
from mapping.hiding_drives import Solid, hiding_drive

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.mapping.bodies import visible_parts
from objslam.mapping.stages import described

VISIBLE = 0.4  # The share of a post's height that is visible in the second lap.
SETTINGS = load_settings(None, ("mode=fixed", "output.recording=false"))


def scene() -> list[Solid]:
    """Four posts of 1.6 m and four stools around the robot."""
    kinds = {"post": np.array([0.08, 0.08, 0.8]), "stool": np.array([0.2, 0.2, 0.25])}
    solids = []
    for number, turn in enumerate(np.linspace(0, 2 * np.pi, 8, endpoint=False)):
        label = ("post", "stool")[number % 2]
        half = kinds[label]
        place = np.array([4.0 * np.cos(turn), 3.4 * np.sin(turn), half[2]])
        solids.append(Solid("cylinder", label, place, half, 0.0))
    return solids


def tops_hidden_later(log: Log) -> Log:
    """The log with boxes of the lower parts of posts in the second lap."""
    (one,) = log.cameras
    found, boxes = one.detections, one.detections.boxes.copy()
    cut = (found.label == found.label_names.index("post")) & (found.stamps > np.median(found.frame_stamps))
    boxes[cut, 1] = boxes[cut, 3] - VISIBLE * (boxes[cut, 3] - boxes[cut, 1])
    return replace(log, cameras=(replace(one, detections=replace(found, boxes=boxes)),))


@pytest.mark.parametrize("dropped", [True, False])
def test_a_post_whose_top_is_hidden_in_one_lap_is_one_object(dropped, monkeypatch):
    if not dropped:
        monkeypatch.setattr(described, "without_visible_parts", lambda solution: solution)
    log = tops_hidden_later(hiding_drive(0, solids=scene()))
    result = pipeline.run(log, SETTINGS, Ledger())
    names = [item.label for item in result.map.resolved()]
    assert (names.count("post") == 4) == dropped
    assert names.count("stool") == 4
    if dropped:
        assert max(match.error for match in evaluate(result.map, log.truth, radius=0.5).objects.matches) < 0.1
        assert result.association.count == len(result.map.objects)


def test_posts_of_two_heights_that_frames_show_together_stay():
    """A short post stands 0.5 m from each tall one. Their bodies do not fill one space, and frames show both."""
    solids = scene()
    short = [
        Solid("cuboid", "post", np.array([*one.centre[:2] * 0.85 + [0.1, 0.15], 0.3]), np.array([0.08, 0.08, 0.3]), 0.1)
        for one in solids
        if one.label == "post"
    ]
    result = pipeline.run(hiding_drive(0, solids=[*solids, *short]), SETTINGS, Ledger())
    assert [item.label for item in result.map.resolved()].count("post") == 8


def test_a_wide_sigma_takes_in_no_neighbour(monkeypatch):
    """Posts of one height in a ring, as if no frame showed two of them, at places that are known to 9 m only."""
    seen = []
    monkeypatch.setattr(described, "without_visible_parts", lambda solution: seen.append(solution) or solution)
    solids = scene()
    pipeline.run(hiding_drive(0, solids=solids), SETTINGS, Ledger())
    (solution,) = seen
    monkeypatch.setattr(visible_parts, "_are_two", lambda *_: False)
    estimate = solution.estimate
    wide = replace(estimate, covariance=np.tile(81.0 * np.eye(3), (len(estimate.positions), 1, 1)))
    assert visible_parts.without_visible_parts(replace(solution, estimate=wide)).association.count == len(solids)

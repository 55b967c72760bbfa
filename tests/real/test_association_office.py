"""A real room without identities: what stands on the desks of TUM fr3_long_office, from a detector's boxes."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.alignment import match_points
from objslam.mapping.pipeline import run
from objslam.sources import read


@pytest.fixture(scope="module")
def log(data_dir):
    return read(data_dir / "tum_fr3_office", Ledger())


def half(log, second):
    """The log with the boxes of the first or the second half of its frames."""
    camera = log.cameras[0]
    d = camera.detections
    middle = len(d.frame_stamps) // 2
    kept = (d.frame >= middle) == second
    part = replace(
        d,
        frame_stamps=d.frame_stamps[middle:] if second else d.frame_stamps[:middle],
        frame=d.frame[kept] - (middle if second else 0),
        **{name: getattr(d, name)[kept] for name in ("boxes", "label", "scores", "depths", "track_ids")},
    )
    return replace(log, cameras=(replace(camera, detections=part),))


def objects(log, ledger=None):
    resolved = run(log, Settings(), ledger or Ledger()).map.resolved()
    return [o.label for o in resolved], np.array([o.position for o in resolved])


@pytest.fixture(scope="module")
def ledger():
    return Ledger()


@pytest.fixture(scope="module")
def whole(log, ledger):
    return objects(log, ledger)


def test_the_rays_meet_their_objects_as_the_settings_promise(whole, ledger):
    assert len(whole[0]) > 20
    assert not any("miss their objects" in warning for warning in ledger.warnings)


def test_the_clock_and_the_association_settle(whole, ledger):
    """The clock is known to a millisecond, and the association swung between two states that differ by half of that."""
    assert not any("still change" in warning for warning in ledger.warnings)


def test_the_room_has_what_it_has(whole):
    count = Counter(whole[0])
    assert (count["tv"], count["keyboard"], count["mouse"], count["teddy bear"], count["cat"]) == (2, 2, 2, 1, 0)
    assert count["cup"] >= 3
    assert count["chair"] >= 2
    assert count["book"] >= 3


def test_no_object_is_there_twice(whole):
    labels, positions = whole
    same = np.array(labels)[:, None] == np.array(labels)
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)
    assert (apart[same & ~np.eye(len(labels), dtype=bool)] >= 0.05).all()


def test_half_of_the_log_gives_the_same_objects_as_the_other(log):
    (first, here), (second, there) = (objects(half(log, late)) for late in (False, True))
    matched, _ = match_points(here, there, np.array(first)[:, None] == np.array(second), 0.1)
    assert len(matched) >= 15

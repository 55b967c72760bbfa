"""A real room without identities: what stands on the desks of TUM fr3_long_office, from a detector's boxes."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from objslam.config import Output, Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, lift_se2
from objslam.evaluation.alignment import match_points
from objslam.mapping.checks.agreement import take_frames
from objslam.mapping.localization import PriorMap, moved_log
from objslam.mapping.pipeline import run
from objslam.sources import read

pytestmark = pytest.mark.long
SETTINGS = Settings(output=Output(recording=False))
"""The defaults, without the steps of the solver that a recording would show."""
UNCHECKED = load_settings(None, ("output.recording=false", "checks.use=false", "bodies.use=false"))
"""For the halves. The checks look at the whole log, which has the same input, and so do the bodies."""


@pytest.fixture(scope="module")
def log(data_dir):
    """Every second image of the recording, 15 a second: they show all that is on the desks in a third of the time."""
    log = read(data_dir / "tum_fr3_office", Ledger())
    return with_frames(log, np.arange(len(log.cameras[0].detections.frame_stamps)) % 2 == 0)


def with_frames(log, kept):
    """The log with the boxes of some of its frames. kept: (F,)."""
    camera = log.cameras[0]
    return replace(log, cameras=(replace(camera, detections=take_frames(camera, kept)),))


def half(log, second):
    """The log with the boxes of the first or the second half of its frames."""
    count = len(log.cameras[0].detections.frame_stamps)
    return with_frames(log, (np.arange(count) >= count // 2) == second)


def objects(log, ledger=None):
    resolved = run(log, SETTINGS, ledger or Ledger()).map.resolved()
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


@pytest.fixture(scope="module")
def halves(log):
    """The first half as a map, and the second half in a frame that nobody knows, found in this map."""
    unknown = lift_se2(np.array([3.0, -7.0, 2.0]))
    first = run(half(log, False), UNCHECKED, Ledger())
    known = PriorMap("first", first.map)
    return first, run(moved_log(half(log, True), unknown), UNCHECKED, Ledger(), known=known)


def test_the_second_half_is_found_in_the_map_of_the_first(log, halves, whole):
    first, second = halves
    told = second.summary["localisation"]
    assert told["localised"]
    true, there = interpolate(log.localization.stamps, log.localization.poses, second.keyframes.stamps, 1.0)
    assert there.all()
    assert np.sqrt((np.linalg.norm((second.map_T_base - true)[:, :3, 3], axis=1) ** 2).mean()) <= 0.05
    labels, positions = np.array(whole[0]), whole[1]

    def of_one_run(o):
        """The object of a run over both halves that is nearest."""
        same = np.flatnonzero(labels == o.label)
        return same[np.linalg.norm(positions[same] - o.position, axis=1).argmin()]

    by_id = {o.id: o for o in second.map}
    as_one = [of_one_run(first.map.by_id(m["id"])) == of_one_run(by_id[m["id"]]) for m in told["matches"]]
    assert len(as_one) >= 15
    assert np.mean(as_one) >= 0.95


def test_half_of_the_log_gives_the_same_objects_as_the_other(halves):
    (first, here), (second, there) = (
        ([o.label for o in r.map.resolved()], np.array([o.position for o in r.map.resolved()])) for r in halves
    )
    matched, _ = match_points(here, there, np.array(first)[:, None] == np.array(second), 0.1)
    assert len(matched) >= 15

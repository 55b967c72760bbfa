"""Places recognised by their landmarks: what was moved is found, what is only alike is not."""

import numpy as np
import pytest

from objslam.association.place_recognition import (
    Constellation,
    Recognition,
    label_densities,
    neighbourhood,
    recognise_place,
    repetition,
)
from objslam.config import AssociationSettings
from objslam.core.geometry import lift_se2

SIGMA = 0.05
PIVOT = np.array([2.0, 1.0])
PRIOR = np.diag([1.0, 1.0, 0.4]) ** 2


def constellation(rng, count, labels=2, size=8.0):
    points = np.column_stack([rng.uniform(-size / 2, size / 2, (count, 2)), rng.uniform(0, 1, count)])
    return points, rng.integers(0, labels, count)


def of(points, labels):
    return Constellation(points, np.tile(SIGMA**2 * np.eye(3), (len(points), 1, 1)), labels)


def everything(one, other):
    return one.label[:, None] == other.label


def density(one, other, size=10.0):
    return np.array([max((other.label == label).sum(), 1) / size**2 for label in one.label])


def moved(points, x):
    """The points as they seem when the poses are off by the inverse of the correction x about the pivot."""
    correction = lift_se2(x)
    correction[:2, 3] += PIVOT - correction[:2, :2] @ PIVOT
    back = np.linalg.inv(correction)
    return points @ back[:3, :3].T + back[:3, 3], correction


@pytest.mark.parametrize("seed", range(8))
def test_a_moved_constellation_is_found_among_others(seed):
    rng = np.random.default_rng(seed)
    points, labels = constellation(rng, 12)
    x = rng.normal(size=3) * np.sqrt(np.diag(PRIOR)) * 0.8
    mine = rng.permutation(12)[:5]
    seen, correction = moved(points[mine], x)
    new = rng.uniform(5, 9, (2, 3)) * [1, 1, 0.1]  # that nobody has seen before
    here = of(np.concatenate([seen, new]) + rng.normal(0, SIGMA / 2, (7, 3)), np.append(labels[mine], [0, 1]))
    there = of(points + rng.normal(0, SIGMA / 2, points.shape), labels)
    found = recognise_place(here, there, PIVOT, PRIOR, density(here, there), everything(here, there))
    assert found is not None
    assert found.evidence > 7
    assert found.lead > 3
    right = {(i, int(j)) for i, j in enumerate(mine)}
    assert set(map(tuple, found.pairs.tolist())) == right
    off = np.linalg.inv(found.correction) @ correction
    at_pivot = off[:2, :2] @ PIVOT + off[:2, 3] - PIVOT
    assert np.hypot(*at_pivot) < 0.15
    assert abs(np.arctan2(off[1, 0], off[0, 0])) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_a_moved_constellation_is_found_behind_many_new_landmarks(seed):
    """The landmarks of this place are the last of all, so their pairs come after hundreds of others."""
    rng = np.random.default_rng(seed)
    points, labels = constellation(rng, 30, labels=1, size=20.0)
    mine = np.flatnonzero(np.hypot(*(points[:, :2] - PIVOT).T) < 7)
    seen, correction = moved(points[mine], np.array([0.8, -0.7, 0.9]))
    new = constellation(rng, 12, size=20.0)[0] + [40.0, 0.0, 0.0]
    here = of(np.concatenate([new, seen]), np.zeros(len(new) + len(mine), dtype=np.int64))
    there = of(points, labels)
    wide = np.diag([15.0, 15.0, 0.5]) ** 2
    found = recognise_place(here, there, PIVOT, wide, density(here, there, 24.0), everything(here, there))
    assert found is not None
    assert {(i + len(new), int(j)) for i, j in enumerate(mine)} <= set(map(tuple, found.pairs.tolist()))
    np.testing.assert_allclose(found.correction, correction, atol=0.1)


def test_other_places_are_not_taken_for_this_one():
    taken = 0
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        here, there = (of(*constellation(rng, 6, labels=1)) for _ in range(2))
        found = recognise_place(here, there, PIVOT, PRIOR, density(here, there), everything(here, there))
        taken += found is not None and found.evidence > 7 and found.lead > 3
    assert taken == 0


def test_one_landmark_of_many_is_no_evidence_when_the_drift_is_large():
    rng = np.random.default_rng(3)
    points, labels = constellation(rng, 10, labels=1)
    here, there = of(moved(points[:1], np.array([0.5, -0.4, 0.2]))[0], labels[:1]), of(points, labels)
    found = recognise_place(here, there, PIVOT, PRIOR, density(here, there), everything(here, there))
    assert found is None or found.evidence < 7


def test_what_repeats_itself_has_no_lead():
    """A row of things 1 m apart, seen again: it fits as well one place further."""
    row = np.column_stack([np.arange(8.0), np.zeros(8), np.zeros(8)])
    label = np.zeros(8, dtype=np.int64)
    here, there = of(row[2:5] + np.array([0.5, 0.0, 0.0]), label[:3]), of(row, label)
    found = recognise_place(here, there, PIVOT, PRIOR, density(here, there), everything(here, there))
    assert found is not None
    assert found.lead < 3


def test_a_few_rare_landmarks_are_found_among_hundreds_that_look_alike():
    """160,000 pairs look alike: all hypotheses of two of them would not fit into memory."""
    rng = np.random.default_rng(0)
    points, labels = constellation(rng, 405)
    labels[:400], labels[400:] = 0, 1
    seen, correction = moved(points, np.array([0.4, -0.3, 0.2]))
    here, there = of(seen, labels), of(points, labels)
    found = recognise_place(here, there, PIVOT, PRIOR, density(here, there), everything(here, there))
    assert found is not None
    assert found.evidence > 7
    off = np.linalg.inv(found.correction) @ correction
    assert abs(np.arctan2(off[1, 0], off[0, 0])) < 0.05
    assert {(i, i) for i in range(400, 405)} <= set(map(tuple, found.pairs.tolist()))


def test_landmarks_seen_together_are_never_one():
    rng = np.random.default_rng(5)
    points, labels = constellation(rng, 6, labels=1)
    here = there = of(points, labels)
    assert recognise_place(here, there, PIVOT, PRIOR, density(here, there), np.zeros((6, 6), dtype=bool)) is None
    never = everything(here, there) & ~np.eye(6, dtype=bool)
    found = recognise_place(here, there, PIVOT, PRIOR, density(here, there), never)
    assert found is None or all(i != j for i, j in found.pairs.tolist())


def test_how_sure_a_place_must_be_is_a_setting():
    found = Recognition(np.eye(4), np.zeros((2, 2), dtype=np.int64), evidence=8.0, lead=4.0)
    asked = [{}, {"loop_evidence": 8.5}, {"loop_lead": 4.5}]
    assert [found.is_sure(AssociationSettings.model_validate(more)) for more in asked] == [True, False, False]


def corridor(doors, y=0.0):
    """Doors on both sides, 4 m from each other, and a plate beside each of them."""
    places = [
        (4.0 * i + step, y + side, z) for i in range(doors) for side in (-1, 1) for step, z in ((0.0, 1.0), (0.7, 1.5))
    ]
    return np.array(places), np.tile([0, 1], 2 * doors)


def recognised(position, label, here, there, together):
    """The recognition of landmarks `here` among those `there`, and the same against the repetition of the place."""
    count, pivot, prior = len(label), position[here, :2].mean(axis=0), np.diag([2.5, 2.5, 0.2]) ** 2
    covariance, density = np.tile(SIGMA**2 * np.eye(3), (count, 1, 1)), label_densities(position, label)
    one, two = (neighbourhood(position[mask], covariance[mask], label[mask], pivot) for mask in (here, there))
    possible = (one.label[:, None] == two.label) & ~together[np.ix_(here, there)]
    found = recognise_place(one, two, pivot, prior, density[here], possible)
    again = repetition(position, covariance, label, here, together, pivot, prior, density)
    return found, found.against(again), again


def frames_of_two_doors(count):
    """Which of the landmarks of a corridor some frame shows together: those of doors that follow each other."""
    door = np.arange(count) // 4
    return np.abs(door[:, None] - door) <= 1


def test_the_next_doors_of_a_corridor_are_not_those_before():
    """The last two pairs of doors fit those two places back, which no frame shows beside them. Wheels may slip by 8 m."""
    rng = np.random.default_rng(0)
    position, label = corridor(6)
    position += rng.normal(0, 0.02, position.shape)
    door = np.arange(len(label)) // 4
    found, against, again = recognised(position, label, door >= 4, door < 4, frames_of_two_doors(len(label)))
    assert found.is_sure(AssociationSettings())
    assert abs(found.correction[0, 3]) > 7
    assert again.evidence > 7
    assert not against.is_sure(AssociationSettings())


def test_a_corridor_is_recognised_on_the_way_back():
    """Its doors repeat too, but all of them fit at the right place, and only some of them one door aside."""
    rng = np.random.default_rng(0)
    (before, label), (after, _) = corridor(6), corridor(6, y=0.6)
    after[:, 0] += 0.5
    position = np.concatenate([before, after])
    position += rng.normal(0, 0.02, position.shape)
    later = np.arange(len(position)) >= len(before)
    together = np.kron(np.eye(2, dtype=bool), frames_of_two_doors(len(label)))
    found, against, again = recognised(position, np.tile(label, 2), later, ~later, together)
    assert again.evidence > 7
    assert against.is_sure(AssociationSettings())
    np.testing.assert_allclose(against.correction[:2, 3], [-0.5, -0.6], atol=0.1)
    assert against.lead < found.evidence

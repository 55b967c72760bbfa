"""Which objects may be one: near each other, of one label, and never shown as two."""

import numpy as np

from objslam.association.duplicates import near_pairs, seen_as_two


def test_only_near_objects_of_one_label_may_be_one():
    position = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.1]])
    a, b, apart = near_pairs(position, np.array([7, 3, 7, 7]), 1.0)
    assert (a.tolist(), b.tolist()) == ([0], [2])
    np.testing.assert_array_equal(apart, [[0.0, -0.9, 0.0]])
    assert len(near_pairs(position[:0], np.zeros(0, dtype=np.int64), 1.0)[0]) == 0


def test_a_few_wrong_boxes_do_not_make_two_objects():
    assert not seen_as_two(3, 100)
    assert seen_as_two(4, 100)
    assert seen_as_two(1, 10)


def test_how_far_apart_duplicates_may_be_is_asked_for():
    position, label = np.array([[0.0, 0.0, 0.0], [0.0, 0.9, 0.0]]), np.zeros(2, dtype=np.int64)
    assert [len(near_pairs(position, label, farthest)[0]) for farthest in (0.8, 1.0)] == [0, 1]

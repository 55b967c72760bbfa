"""Boxes without an object are counted by label, and the warning names what may be wrong."""

from types import SimpleNamespace

import numpy as np
import pytest

from objslam.core.diagnostics import Ledger
from objslam.core.types import Association
from objslam.mapping.checks.unexplained import warn_of_unexplained

NAMES = ("desk", "chair", "person")


def warned(explained: tuple[int, ...], without: tuple[int, ...]) -> list[str]:
    """What is said of a map. explained, without: the boxes of each label with and without an object."""
    label = np.repeat(np.tile(np.arange(3), 2), (*explained, *without))
    owner = np.where(np.arange(len(label)) < sum(explained), 0, -1)
    ledger = Ledger()
    warn_of_unexplained(SimpleNamespace(label=label, label_names=NAMES), Association(owner, np.zeros(1, dtype=int)), ledger)
    return ledger.warnings


def test_a_map_with_a_usual_share_of_other_boxes_is_not_named():
    assert warned((60, 30, 0), (5, 3, 2)) == []


def test_a_few_boxes_without_an_object_are_counted():
    (said,) = warned((60, 30, 0), (12, 6, 2))
    assert said == "no object at rest explains 20 of 110 boxes (desk: 12, chair: 6, person: 2)"


@pytest.mark.parametrize("without", [(45, 20, 0), (20, 45, 5)], ids=["all labels", "the largest labels"])
def test_the_input_may_be_wrong_if_no_label_fits(without):
    (said,) = warned((30, 20, 0), without)
    assert "the input may be wrong: check the stamps" in said


def test_the_input_is_probably_right_if_the_other_labels_fit():
    """Desks that hide each other, and people who walk, say nothing against the input."""
    (said,) = warned((104, 900, 0), (695, 100, 33))
    assert "so the input is probably right: things labelled 'desk', 'person' move, hide each other, or stand" in said
    assert "wrong" not in said

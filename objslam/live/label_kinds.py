"""Stores for each label of a session whether it is a name, a class, or the label of things that move. A single label that is
no name says little about the other labels, but several such labels say much."""

from dataclasses import dataclass, field

import numpy as np

from objslam.core.arrays import Bools, Ints

_CLASSES = 0.1
"""The share of labels with several objects above which all labels count as classes. A single such label never has this
effect. With a larger share, two things of one label that no frame shows together count as one thing for longer. With a
smaller share, labels stop counting as names sooner. A session then tells equal things apart by their places alone."""


@dataclass
class LabelKinds:
    """What each label is so far: the name of one object, a class of several objects, or the label of things that move.

    are_names: whether a label counts as a name while nothing else is known about it. several: the numbers of the classes.
    moving: the numbers of the labels of things that move. seen: the numbers of all labels with a ray. judged: the numbers of
    the classes that a solve has told from the names. confirmed: an entry for each label that a solve took for a name. The
    entry is the number of the first ray that no solve has judged. shown: the numbers of the classes of which one frame
    showed two things. No solve makes a name of such a class.
    """

    are_names: bool
    several: set[int] = field(default_factory=set)
    moving: set[int] = field(default_factory=set)
    seen: set[int] = field(default_factory=set)
    judged: set[int] = field(default_factory=set)
    confirmed: dict[int, int] = field(default_factory=dict)
    shown: set[int] = field(default_factory=set)

    @property
    def all_names(self) -> bool:
        """Whether every label is the name of one object so far."""
        return self.are_names and not self.several and not self.moving

    def name(self, label: Ints) -> Bools:
        """Return which labels (n,) are names."""
        if not self.are_names:
            return np.zeros(len(label), dtype=bool)
        none = self.several | self.moving
        return np.isin(label, list(none), invert=True) if none else np.ones(len(label), dtype=bool)

    def is_confirmed(self, label: Ints) -> Bools:
        """Return which labels (n,) are names that a solve has confirmed."""
        return self.name(label) & np.isin(label, list(self.confirmed))

    def moves(self, label: Ints) -> Bools:
        """Return which labels (n,) are labels of things that move."""
        return np.isin(label, list(self.moving)) if self.moving else np.zeros(len(label), dtype=bool)

    def classes(self, label: Ints) -> Bools:
        """Return which labels (n,) may have several objects at rest."""
        return ~self.name(label) & ~self.moves(label)

    def add_class(self, label: int, judged: bool = False) -> None:
        """Note that a label has several objects. judged: whether the same solve showed that other labels are names."""
        self.several.add(label)
        if judged:
            self.judged.add(label)
        self.are_names &= len(self.several - self.judged) <= max(1.0, _CLASSES * len(self.seen))

    def add_name(self, label: int, ray: int) -> None:
        """Note that a solve took a label for a name. ray: the number of the first ray that no solve has judged. The label
        still counts as a class unless `are_names`."""
        self.confirmed[label] = ray
        self.several.discard(label)
        self.moving.discard(label)

    def add_moving(self, label: int) -> None:
        """Note that the things of a label move."""
        self.several.discard(label)
        self.moving.add(label)

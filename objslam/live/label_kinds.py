"""What each label of a session is so far. One label that is no name says little about the others, but a few say much."""

from dataclasses import dataclass, field

import numpy as np

from objslam.core.arrays import Bools, Ints

_CLASSES = 0.1
"""If more than one label, and more than this share of the labels, turn out to have several objects, all labels are classes.
With a larger share, two things of a label that no frame shows together pass for one for longer. With a smaller one, names
are given up sooner, and a session tells equal things apart by their places alone."""


@dataclass
class LabelKinds:
    """What each label is so far: a name of one object, a class of several objects, or of things that move.

    A label that nothing is known about is a name if `are_names`. several: the numbers of the classes. moving: of the labels
    of things that move. seen: of all labels with a ray. judged: of the classes that a solve has told from the names.
    confirmed: the first ray that no solve has judged, for each label that a solve took for a name. shown: the classes of
    which a frame showed two things. No solve makes a name of them.
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
        """Whether every label is one object so far."""
        return self.are_names and not self.several and not self.moving

    def name(self, label: Ints) -> Bools:
        """Return which of these labels (n,) are names."""
        if not self.are_names:
            return np.zeros(len(label), dtype=bool)
        none = self.several | self.moving
        return np.isin(label, list(none), invert=True) if none else np.ones(len(label), dtype=bool)

    def is_confirmed(self, label: Ints) -> Bools:
        """Return which of these labels (n,) are names that a solve has confirmed."""
        return self.name(label) & np.isin(label, list(self.confirmed))

    def moves(self, label: Ints) -> Bools:
        """Return which of these labels (n,) are of things that move."""
        return np.isin(label, list(self.moving)) if self.moving else np.zeros(len(label), dtype=bool)

    def classes(self, label: Ints) -> Bools:
        """Return which of these labels (n,) may have several objects at rest."""
        return ~self.name(label) & ~self.moves(label)

    def add_class(self, label: int, judged: bool = False) -> None:
        """Note that a label has several objects. judged: whether the same solve showed that other labels are names."""
        self.several.add(label)
        if judged:
            self.judged.add(label)
        self.are_names &= len(self.several - self.judged) <= max(1.0, _CLASSES * len(self.seen))

    def add_name(self, label: int, ray: int) -> None:
        """Note that a solve took a label for a name. ray: the number of the next ray. A log of classes has no names."""
        self.confirmed[label] = ray
        self.several.discard(label)
        self.moving.discard(label)

    def add_moving(self, label: int) -> None:
        """Note that the things of a label move."""
        self.several.discard(label)
        self.moving.add(label)

"""The likelihood ratio of a cosine between appearance vectors: one object against two objects of one label.

The cosines of one object and the cosines of two objects each have a Gaussian density with a random effect. Both densities
are learnt from the boxes of a log. The mean of the cosines between m boxes and n boxes has the variance between + within
(1/m + 1/n). `between` is the variance between objects (or pairs of objects), and `within` is the variance between single
boxes. With few boxes, the two densities are alike, so the ratio is near 1.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.core.arrays import Floats, Ints

_PRIOR = 20.0
"""The weight of the prior, as a number of pairs. In the prior, boxes of one object are as alike as boxes of two objects, and
all labels are equal. A larger number needs a longer log to learn from."""
_LEAST_APART = 0.3
"""The least excess of the mean cosine within objects over the mean cosine between objects with which appearance vectors are
used. Its unit is the standard deviation of the cosine between a box and an object with many boxes. A larger value leaves
more weak vectors unused. With random vectors, the difference is 0.1 in a log of a few hundred boxes."""
_LEAST_SHARE = 1e-3
"""The least share of `between` in the variance, and the least standard deviation of the cosines. Both only keep the ratio
finite."""
MOST_RATIO = 3.0
"""The largest absolute log ratio of a ray and a landmark. A larger value trusts vectors more. An object can look different
from behind, and some boxes show two objects."""


@dataclass(frozen=True)
class Density:
    """The Gaussian density of the cosines of each label. mean: (L,) the mean cosine. between, within: (L,) the two parts of
    the variance of the cosines, as in the formula of this module."""

    mean: Floats
    between: Floats
    within: Floats

    def spread(self, label: Ints, one: Ints | float, other: Ints | float) -> Floats:
        """Return the variance (E,) of the mean cosine between groups of `one` and of `other` boxes. label: (E,) the label of
        both groups."""
        return np.asarray(self.between[label] + self.within[label] * (1 / one + 1 / other))


@dataclass(frozen=True)
class Pairs:
    """P pairs of boxes of one label. cosine, label: (P,) of each pair. group: (P,) the number of its object, or of its pair
    of objects."""

    cosine: Floats
    label: Ints
    group: Ints

    def __len__(self) -> int:
        return len(self.cosine)


@dataclass(frozen=True)
class CosineRatio:
    """The densities of two kinds of cosines. same: between boxes of one object. different: between boxes of two objects of
    one label."""

    same: Density
    different: Density

    @classmethod
    def learn(cls, same: Pairs, different: Pairs, labels: int) -> Self:
        """Learn from pairs of boxes that show one object, and from pairs that show two. labels: the number L of labels."""
        every = np.concatenate([same.cosine, different.cosine])
        prior = (float(every.mean()), float(every.var())) if len(every) else (0.0, 1.0)
        return cls(_density(same, prior, labels), _density(different, prior, labels))

    @property
    def informative(self) -> bool:
        """Whether the vectors tell objects of any label apart. Only then is a comparison worth its time."""
        label = np.arange(len(self.same.mean))
        spread = self.different.spread(label, 1, np.inf)
        return bool(((self.same.mean - self.different.mean) > _LEAST_APART * np.sqrt(spread)).any())

    def log_ratio(self, cosine: Floats, label: Ints, one: Ints | float, other: Ints | float) -> Floats:
        """Return the log likelihood ratio (E,) of one object over two. Its size is at most `MOST_RATIO`.

        A larger cosine never gives a smaller ratio. cosine: (E,) the mean cosine between two groups of boxes. one, other:
        how many boxes each group has. label: (E,) the label of both groups.
        """
        s, d = self.same, self.different
        b = d.mean[label]
        a = np.maximum(s.mean[label], b)
        own, their = s.spread(label, one, other), d.spread(label, one, other)
        # The ratio of two Gaussians has a turning point. Beyond it, the ratio would turn back, so it is held constant.
        apart = np.where(own == their, 1.0, own - their)
        turn = (b * own - a * their) / apart
        x = np.where(own < their, np.minimum(cosine, turn), np.where(own > their, np.maximum(cosine, turn), cosine))
        ratio = 0.5 * ((x - b) ** 2 / their - (x - a) ** 2 / own + np.log(their / own))
        return np.clip(np.where(a > b, ratio, 0.0), -MOST_RATIO, MOST_RATIO)


def _density(pairs: Pairs, prior: tuple[float, float], labels: int) -> Density:
    """Estimate the density of each label. prior: the mean and the variance that all pairs have together."""
    x, number = pairs.cosine, np.bincount(pairs.label, minlength=labels)
    mean, variance = (
        (x.sum() + _PRIOR * prior[0]) / (len(x) + _PRIOR),
        (((x - x.mean()) ** 2).sum() + _PRIOR * prior[1]) / (len(x) + _PRIOR) if len(x) else prior[1],
    )
    of_label = (np.bincount(pairs.label, x, labels) + _PRIOR * mean) / (number + _PRIOR)
    off = x - of_label[pairs.label]
    spread = (np.bincount(pairs.label, off**2, labels) + _PRIOR * variance) / (number + _PRIOR)
    spread = np.maximum(spread, _LEAST_SHARE**2)
    share = _intraclass_correlation(off / np.sqrt(spread[pairs.label]), pairs.group)
    return Density(of_label, share * spread, (1 - share) / 2 * spread)


def _intraclass_correlation(off: Floats, group: Ints) -> float:
    """Return the correlation between the deviations within a group. off, group: (P,) the deviations and their groups.

    With few pairs, the correlation is near 1. Then many boxes of an object count as much as one box.
    """
    _, number = np.unique(group, return_inverse=True)
    size, total, squares = (np.bincount(number, weights) for weights in (None, off, off**2))
    several = size > 1
    product = ((total**2 - squares)[several] / (size[several] - 1)).sum()
    return float(np.clip((product + _PRIOR) / (size[several].sum() + _PRIOR), _LEAST_SHARE, 1.0))

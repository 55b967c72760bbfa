"""Join the objects of labels that are known to be names with objects of other labels that a search found.

Rounds of association judge each object by itself, at solved poses whose errors are known only roughly. The rounds may give
up a thing that is seldom seen, or that stands close to others, although its label shows which boxes it has."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from objslam.core.types import Association, Rays


def beside_names(names: Association, found: Association, rays: Rays) -> Association:
    """Return the objects of `names`, followed by those objects of other labels that a search among all rays found.

    The search must also include the rays of names, because it learns from them how often a thing is detected. The objects of
    names have no probability of existence, because their labels show that they exist. rays: the R rays of both associations.
    """
    other = ~np.isin(found.label, names.label)
    number = np.append(np.where(other, names.count + np.cumsum(other) - 1, -1), -1)
    object_ = np.where(np.isin(rays.label, names.label), names.object, number[found.object])
    shares, existence = found.label_weights, found.existence
    return replace(
        found,
        object=object_,
        label=np.append(names.label, found.label[other]),
        label_weights=None if shares is None else np.concatenate([np.eye(shares.shape[1])[names.label], shares[other]]),
        existence=None if existence is None else np.append(np.full(names.count, np.nan), existence[other]),
        refuted=None if found.refuted is None else found.refuted & (object_ < 0),
    )

"""The simplest association: every label is one object."""

from __future__ import annotations

import numpy as np

from objslam.types import Association, Rays


def associate_by_label(rays: Rays) -> Association:
    """One object for each label that has a ray, in the order of label_names; of several boxes a frame the best one counts.

    Best is the highest score. The ties of a frame go to the first box. Rays left over belong to no object (-1).
    """
    labels = np.unique(rays.label)
    best = np.lexsort((np.arange(len(rays)), -rays.score, rays.label, rays.keyframe))
    _, first = np.unique(np.stack([rays.keyframe[best], rays.label[best]]), axis=1, return_index=True)
    which = np.full(len(rays), -1, dtype=np.int64)
    chosen = best[first]
    which[chosen] = np.searchsorted(labels, rays.label[chosen])
    return Association(object=which, label=labels)

"""Find boxes without an object that stay at one place of the image while the camera turns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from objslam.association.observations import overlap
from objslam.core.arrays import Ints
from objslam.mapping.doubts.chance import LEAST_LOG_ODDS, crowded
from objslam.mapping.doubts.evidence import Evidence
from objslam.mapping.doubts.points import MISSED, fit_points

_FEWEST = 8
"""The fewest boxes of a group. A larger number finds fewer groups."""
_SAME_BOX, _LIKE_BOX = 0.7, 0.3
"""Boxes are at one place of the image if their intersection over union with one box is above the first value. The number of
boxes above the second value shows how many are there by chance. With a larger first value, only steadier boxes are found."""
_BY_CHANCE = 0.1
"""Of random boxes that overlap by more than `_LIKE_BOX`, this share overlaps by more than `_SAME_BOX`. It follows from the
four coordinates of a box: ((1 - 0.7) / (1 - 0.3))^4 is 0.03, and boxes of one detector have similar sizes. A larger share
finds fewer groups."""
_TRIED = 64
"""For each label and camera, boxes at one place of the image are counted around at most this number of boxes. A larger
number finds smaller groups."""
_TURNED = np.cos(np.radians(20.0))
"""The camera must turn by at least an angle with this cosine. A far thing ahead of a robot that drives straight on also
stays at its place of the image. A smaller cosine finds fewer groups."""


def fixed_in_image(evidence: Evidence, left: Ints) -> Iterator[Ints]:
    """Yield groups of rays at one place of the image, which no point at rest explains. left: (M,) rays without an object."""
    obs, view = evidence.state.obs, evidence.state.view
    key = view.camera[obs.frame[left]] * len(evidence.state.unassigned) + obs.label[left]
    order = np.argsort(key, kind="stable")
    for mine in np.split(left[order], np.flatnonzero(np.diff(key[order])) + 1):
        while len(mine) >= _FEWEST:
            centre = mine[np.linspace(0, len(mine) - 1, min(_TRIED, len(mine))).astype(np.int64)]
            alike = overlap(obs.box[centre][:, None], obs.box[mine][None])
            inside = alike >= _SAME_BOX
            best = int(inside.sum(axis=1).argmax())
            group = mine[inside[best]]
            around = (alike >= _LIKE_BOX).sum(axis=1)
            odds = crowded(inside.sum(axis=1), around, _BY_CHANCE, len(centre))
            if len(group) < _FEWEST or odds[best] < LEAST_LOG_ODDS:
                break
            ahead = view.map_T_camera[obs.frame[group], :3, 2]
            turned = (ahead @ ahead[0]).min() < _TURNED
            if turned and fit_points(evidence, [group]).deviation[0] > MISSED:
                yield group
            mine = mine[~inside[best]]

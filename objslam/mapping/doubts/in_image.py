"""Find boxes without an object that stay at one place of the image while the camera turns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from objslam.association.observations import overlap
from objslam.core.arrays import Ints
from objslam.frontend.boxes.robot_parts import LIKE_BOX, SAME_BOX
from objslam.mapping.doubts.chance import LEAST_LOG_ODDS, crowded
from objslam.mapping.doubts.evidence import Evidence
from objslam.mapping.doubts.points import MISSED, fit_points

_FEWEST = 8
"""The fewest boxes of a group. A larger number finds fewer groups."""
_BY_CHANCE = 0.1
"""The largest share of the random boxes near a place of the image that are at the place itself (`robot_parts.STEADY`). A
larger share finds fewer groups."""
_TRIED = 64
"""The most boxes of a label and camera around which the boxes at the same place of the image are counted. A larger number
finds smaller groups."""
_TURNED = np.cos(np.radians(20.0))
"""The cosine of the least angle by which the camera must turn. A far thing ahead of a robot that drives straight on also
stays at its place of the image, but the camera does not turn. A smaller cosine finds fewer groups."""


def fixed_in_image(evidence: Evidence, left: Ints) -> Iterator[Ints]:
    """Yield groups of rays that stay at one place of the image, if no point at rest explains them. left: (M,) the rays
    without an object."""
    obs, view = evidence.state.obs, evidence.state.view
    key = view.camera[obs.frame[left]] * len(evidence.state.unassigned) + obs.label[left]
    order = np.argsort(key, kind="stable")
    for mine in np.split(left[order], np.flatnonzero(np.diff(key[order])) + 1):
        while len(mine) >= _FEWEST:
            centre = mine[np.linspace(0, len(mine) - 1, min(_TRIED, len(mine))).astype(np.int64)]
            alike = overlap(obs.box[centre][:, None], obs.box[mine][None])
            inside = alike >= SAME_BOX
            best = int(inside.sum(axis=1).argmax())
            group = mine[inside[best]]
            around = (alike >= LIKE_BOX).sum(axis=1)
            odds = crowded(inside.sum(axis=1), around, _BY_CHANCE, len(centre))
            if len(group) < _FEWEST or odds[best] < LEAST_LOG_ODDS:
                break
            ahead = view.map_T_camera[obs.frame[group], :3, 2]
            turned = (ahead @ ahead[0]).min() < _TURNED
            if turned and fit_points(evidence, [group]).deviation[0] > MISSED:
                yield group
            mine = mine[~inside[best]]

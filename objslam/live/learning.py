"""What the landmarks learn from a frame that is in the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from objslam.live.known import in_view
from objslam.live.matching import FrameRays, in_map
from objslam.live.meeting import information, misses
from objslam.types import Floats, Ints

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper

_SETTLE = np.radians(2.0)  # rays that miss their landmarks by more are a loop that closes: the graph is given more time
_TRACKS = 4096  # of the detector, that are remembered


class Lesson(NamedTuple):
    """A frame that is in the map: which of its rays matched which rows of the landmarks, its camera and its keyframe."""

    rays: FrameRays
    matched: Ints
    rows: Ints
    camera: int
    drift: Floats
    stamp: float
    keyframe: int


def learn(m: Mapper, lesson: Lesson) -> None:
    """What the landmarks of a frame learn from it."""
    known = m.known
    rays, matched, rows, camera, drift, stamp, k = lesson
    pose = m.graph.pose(k)
    seen = in_view(known, m.cameras[camera], pose)
    seen[rows] = True
    known.expected[seen] += 1
    if not len(rows):
        return
    s = in_map(rays.take(matched), pose)
    known.position[rows] = m.graph.points(known.id[rows])
    off = misses(s, known.position[rows])
    m.unsettled |= bool((off * s.sigma).max() > _SETTLE)
    known.information[rows] += information(s, known.position[rows])
    known.squared[rows] += np.minimum(off, 6.0) ** 2
    known.seen[rows] += 1
    known.drift[rows] = drift
    known.last[rows] = np.maximum(known.last[rows], stamp)
    known.far[rows] = np.maximum(known.far[rows], np.linalg.norm(known.position[rows] - pose[:3, 3], axis=1))
    for i, row in zip(matched.tolist(), rows.tolist(), strict=True):
        if rays.track[i] >= 0:
            m.tracks[int(rays.track[i])] = int(known.id[row])
            if len(m.tracks) > _TRACKS:
                del m.tracks[next(iter(m.tracks))]
    if not m.by_label and len(rows) > 1:
        ids = np.sort(known.id[rows])
        same = {int(j): int(label) for j, label in zip(known.id[rows], known.label[rows], strict=True)}
        for a in range(len(ids)):
            for b in range(a + 1, len(ids)):
                pair = (int(ids[a]), int(ids[b]))
                if same[pair[0]] == same[pair[1]]:
                    m.together[pair] = m.together.get(pair, 0) + 1

"""What landmarks learn from a frame that is in the map; landmarks that turn out to be one, and landmarks that go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.refinement import information, normalised_residuals
from objslam.core.arrays import Ints
from objslam.core.statistics import CLIPPED_RAY
from objslam.live.mapper.frame_association import FrameRays, in_map
from objslam.live.mapper.landmark_table import in_view
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track

_JUMP = np.radians(2.0)
"""rad; rays of a frame in the map that miss their landmarks by more are a loop that closes. Larger gives the graph less
time to settle after one."""
_TRACKS = 4096
"""Tracks of the detector whose landmark is remembered; more serve a detector that takes numbers up again late."""


@dataclass(frozen=True)
class LandmarkUpdate:
    """What the newest keyframe, which is in the graph, has for landmarks and tracks.

    rays: of the frame. matched: (m,) those of them that are of a landmark, and rows: (m,) of these landmarks in their table.
    tracks: that have a ray of the frame, new ones too.
    """

    rays: FrameRays
    matched: Ints
    rows: Ints
    tracks: list[Track]


def update_landmarks(m: MapState, update: LandmarkUpdate) -> None:
    """Count which landmarks the newest keyframe showed or should have, and add what its rays tell of them."""
    landmarks, keyframes, rays, rows = m.landmarks, m.keyframes, update.rays, update.rows
    pose = m.graph.pose(int(keyframes.id[-1]))
    seen = in_view(landmarks, m.cameras[keyframes.camera[-1]], pose)
    seen[rows] = True
    landmarks.expected[seen] += 1
    if not len(rows):
        return
    ids = landmarks.id[rows]
    landmarks.position[rows] = position = m.graph.points(ids)
    obs = in_map(rays, pose, update.matched)
    off = normalised_residuals(obs, position)
    if (off * obs.sigma).max() > _JUMP:
        m.schedule.relinearise_soon()
    landmarks.information[rows] += information(obs, position)
    landmarks.squared[rows] += np.minimum(off, CLIPPED_RAY) ** 2
    landmarks.seen[rows] += 1
    landmarks.drift[rows] = keyframes.drift[-1]
    landmarks.last[rows] = np.maximum(landmarks.last[rows], keyframes.stamp[-1])
    landmarks.far[rows] = np.maximum(landmarks.far[rows], np.linalg.norm(position - pose[:3, 3], axis=1))
    for track, j in zip(rays.track[update.matched].tolist(), ids.tolist(), strict=True):
        if track >= 0:
            m.landmark_of_track[track] = j
            if len(m.landmark_of_track) > _TRACKS:
                del m.landmark_of_track[next(iter(m.landmark_of_track))]
    if not m.by_label:
        together, shown = m.pairs.together, sorted(zip(ids.tolist(), landmarks.label[rows].tolist(), strict=True))
        for a, (first, label) in enumerate(shown):
            for second, other in shown[a + 1 :]:
                if label == other:
                    together[first, second] = together.get((first, second), 0) + 1


def merge_landmarks(m: MapState, keep: int, drop: int) -> None:
    """The rays and counts of one landmark, by its row, become another's; `remove_landmarks` must follow."""
    landmarks, rays = m.landmarks, m.rays
    mine = np.flatnonzero(rays.owner == landmarks.id[drop])
    m.graph.drop_rays(rays.number[mine])
    rays.owner[mine] = landmarks.id[keep]
    landmarks.information[keep] += landmarks.information[drop]
    for counts in (landmarks.squared, landmarks.seen, landmarks.expected, landmarks.rejected):
        counts[keep] += counts[drop]
    landmarks.first[keep] = min(landmarks.first[keep], landmarks.first[drop])
    if landmarks.last[drop] > landmarks.last[keep]:
        landmarks.last[keep], landmarks.drift[keep] = landmarks.last[drop], landmarks.drift[drop]
    landmarks.far[keep] = max(landmarks.far[keep], landmarks.far[drop])
    m.graph.add_rays(m.bearings(mine[rays.used[mine]]))


def remove_landmarks(m: MapState, rows: Ints, rebuild: bool = True) -> None:
    """Landmarks that no ray is of go, by their rows; without `rebuild` the graph still waits for it."""
    ids = m.landmarks.id[rows]
    m.pairs.forget(set(ids.tolist()))
    m.graph.drop_landmarks(ids)
    kept = np.ones(len(m.landmarks), dtype=bool)
    kept[rows] = False
    m.landmarks.keep(kept)
    if rebuild:
        m.graph.rebuild_in_slices(m.in_order())
        m.read_positions()

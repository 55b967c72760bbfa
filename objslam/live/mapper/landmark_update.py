"""The update of landmarks by a new keyframe, and the merging and removal of landmarks."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from objslam.association.observations import SIZED_BY, Observations, UsualSizes
from objslam.association.refinement import information, normalised_residuals
from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import CLIPPED_RAY
from objslam.live.mapper.frame_association import FrameRays, in_map
from objslam.live.mapper.landmark_table import in_view
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track

_JUMP = np.radians(2.0)  # The residual (rad) above which the graph is soon relinearised. With a larger one, this is rarer.
_GROWN = 1.2
"""The factor by which the number of a landmark's observations grows before the size of its boxes is measured again. With a
larger factor, sizes are older, and measuring them takes less time."""
_MOVED = 0.05
"""The motion of a landmark, as a share of its distance from the camera, after which the size of its boxes is measured again.
The size depends on the distance, because a box of the same size shows a larger thing at a larger distance. With a larger
share, sizes are older."""
_BOXES = 20
"""The most boxes that give the size of one landmark. They are spread evenly over all boxes of the landmark. More boxes take
longer."""
_TRACKS = 4096  # The detector tracks whose landmark is stored. A larger number knows a track id after a longer absence.


@dataclass(frozen=True)
class LandmarkUpdate:
    """The observations of the newest keyframe, which are already in the graph.

    rays: all rays of the frame. Rays of landmarks with a body are turned to the body's centre. matched: (m,) the indices of
    rays with a landmark. rows: (m,) the rows of these landmarks in the table. tracks: all tracks with a ray of the frame.
    """

    rays: FrameRays
    matched: Ints
    rows: Ints
    tracks: list[Track]


def update_landmarks(m: MapState, update: LandmarkUpdate) -> None:
    """Count which landmarks the newest keyframe should show, and which landmarks it shows. Update the shown landmarks by
    their new rays."""
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
    away = np.linalg.norm(position - pose[:3, 3], axis=1)
    landmarks.far[rows] = np.maximum(landmarks.far[rows], away)
    moved = np.linalg.norm(position - landmarks.measured_at[rows], axis=1) > _MOVED * away
    grown = landmarks.seen[rows] >= _GROWN * landmarks.measured[rows]
    measure_sizes(m, rows[(landmarks.seen[rows] >= SIZED_BY) & (moved | grown)])
    for track, j in zip(rays.track[update.matched].tolist(), ids.tolist(), strict=True):
        if track >= 0:
            m.landmark_of_track[track] = j
            if len(m.landmark_of_track) > _TRACKS:
                del m.landmark_of_track[next(iter(m.landmark_of_track))]
    if not m.by_label:  # Only classes have several landmarks of a label.
        shown = sorted(zip(ids.tolist(), landmarks.label[rows].tolist(), strict=True))
        for (first, label), (second, other) in combinations(shown, 2):
            if label == other:
                m.pairs.together[first, second] += 1


def observed(obs: Observations, position: Floats) -> dict[str, Floats | float]:
    """Return the columns of a landmark at a position (3,) that follow from its rays. obs: the rays, all inliers, in the
    frame map."""
    return {
        "position": position,
        "information": information(obs, position).sum(axis=0),
        "seen": float(len(obs.origin)),
        "far": float(np.linalg.norm(position - obs.origin, axis=1).max()),
        "squared": float((normalised_residuals(obs, position) ** 2).clip(max=CLIPPED_RAY**2).sum()),
    }


def measure_sizes(m: MapState, rows: Ints) -> None:
    """Measure the usual sizes of the boxes of the landmarks in these rows (n,), from at most `_BOXES` boxes of each."""
    if not len(rows):
        return
    landmarks, rays = m.landmarks, m.rays
    chosen = [np.flatnonzero((rays.owner == j) & rays.used) for j in landmarks.id[rows].tolist()]
    chosen = [mine[np.linspace(0, len(mine) - 1, min(len(mine), _BOXES)).astype(np.int64)] for mine in chosen]
    mine, index = np.concatenate(chosen), np.repeat(np.arange(len(rows)), [len(some) for some in chosen])
    origin = np.array([m.graph.pose(k)[:3, 3] for k in rays.keyframe[mine].tolist()]).reshape(-1, 3)
    distance = np.linalg.norm(landmarks.position[rows[index]] - origin, axis=1)
    usual = UsualSizes.of(rays.size[mine], distance, index, len(rows))
    landmarks.sized[rows], landmarks.ln_size[rows] = usual.number, usual.ln_size
    landmarks.size_variance[rows] = usual.variance
    landmarks.measured[rows], landmarks.measured_at[rows] = landmarks.seen[rows], landmarks.position[rows]


def merge_landmarks(m: MapState, keep: int, drop: int) -> None:
    """Move rays and counts from the landmark in row `drop` to the landmark in row `keep`. The caller must remove `drop`
    next."""
    landmarks, rays = m.landmarks, m.rays
    mine = np.flatnonzero(rays.owner == landmarks.id[drop])
    m.graph.drop_rays(rays.number[mine])
    rays.owner[mine] = landmarks.id[keep]
    for sums in (landmarks.information, landmarks.squared, landmarks.seen, landmarks.expected, landmarks.rejected):
        sums[keep] += sums[drop]
    landmarks.first[keep] = min(landmarks.first[keep], landmarks.first[drop])
    if landmarks.last[drop] > landmarks.last[keep]:
        landmarks.last[keep], landmarks.drift[keep] = landmarks.last[drop], landmarks.drift[drop]
    landmarks.far[keep] = max(landmarks.far[keep], landmarks.far[drop])
    if rays.to_centre[mine].any() or landmarks.shape[keep]:
        rays.to_centre[mine], rays.centre_sigma[mine] = m.to_centres(mine)
    m.graph.add_rays(m.bearings(mine[rays.used[mine]]))
    measure_sizes(m, np.array([keep]))


def remove_landmarks(m: MapState, rows: Ints, rebuild: bool = True) -> None:
    """Remove the landmarks in these rows, which must have no rays. Without `rebuild` the caller must rebuild the graph."""
    ids = m.landmarks.id[rows]
    m.pairs.forget(set(ids.tolist()))
    m.graph.drop_landmarks(ids)
    kept = np.ones(len(m.landmarks), dtype=bool)
    kept[rows] = False
    m.landmarks.keep(kept)
    if rebuild:
        m.rebuild_in_slices()


def drop_landmarks(m: MapState, rows: Ints) -> None:
    """Remove the landmarks in rows (n,). Their rays then belong to no landmark."""
    mine = np.isin(m.rays.owner, m.landmarks.id[rows])
    m.graph.drop_rays(m.rays.number[mine])
    m.rays.owner[mine], m.rays.used[mine] = -1, False
    remove_landmarks(m, rows)

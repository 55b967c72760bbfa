"""The association of a new keyframe's rays with landmarks and tracks, and the addition of ray factors to the graph."""

import numpy as np

from objslam.association.duplicates import may_be_one
from objslam.association.landmarks import PredictedLandmarks
from objslam.core.arrays import Bools, Floats, Ints
from objslam.live.mapper.frame_association import FrameRays, best_of_label, match, match_by_label
from objslam.live.mapper.landmark_table import at_box_centres, box_centres, predict_landmarks, to_centres
from objslam.live.mapper.landmark_update import LandmarkUpdate
from objslam.live.mapper.pose_uncertainty import PoseUncertainty
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track

_NOVELTY_WEIGHT = 0.02  # The weight of one frame in MapState.novelty. A larger weight adapts sooner, with more noise.

_NEAR_BOX = np.cos(np.radians(20.0))
"""The cosine of 20 degrees. The body of a landmark is used if a box of its label is within this angle of the landmark. A
smaller angle saves time. If the pose is so uncertain that a more distant box may match, bodies do not matter."""


def associate(
    m: MapState, rays: FrameRays, map_T_camera: Floats, uncertainty: PoseUncertainty, predicted: PredictedLandmarks | None
) -> LandmarkUpdate:
    """Assign the rays of the newest keyframe to landmarks and tracks, and add the rays of landmarks to the graph.

    rays: the rays of the keyframe. map_T_camera: (4, 4) predicted camera pose, with its `uncertainty`. predicted: the result
    of `predict_landmarks`, or None to compute it here. Rays that match nothing begin tracks. Second boxes of a thing
    (`first_boxes`) and boxes of things that move are only kept for the end of the session.
    """
    landmarks, settings, k, count = m.landmarks, m.settings.association, int(m.keyframes.id[-1]), len(rays.label)
    one = may_be_one(rays.box, rays.label)
    m.kinds.seen.update(rays.label.tolist())
    for label in _shown_twice(rays.label, one) if settings.method == "auto" else ():
        if m.kinds.name(np.array([label]))[0]:
            m.kinds.shown.add(label)
            m.note_class(label)
            predicted = None
    beside, spread = _box_centres(m, rays, map_T_camera)
    numbers = m.next_id.ray + np.arange(count)
    m.next_id.ray += count
    row, owner, used = np.full(count, -1), np.full(count, -1), np.zeros(count, dtype=bool)
    waiting: dict[int, Track] = {}  # The present tracks of names, by label.
    tracks: dict[int, Track] = {}  # The tracks of the frame's rays, by the index of the ray.
    free: list[int] = []
    if predicted is None:
        predicted = predict_landmarks(landmarks, [] if m.by_label else m.tracks)
    predicted = at_box_centres(predicted, beside, spread)
    named, classed = m.kinds.name(rays.label), m.kinds.classes(rays.label)
    if named.any():
        best = best_of_label(rays)
        best = best[named[best]]
        row[best], missed = match_by_label(rays.take(best), map_T_camera, predicted, uncertainty, settings.gate)
        lost = missed >= 0
        landmarks.rejected[missed[lost]] += 1
        owner[best[lost]] = landmarks.id[missed[lost]]
        free += best[(row[best] < 0) & ~lost].tolist()
        waiting = {track.label: track for track in m.tracks if track.by_label}
    if classed.any():
        first = first_boxes(rays.score, one)
        first = first[classed[first]]
        known = settings.gate, m.landmark_of_track, m.novelty
        row[first] = match(rays.take(first), map_T_camera, predicted, uncertainty, len(m.labels), *known)
        of_track = row >= predicted.landmarks
        m.novelty += _NOVELTY_WEIGHT * (float((of_track | (row < 0))[first].mean()) - m.novelty)
        tracks = {i: m.tracks[row[i] - predicted.landmarks] for i in np.flatnonzero(of_track).tolist()}
        free += first[row[first] < 0].tolist()
        row[of_track] = -1
    matched = np.flatnonzero(row >= 0)
    owner[matched], used[matched] = landmarks.id[row[matched]], True
    added, noise, turned = np.zeros((count, 3)), np.zeros(count), rays
    large = matched[beside[row[matched]].any(axis=1)]
    if len(large):
        at = row[large]
        to = landmarks.position[at] - map_T_camera[:3, 3]
        added[large], noise[large] = to_centres(to, beside[at], spread[at], map_T_camera[:3, :3])
        turned = rays.turned(added, noise)
    m.rays.add(
        number=numbers, keyframe=np.full(count, k), owner=owner, used=used, to_centre=added, centre_sigma=noise, **vars(rays)
    )
    stamp = float(m.keyframes.stamp[-1])
    for i in sorted(free):
        label = int(rays.label[i])
        if label not in waiting:
            tracks[i] = Track(m.next_id.track, label, bool(named[i]), stamp, stamp, uncertainty.drift)
            m.next_id.track += 1
            m.tracks.append(tracks[i])
        else:
            tracks[i] = waiting[label]
    for i, track in tracks.items():
        ray = (int(numbers[i]), k, rays.direction[i], float(rays.sigma[i]), float(rays.range[i]), float(rays.range_sigma[i]))
        track.extend(ray, map_T_camera, stamp, uncertainty.drift)
    if len(matched):
        m.graph.add_rays(m.bearings(len(m.rays.number) - count + matched))
    m.graph.update()
    return LandmarkUpdate(turned, matched, row[matched], list(tracks.values()))


def _shown_twice(label: Ints, one: Bools) -> list[int]:
    """Return the labels of which a frame shows two things. label: (n,) the labels of its boxes. one: (n, n) as in
    `may_be_one`."""
    first, _ = np.nonzero(np.triu(label[:, None] == label, 1) & ~one)
    return sorted(set(label[first].tolist()))


def first_boxes(score: Floats, one: Bools) -> Ints:
    """Return the boxes that may match something or begin a track. Of the boxes that may show one thing, only the surest may.

    A second box of a thing would become a second landmark, or pull the first landmark aside. A thing behind another thing of
    its label loses some boxes, but keeps the boxes from places where the robot sees both things side by side. The end of the
    session uses all boxes. score: (n,). one: (n, n) as in `may_be_one`.
    """
    first = np.zeros(len(score), dtype=bool)
    for i in np.argsort(-score, kind="stable").tolist():
        first[i] = not (one[i] & first).any()
    return np.flatnonzero(first)


def _box_centres(m: MapState, rays: FrameRays, map_T_camera: Floats) -> tuple[Floats, Floats]:
    """Return the two arrays (N, 3) and (N,) of `box_centres` for all landmarks in the newest keyframe.

    A landmark that is far from the boxes of its label (`_NEAR_BOX`) has the vector 0. map_T_camera: (4, 4) of the keyframe.
    """
    landmarks = m.landmarks
    beside, sigma = np.zeros((len(landmarks), 3)), np.zeros(len(landmarks))
    rows = landmarks.shape.nonzero()[0]
    if len(rows):
        to, turn = landmarks.position[rows] - map_T_camera[:3, 3], map_T_camera[:3, :3]
        along = (to @ turn) @ rays.direction.T
        near = (landmarks.label[rows][:, None] == rays.label) & (along > _NEAR_BOX * np.sqrt((to * to).sum(axis=1))[:, None])
        rows = rows[near.any(axis=1)]
    if len(rows):
        camera = np.repeat(m.keyframes.camera[-1:], len(rows))
        poses = np.broadcast_to(map_T_camera, (len(rows), 4, 4))
        beside[rows], sigma[rows] = box_centres(landmarks, rows, m.cameras, camera, poses)
    return beside, sigma

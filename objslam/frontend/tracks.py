"""Chains of boxes that show one thing in images that follow each other."""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.types import Association, Keyframes, Rays

_LONGEST = 1.0
"""The longest time (s) between two boxes of a track that follow each other. Over a longer time, the robot drives past the
thing, and the next box is not where the odometry expects it."""
_NEAR = np.radians(6.0)
"""The largest angle (rad) between a ray and the ray before it in its track, turned by the odometry. A thing beside the robot
moves by 5 degrees if the robot drives 8 % of its distance between the images. A larger angle joins neighbours more often."""
_BRIDGED = 0.5
"""The longest time (s) between two boxes of a track if the detector missed the thing between them. Ten robots were
simulated. With 5 to 15 images a second, the bridge reduced the errors of clock and turns to a third. With 1 s and 2 images a
second, these errors grew, because neighbours were joined."""
_IMAGES = 3
"""The number of images before a ray in which its track may have its last ray. With 1, each missed box ends a track: of boxes
that are missed in one of five images, tracks then have 5 rays on average. A larger number joins neighbours more often."""
FEWEST = 3
"""The fewest rays of a track. Two rays nearly always meet. With a larger number, fewer tracks are of use."""


def associate_tracks(keyframes: Keyframes, rays: Rays) -> Association:
    """Return an association with an object for each track of at least three rays.

    Two rays of one label in neighbouring images are linked if each is the nearest one to the other. A detector misses boxes.
    So a ray without a link is then compared with the image one further back, and so on. Linked rays are a track. Rays of
    shorter tracks have no object.

    keyframes: with odometry, which predicts each ray in the next image.
    """
    assert keyframes.odom_T_base is not None
    track, length = tracks_of_rays(keyframes, rays, keyframes.odom_T_base @ keyframes.base_T_camera)
    long = length >= FEWEST
    number = np.where(long, np.cumsum(long) - 1, -1)
    label = np.zeros(int(long.sum()), dtype=rays.label.dtype)
    owner = number[track]
    label[owner[owner >= 0]] = rays.label[owner >= 0]
    return Association(owner, label)


def tracks_of_rays(keyframes: Keyframes, rays: Rays, path_T_camera: Floats) -> tuple[Ints, Ints]:
    """Return the number (R,) of the track of each ray, and the number of rays of each track.

    A ray that continues no track, and that no ray continues, is a track of its own. path_T_camera: (K, 4, 4) the poses of
    the cameras in any frame, by odometry or solved.
    """
    direction = np.einsum("rij,rj->ri", path_T_camera[rays.keyframe, :3, :3], rays.direction)
    root = np.arange(len(rays))
    last, first = np.ones((2, len(rays)), dtype=bool)  # Whether a ray is the last of its track so far, and the first.
    for gap in range(1, _IMAGES + 1):
        one, two = _neighbours(keyframes, rays, gap)
        cosine = np.einsum("pi,pi->p", direction[one], direction[two])
        near = np.flatnonzero((cosine > np.cos(_NEAR)) & last[one] & first[two])
        one, two, cosine = one[near], two[near], cosine[near]
        forward, backward = np.full((2, len(rays)), -1.0)
        np.maximum.at(forward, one, cosine)
        np.maximum.at(backward, two, cosine)
        linked = (cosine == forward[one]) & (cosine == backward[two])
        root[two[linked]] = one[linked]
        last[one[linked]], first[two[linked]] = False, False
    while (root[root] != root).any():
        root = root[root]
    _, track, length = np.unique(root, return_inverse=True, return_counts=True)
    return track.ravel(), length


def _neighbours(keyframes: Keyframes, rays: Rays, gap: int) -> tuple[Ints, Ints]:
    """Return the pairs (P,) of rays of one label in images of one camera.

    gap: 1 for images that follow each other, 2 with one image between them, and so on. Only images with a box of this label
    count."""
    group = rays.label * (int(keyframes.camera.max(initial=0)) + 1) + keyframes.camera[rays.keyframe]
    order = np.lexsort((rays.keyframe, group))
    changes = np.flatnonzero((np.diff(group[order]) != 0) | (np.diff(rays.keyframe[order]) != 0)) + 1
    begin = np.append(0, changes)
    end = np.append(changes, len(order))
    first = order[begin]
    stamps, kind = keyframes.stamps[rays.keyframe[first]], group[first]
    apart = stamps[gap:] - stamps[:-gap]
    longest = _LONGEST if gap == 1 else _BRIDGED
    follow = np.flatnonzero((kind[gap:] == kind[:-gap]) & (apart > 0) & (apart <= longest))
    many, more = (end - begin)[follow], (end - begin)[follow + gap]
    pair = np.repeat(np.arange(len(follow)), many * more)
    step = np.arange(len(pair)) - np.repeat(np.cumsum(many * more) - many * more, many * more)
    one = begin[follow][pair] + step // more[pair]
    two = begin[follow + gap][pair] + step % more[pair]
    return order[one], order[two]

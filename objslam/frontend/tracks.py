"""Chains of boxes that show one thing in images that follow each other."""

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import angles_off
from objslam.core.types import Association, Keyframes, Rays

_LONGEST = 1.0
"""The longest time (s) between two boxes of a track that follow each other. Over a longer time, the robot drives past the
thing, and the next box is not where the odometry expects it."""
_NEAR = np.radians(6.0)
"""The largest angle (rad) between a ray and the previous ray of its track, which the odometry turns into the later image. A
thing beside the robot moves by 5 degrees if the robot drives 8 % of the thing's distance between the images. A larger angle
joins neighbours more often."""
_MISS = 5.0
"""The largest angle of a link by ranges, as a multiple of the median angle by which linked rays miss each other (the miss).
The angle is at least `_LEAST_MISS` and at most `_NEAR`. A range shows where a thing is, so its shift in the image is
predictable. So rays of one track hardly miss each other. The median miss was 0.3 to 0.5 degrees in buildings, 0.9 on rough
ground, and 2 for a robot that sways on its legs. Some recorded posts stand in groups, 17 cm apart. There, 27 % of the links
joined neighbours if the largest angle was 6 degrees, and 20 % if it was 3 degrees. A larger multiple joins neighbours more
often."""
_LEAST_MISS = np.radians(3.0)
"""The lower limit (rad) of the largest angle of a link by ranges. Where wheels slip, rays miss each other by more than
usual, but tracks must not end. With 2 degrees, the path in a simulated hotel was bent by 4 m at a slip, and with 3 degrees
by 0.2 m. A larger angle joins neighbours more often."""
_BRIDGED = 0.5
"""The longest time (s) between two boxes of a track if the detector missed the thing between them. Ten robots were
simulated. With 5 to 15 images a second, bridged misses reduced the errors of clock and turns to a third. With 1 s and 2
images a second, these errors grew, because neighbours were joined."""
_IMAGES = 3
"""The number of earlier images in which the previous ray of a track is looked for. With 1, each missed box ends a track. If
one box in five is missed, tracks then have 5 rays on average. A larger number joins neighbours more often."""
FEWEST = 3
"""The fewest rays of a track. Two rays nearly always meet. With a larger number, fewer tracks are of use."""


def associate_tracks(keyframes: Keyframes, rays: Rays) -> Association:
    """Return an association with an object for each track of at least three rays.

    Two rays of one label in neighbouring images are linked if each is the nearest one to the other (`_angles`). A detector
    misses boxes. So a ray without a link is then compared with rays of the image before that, and so on. Linked rays are a
    track. Rays of shorter tracks have no object.

    keyframes: they must have odometry, which predicts each ray in the next image.
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

    A ray that is linked to no other ray is a track of its own. path_T_camera: (K, 4, 4) the poses of the cameras in any
    frame, by odometry or solved.
    """
    origin, direction = rays.in_map(path_T_camera)
    root = np.arange(len(rays))
    last, first = np.ones((2, len(rays)), dtype=bool)  # Is a ray the last, or the first, of its track so far?
    by_range = _NEAR
    for gap in range(1, _IMAGES + 1):
        one, two = _neighbours(keyframes, rays, gap)
        angle, ranged = _angles(origin, direction, rays.range, one, two)
        near = np.flatnonzero((angle < np.where(ranged, by_range, _NEAR)) & last[one] & first[two])
        linked = near[_mutual(one[near], two[near], angle[near], len(rays))]
        if gap == 1 and ranged[linked].any():
            by_range = float(np.clip(_MISS * np.median(angle[linked[ranged[linked]]]), _LEAST_MISS, _NEAR))
            linked = linked[~ranged[linked] | (angle[linked] < by_range)]
        root[two[linked]] = one[linked]
        last[one[linked]], first[two[linked]] = False, False
    while (root[root] != root).any():
        root = root[root]
    _, track, length = np.unique(root, return_inverse=True, return_counts=True)
    return track.ravel(), length


def _mutual(one: Ints, two: Ints, angle: Floats, count: int) -> Bools:
    """Return which pairs (P,) of rays are the nearest ones to each other. angle: (P,) rad. count: the number of rays."""
    forward, backward = np.full((2, count), np.inf)
    np.minimum.at(forward, one, angle)
    np.minimum.at(backward, two, angle)
    return np.asarray((angle == forward[one]) & (angle == backward[two]))


def _angles(origin: Floats, direction: Floats, range_m: Floats, one: Ints, two: Ints) -> tuple[Floats, Bools]:
    """Return the angles (P,), rad, by which pairs of rays miss each other, and which of them are from a range (P,).

    A ray with a range ends at a point, and the other ray of the pair misses this point by an angle. If both have a range,
    the smaller angle counts, because one range may be wrong. If none has one, the angle between the directions counts, which
    is right for a thing far away. A thing that the robot passes moves by many degrees between two images. Of boxes on
    shelves beside a robot, 31 % were linked to a neighbour if ranges were not used, and 2 % if they were used.

    origin, direction: (R, 3) of the rays. range_m: (R,) m, NaN without one. one, two: (P,) the rays of each pair.
    """
    end = origin + direction * range_m[:, None]
    from_ranges = np.fmin(*(angles_off(origin[ray], direction[ray], end[other]) for ray, other in ((one, two), (two, one))))
    between = angles_off(np.zeros_like(direction[one]), direction[one], direction[two])
    ranged = np.isfinite(from_ranges)
    return np.where(ranged, from_ranges, between), ranged


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

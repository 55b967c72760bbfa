"""Placement of labels in a picture, so that no label covers another label or a dot."""

import cv2
import numpy as np

from objslam.core.arrays import Bools, Floats

_ANGLES = np.linspace(0, 2 * np.pi, 24, endpoint=False)  # The directions, rad, of candidate positions from a dot.
_RADII = np.array([9.0, 15.0, 24.0, 38.0, 56.0, 80.0, 110.0, 145.0, 185.0])
"""The distances of a label's candidate positions from its dot, px. A larger distance costs more."""
_DOT = 6.0  # Half the side, px, of the square around a dot that no label covers.
_PAD = 2.0  # The least distance, px, between two labels.
_CROWDED = 60.0  # The distance, px, within which dots count as crowded. Labels of the most crowded dots are placed first.
_FAR = 14.0  # The largest distance of a label from its dot without a leader line, px.
_AMBIGUOUS = 2.0  # A label is ambiguous if another dot is less than this, px, farther away than its own dot.
_AMBIGUOUS_COST = 60.0  # The cost, px, of an ambiguous label. With a larger cost, fewer labels are ambiguous.
_COVER_COST = 1.5  # The cost, px, of each point in `avoid` that a label covers.
_MOST_COVERED = 20  # The largest number of covered points that add to the cost.
_CROSSING_COST = 60.0  # The cost, px, of each line, label or dot that a leader line crosses.
_OUTWARD_GAIN = 0.05  # The reduction of the cost, px, for each px away from the mean of all dots. It keeps the middle free.


def place_labels(anchors: Floats, sizes: Floats, frame: Floats, avoid: Floats) -> tuple[Floats, Bools]:
    """Place labels one by one. The labels of the most crowded dots come first. All lengths are in px.

    Each label has a fixed set of candidate positions around its dot, and gets the cheapest free one. A position is free if
    the label lies inside `frame` and covers no dot and no earlier label. A label without a free position is not placed. The
    cost grows with the distance from the dot, and with the number of points of `avoid` that the label covers. It also grows
    if another dot is nearer to the label than its own dot, and with each line, label or dot that its leader line crosses.
    Positions away from the middle of all dots cost less.

    Args:
        anchors: (N, 2) the dots.
        sizes: (N, 2) width and height of each label.
        frame: (2, 2) the lower left and the upper right corner of the area for labels.
        avoid: (P, 2) points that the labels should not cover.
    Returns:
        The lower left corners (N, 2) of the labels, and a mask (N,) of the labels that were placed.
    """
    corners, found = np.zeros((len(anchors), 2)), np.zeros(len(anchors), dtype=bool)
    if len(anchors) == 0:
        return corners, found
    gaps = np.linalg.norm(anchors[:, None] - anchors[None], axis=2)
    crowd = (gaps < _CROWDED).sum(axis=1)
    dots = np.concatenate([anchors - _DOT, anchors + _DOT], axis=1)
    centre, counts = anchors.mean(axis=0), _counts(avoid, frame)
    taken = leaders = np.zeros((0, 4))
    for j in np.argsort(-crowd, kind="stable"):
        boxes, reach = _candidates(anchors[j], sizes[j])
        padded = boxes + np.array([-_PAD, -_PAD, _PAD, _PAD])
        inside = np.all((boxes[:, :2] >= frame[0] + _PAD) & (boxes[:, 2:] <= frame[1] - _PAD), axis=1)
        free = inside & ~_overlaps(padded, dots).any(axis=1) & ~_overlaps(padded, taken).any(axis=1)
        if not free.any():
            continue
        near = np.clip(anchors[j], boxes[:, :2], boxes[:, 2:])
        lines = np.concatenate([np.broadcast_to(anchors[j], near.shape), near], axis=1)
        covered = _covered(boxes, counts, frame[0])
        away = anchors[j] - centre
        outward = ((boxes[:, :2] + boxes[:, 2:]) / 2 - anchors[j]) @ (away / max(float(np.linalg.norm(away)), 1.0))
        others = np.delete(dots, j, axis=0)
        crossings = _cross(lines, leaders).sum(axis=1) + _hits(lines, taken).sum(axis=1) + _hits(lines, others).sum(axis=1)
        own = np.linalg.norm(near - anchors[j], axis=1)
        ambiguous = own >= _nearest(boxes, np.delete(anchors, j, axis=0)) - _AMBIGUOUS
        cost = reach + _AMBIGUOUS_COST * ambiguous + _COVER_COST * np.minimum(covered, _MOST_COVERED)
        cost += _CROSSING_COST * crossings - _OUTWARD_GAIN * outward
        best = int(np.argmin(np.where(free, cost, np.inf)))
        corners[j], found[j] = boxes[best, :2], True
        taken = np.concatenate([taken, boxes[best : best + 1]])
        leaders = np.concatenate([leaders, lines[best : best + 1]])
    return corners, found


def _candidates(anchor: Floats, size: Floats) -> tuple[Floats, Floats]:
    """Return boxes (C, 4), x1, y1, x2, y2, around a dot and their costs (C,). The right side costs least, then the left."""
    direction = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
    centre = anchor + direction * (_RADII[:, None] + np.abs(direction) @ (size / 2))[..., None]
    reach = _RADII[:, None] + 2.0 * np.abs(direction[:, 1]) + 1.0 * (direction[:, 0] < -0.1)
    return np.concatenate([centre - size / 2, centre + size / 2], axis=2).reshape(-1, 4), reach.ravel()


def _counts(points: Floats, frame: Floats) -> Floats:
    """Return the summed-area table of points (P, 2). It has, for each pixel corner, the number of points below and left.

    A test of each of 100,000 points for each candidate would take minutes. With the table, `_covered` is fast.
    """
    low = np.floor(frame[0]).astype(np.int64)
    width, height = (np.ceil(frame[1]).astype(np.int64) + 1 - low).tolist()
    x, y = (np.floor(points[np.isfinite(points).all(axis=1)]) - low).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    pixel = (x[inside] * height + y[inside]).astype(np.int64)
    table = np.bincount(pixel, minlength=width * height).reshape(width, height)
    return np.asarray(cv2.integral(table.astype(np.float64)), dtype=np.float64)


def _covered(boxes: Floats, counts: Floats, origin: Floats) -> Floats:
    """Return the number (A,) of points in the pixels that each box (A, 4) touches.

    counts: the table of `_counts`. origin: (2,) the lower left corner of the area of the table.
    """
    pixels = np.floor(boxes).astype(np.int64) - np.tile(np.floor(origin).astype(np.int64), 2) + [0, 0, 1, 1]
    x1, y1, x2, y2 = np.clip(pixels, 0, np.tile(np.array(counts.shape) - 1, 2)).T
    return np.asarray(counts[x2, y2] - counts[x1, y2] - counts[x2, y1] + counts[x1, y1])


def needs_leader(anchors: Floats, corners: Floats, sizes: Floats) -> Bools:
    """Return a mask (N,) of the labels that need a line to their dot. These are the distant and the ambiguous labels."""
    boxes = np.concatenate([corners, corners + sizes], axis=1)
    own = np.linalg.norm(np.clip(anchors, corners, corners + sizes) - anchors, axis=1)
    others = np.array([_nearest(boxes[j : j + 1], np.delete(anchors, j, axis=0))[0] for j in range(len(anchors))])
    return (own > _FAR) | (own >= others.reshape(-1) - _AMBIGUOUS)


def _nearest(boxes: Floats, points: Floats) -> Floats:
    """Return the distance (A,) from each box (A, 4) to the nearest of the points (P, 2). It is infinite without points."""
    near = np.clip(points[None], boxes[:, None, :2], boxes[:, None, 2:])
    return np.linalg.norm(near - points[None], axis=2).min(axis=1, initial=np.inf)


def _overlaps(a: Floats, b: Floats) -> Bools:
    """Return whether each box of `a` (A, 4) overlaps each box of `b` (B, 4), as (A, B)."""
    return np.all((a[:, None, :2] < b[None, :, 2:]) & (b[None, :, :2] < a[:, None, 2:]), axis=2)


def _cross(a: Floats, b: Floats) -> Bools:
    """Return whether each segment of `a` (A, 4) crosses each segment of `b` (B, 4), as (A, B)."""

    def side(p: Floats, q: Floats, r: Floats) -> Floats:
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    p, q = a[:, None, :2], a[:, None, 2:]
    r, s = b[None, :, :2], b[None, :, 2:]
    return (side(p, q, r) * side(p, q, s) < 0) & (side(r, s, p) * side(r, s, q) < 0)


def _hits(lines: Floats, boxes: Floats) -> Bools:
    """Return whether each of the segments `lines` (A, 4) crosses a diagonal of each box (B, 4), as (A, B)."""
    falling = np.stack([boxes[:, 0], boxes[:, 3], boxes[:, 2], boxes[:, 1]], axis=1)
    return _cross(lines, boxes) | _cross(lines, falling)

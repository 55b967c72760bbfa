"""Where to write labels in a picture, so that none covers another label or a dot."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats

# All lengths and costs are in px.
_ANGLES = np.linspace(0, 2 * np.pi, 24, endpoint=False)  # Directions, rad, in which a label is tried around its dot.
_RADII = (9.0, 15.0, 24.0, 38.0, 56.0, 80.0, 110.0, 145.0, 185.0)  # Distances that are tried; each costs its own length.
_DOT = 6.0  # Half the side of the square around each dot that stays free of labels.
_PAD = 2.0  # The gap that stays free around each label.
_CROWDED = 60.0  # Dots within this distance crowd a dot; the most crowded choose first.
_FAR = 14.0  # A label farther than this from its dot gets a leader line.
_AMBIGUOUS = 2.0  # A label must be nearer to its own dot than to others by more than this, or it is read as another's.
_AMBIGUOUS_COST = 60.0  # What an ambiguous label costs: it moves this much farther out to avoid being one.
_COVER_COST = 1.5  # What each covered point to avoid costs.
_MOST_COVERED = 20  # The number of covered points from which more of them cost no more.
_CROSSING_COST = 60.0  # What each line, label or dot costs that the line from dot to label crosses.
_OUTWARD_GAIN = 0.05  # What each px away from the middle of all dots gains: it keeps the middle free.


def place_labels(anchors: Floats, sizes: Floats, frame: Floats, avoid: Floats) -> tuple[Floats, Bools]:
    """Place labels greedily, the most crowded dots first; all lengths are px.

    Each label takes the cheapest of a fan of places around its dot. The place lies in the frame and covers no dot and no
    label placed before. Far places cost more than near ones; so do places on points to avoid, places nearer to another dot,
    and places whose line to the dot crosses something.

    Args:
        anchors: (N, 2) the dots.
        sizes: (N, 2) width and height of each label.
        frame: (2, 2) lower left and upper right corner.
        avoid: (P, 2) points that are better not covered.
    Returns:
        The labels' lower left corners (N, 2), and which of them found room (N,).
    """
    corners, found = np.zeros((len(anchors), 2)), np.zeros(len(anchors), dtype=bool)
    if len(anchors) == 0:
        return corners, found
    gaps = np.linalg.norm(anchors[:, None] - anchors[None], axis=2)
    crowd = (gaps < _CROWDED).sum(axis=1)
    dots = np.concatenate([anchors - _DOT, anchors + _DOT], axis=1)
    centre = anchors.mean(axis=0)
    taken = np.zeros((0, 4))
    leaders = np.zeros((0, 4))
    for j in np.argsort(-crowd, kind="stable"):
        boxes, reach = _candidates(anchors[j], sizes[j])
        padded = boxes + np.array([-_PAD, -_PAD, _PAD, _PAD])
        inside = np.all((boxes[:, :2] >= frame[0] + _PAD) & (boxes[:, 2:] <= frame[1] - _PAD), axis=1)
        free = inside & ~_overlaps(padded, dots).any(axis=1) & ~_overlaps(padded, taken).any(axis=1)
        if not free.any():
            continue
        near = np.clip(anchors[j], boxes[:, :2], boxes[:, 2:])
        lines = np.concatenate([np.broadcast_to(anchors[j], near.shape), near], axis=1)
        covered = _contains(boxes, avoid).sum(axis=1)
        outward = ((boxes[:, :2] + boxes[:, 2:]) / 2 - anchors[j]) @ _unit(anchors[j] - centre)
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
    """Boxes (C, 4) x1, y1, x2, y2 around a dot, and the cost (C,) of each: its distance, least on the right, then left."""
    direction = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
    boxes, reach = [], []
    for radius in _RADII:
        centre = anchor + direction * (radius + np.abs(direction) @ (size / 2))[:, None]
        boxes.append(np.concatenate([centre - size / 2, centre + size / 2], axis=1))
        reach.append(radius + 2.0 * np.abs(direction[:, 1]) + 1.0 * (direction[:, 0] < -0.1))
    return np.concatenate(boxes), np.concatenate(reach)


def needs_leader(anchors: Floats, corners: Floats, sizes: Floats) -> Bools:
    """Which labels (N,) need a line to their dot: those far from it, and those that may be read as another's."""
    boxes = np.concatenate([corners, corners + sizes], axis=1)
    own = np.linalg.norm(np.clip(anchors, corners, corners + sizes) - anchors, axis=1)
    others = np.array([_nearest(boxes[j : j + 1], np.delete(anchors, j, axis=0))[0] for j in range(len(anchors))])
    return (own > _FAR) | (own >= others.reshape(-1) - _AMBIGUOUS)


def _nearest(boxes: Floats, points: Floats) -> Floats:
    """The distance (A,) of each box (A, 4) from the nearest of points (P, 2); infinite without points."""
    near = np.clip(points[None], boxes[:, None, :2], boxes[:, None, 2:])
    return np.linalg.norm(near - points[None], axis=2).min(axis=1, initial=np.inf)


def _unit(v: Floats) -> Floats:
    return v / max(float(np.linalg.norm(v)), 1.0)


def _overlaps(a: Floats, b: Floats) -> Bools:
    """Which boxes (A, 4) overlap which boxes (B, 4): (A, B)."""
    return np.all((a[:, None, :2] < b[None, :, 2:]) & (b[None, :, :2] < a[:, None, 2:]), axis=2)


def _contains(boxes: Floats, points: Floats) -> Bools:
    """Which boxes (A, 4) contain which points (P, 2): (A, P)."""
    return np.all((boxes[:, None, :2] <= points[None]) & (points[None] <= boxes[:, None, 2:]), axis=2)


def _cross(a: Floats, b: Floats) -> Bools:
    """Which segments (A, 4) cross which segments (B, 4): (A, B)."""

    def side(p: Floats, q: Floats, r: Floats) -> Floats:
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    p, q = a[:, None, :2], a[:, None, 2:]
    r, s = b[None, :, :2], b[None, :, 2:]
    return (side(p, q, r) * side(p, q, s) < 0) & (side(r, s, p) * side(r, s, q) < 0)


def _hits(lines: Floats, boxes: Floats) -> Bools:
    """Which segments (A, 4) cross a diagonal of which boxes (B, 4): (A, B)."""
    falling = np.stack([boxes[:, 0], boxes[:, 3], boxes[:, 2], boxes[:, 1]], axis=1)
    return _cross(lines, boxes) | _cross(lines, falling)

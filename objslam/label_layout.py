"""Where to write labels in a picture, so that none covers another label or a dot."""

from __future__ import annotations

import numpy as np

from objslam.types import Bools, Floats

_ANGLES = np.linspace(0, 2 * np.pi, 24, endpoint=False)
_RADII = (9.0, 15.0, 24.0, 38.0, 56.0, 80.0, 110.0, 145.0, 185.0)  # px, from the dot to the label's nearest edge
_DOT = 6.0  # px, half the side of the square that a dot keeps free
_PAD = 2.0
_FAR = 14.0  # px
_MISTAKEN = 2.0  # px; nearer to its own dot than to another by less than this, a label is read as the other's
_STRANGE = 60.0  # px of way that a label takes to stand nearer to its own dot than to any other


def place_labels(anchors: Floats, sizes: Floats, frame: Floats, avoid: Floats) -> tuple[Floats, Bools]:
    """The lower left corners (N, 2) of labels of sizes (N, 2) for dots at anchors (N, 2), and which found room (N,); all px.

    Greedy, the most crowded dots first: each label takes the cheapest of a fan of places around its dot that stays in the
    frame (2, 2) (lower left, upper right corner) and covers no dot and no label set before; near is cheaper than far, and
    off the points to avoid (P, 2) cheaper than on them; nearer to another's dot than to its own is dear.
    """
    corners, found = np.zeros((len(anchors), 2)), np.zeros(len(anchors), dtype=bool)
    if len(anchors) == 0:
        return corners, found
    gaps = np.linalg.norm(anchors[:, None] - anchors[None], axis=2)
    crowd = (gaps < 60.0).sum(axis=1)
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
        strange = own >= _nearest(boxes, np.delete(anchors, j, axis=0)) - _MISTAKEN
        cost = reach + _STRANGE * strange + 1.5 * np.minimum(covered, 20) + 60.0 * crossings - 0.05 * outward
        best = int(np.argmin(np.where(free, cost, np.inf)))
        corners[j], found[j] = boxes[best, :2], True
        taken = np.concatenate([taken, boxes[best : best + 1]])
        leaders = np.concatenate([leaders, lines[best : best + 1]])
    return corners, found


def _candidates(anchor: Floats, size: Floats) -> tuple[Floats, Floats]:
    """Boxes (C, 4) x1, y1, x2, y2 around a dot, and how far out each is (C,): right and left first, by a hair."""
    direction = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
    # the box's centre goes out until its nearest edge is a radius away
    boxes, reach = [], []
    for radius in _RADII:
        centre = anchor + direction * (radius + np.abs(direction) @ (size / 2))[:, None]
        boxes.append(np.concatenate([centre - size / 2, centre + size / 2], axis=1))
        reach.append(radius + 2.0 * np.abs(direction[:, 1]) + 1.0 * (direction[:, 0] < -0.1))
    return np.concatenate(boxes), np.concatenate(reach)


def needs_leader(anchors: Floats, corners: Floats, sizes: Floats) -> Bools:
    """Which labels (N,) are so far from their dot, or so near to another's, that a line has to say whose they are."""
    boxes = np.concatenate([corners, corners + sizes], axis=1)
    own = np.linalg.norm(np.clip(anchors, corners, corners + sizes) - anchors, axis=1)
    others = np.array([_nearest(boxes[j : j + 1], np.delete(anchors, j, axis=0))[0] for j in range(len(anchors))])
    return (own > _FAR) | (own >= others.reshape(-1) - _MISTAKEN)


def _nearest(boxes: Floats, points: Floats) -> Floats:
    """How far each box (A, 4) is from the nearest of points (P, 2): (A,), infinite without any."""
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
    """Which segments (A, 4) run through which boxes (B, 4): (A, B), through one of the diagonals."""
    falling = np.stack([boxes[:, 0], boxes[:, 3], boxes[:, 2], boxes[:, 1]], axis=1)
    return _cross(lines, boxes) | _cross(lines, falling)

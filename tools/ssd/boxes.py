"""Default boxes of the SSD: where they lie, how truth is matched to them and encoded on them, and suppression (torch).

Boxes are x1, y1, x2, y2 in px of the network's input, unless a name says `centred` (cx, cy, w, h).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Level:
    """One map of features: its stride, and the sides of its two square default boxes, px; both also come 2:1 and 1:2."""

    stride: int
    small: float
    large: float


LEVELS = (Level(8, 12.0, 19.0), Level(16, 28.0, 42.0), Level(32, 60.0, 90.0))
PER_CELL = 6
VARIANCES = (0.1, 0.2)
"""The divisors of the offsets of the middle, and of those of the logarithm of the size (Liu et al. 2016, the authors'
code)."""
POSITIVE, NEGATIVE = 0.4, 0.3
"""A default box that overlaps a true box by at least the first share has to find it. Below the second share, it is
background."""


def grid(size: tuple[int, int], stride: int) -> tuple[int, int]:
    """Columns and rows of the feature map at a stride, for an input of width and height `size`."""
    return -(-size[0] // stride), -(-size[1] // stride)


def default_boxes(size: tuple[int, int], levels: tuple[Level, ...] = LEVELS) -> Tensor:
    """Centred default boxes (A, 4) for an input of width and height `size`: by level, row, column, then box of the cell."""
    found = []
    for level in levels:
        columns, rows = grid(size, level.stride)
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        middle = (torch.stack([x, y], dim=-1).float() + 0.5) * level.stride
        shapes = torch.tensor([[1.0, 1.0], [2**0.5, 0.5**0.5], [0.5**0.5, 2**0.5]])
        sides = torch.cat([level.small * shapes, level.large * shapes])
        middle = middle[:, :, None].expand(rows, columns, PER_CELL, 2)
        found.append(torch.cat([middle, sides.expand(rows, columns, PER_CELL, 2)], dim=-1).reshape(-1, 4))
    return torch.cat(found)


def corners(centred: Tensor) -> Tensor:
    """Boxes (..., 4) from centred ones (..., 4)."""
    return torch.cat([centred[..., :2] - centred[..., 2:] / 2, centred[..., :2] + centred[..., 2:] / 2], dim=-1)


def encode(boxes: Tensor, defaults: Tensor) -> Tensor:
    """Offsets (A, 4) of boxes (A, 4) from centred default boxes (A, 4)."""
    middle, sides = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    place = (middle - defaults[:, :2]) / defaults[:, 2:] / VARIANCES[0]
    return torch.cat([place, torch.log(sides / defaults[:, 2:]) / VARIANCES[1]], dim=1)


def decode(offsets: Tensor, defaults: Tensor) -> Tensor:
    """Boxes (..., A, 4) of offsets (..., A, 4) from centred default boxes (A, 4): the inverse of `encode`."""
    middle = defaults[:, :2] + offsets[..., :2] * VARIANCES[0] * defaults[:, 2:]
    sides = defaults[:, 2:] * torch.exp(torch.clamp(offsets[..., 2:] * VARIANCES[1], max=4.0))
    return corners(torch.cat([middle, sides], dim=-1))


def overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union (A, B) of boxes (A, 4) and (B, 4)."""
    low = torch.maximum(a[:, None, :2], b[None, :, :2])
    high = torch.minimum(a[:, None, 2:], b[None, :, 2:])
    common = (high - low).clamp(min=0).prod(dim=2)
    areas = (a[:, 2:] - a[:, :2]).prod(dim=1)[:, None] + (b[:, 2:] - b[:, :2]).prod(dim=1)[None]
    return common / (areas - common).clamp(min=1e-9)


def match(defaults: Tensor, boxes: Tensor, labels: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return what each default box has to learn from one image: its class (A,) and its offsets (A, 4).

    defaults: (A, 4) centred. boxes (M, 4), labels (M,), counts (M,) bool as in `Samples`. Class 0 is background, 1 + label
    an object, -1 neither (a box between the two limits, or on an object that does not count). Every object that counts has
    at least the default box that overlaps it most.
    """
    target = torch.zeros(len(defaults), dtype=torch.int64)
    offsets = torch.zeros(len(defaults), 4)
    if len(boxes) == 0:
        return target, offsets
    share = overlap(corners(defaults), boxes)
    best, which = share.max(dim=1)
    closest = share.argmax(dim=0)
    best[closest], which[closest] = 1.0, torch.arange(len(boxes))
    target[best >= NEGATIVE] = -1
    found = (best >= POSITIVE) & counts[which]
    target[found] = 1 + labels[which[found]]
    offsets[found] = encode(boxes[which[found]], defaults[found])
    return target, offsets


def suppress(boxes: Tensor, scores: Tensor, limit: float) -> Tensor:
    """Return the indices of the boxes (M, 4) that stay, best first. No box overlaps a better one that stays by more than
    `limit`."""
    order = scores.argsort(descending=True, stable=True)
    share = overlap(boxes[order], boxes[order]) > limit
    stays = torch.ones(len(order), dtype=torch.bool)
    for i in range(len(order)):
        if stays[i]:
            stays[i + 1 :] &= ~share[i, i + 1 :]
    return order[stays]

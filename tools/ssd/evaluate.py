"""How good boxes are: average precision at IoU 0.5 (all points, PASCAL VOC 2010), and how far the middles are off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ssd.boxes import overlap, suppress
from ssd.data import Samples
from ssd.model import Decoded, Ssd

SCORE, OVERLAP, PER_CLASS = 0.05, 0.45, 50
"""The least score of a box, the largest overlap of two boxes of one class, and the most boxes of a class in an image."""
CANDIDATES = 400
"""The number of boxes of a class in an image that suppression compares, the best ones."""

Boxes = tuple[Tensor, Tensor, Tensor]
"""Boxes (M, 4) px of the network's input, labels (M,), scores (M,) of one image."""


@dataclass(frozen=True)
class Quality:
    """Average precision (C,) of each class; errors (M,) px of the middles of boxes that were found with score >= 0.5.

    found and false: shares of the objects found, and of boxes that are wrong, at that score.
    """

    precision: NDArray[np.float64]
    errors: NDArray[np.float64]
    recall: float
    false: float

    @property
    def mean(self) -> float:
        """mAP."""
        return float(np.nanmean(self.precision))


def select(boxes: Tensor, probabilities: Tensor) -> Boxes:
    """The detections of one image from all its boxes (A, 4) and probabilities (classes, A)."""
    parts = []
    for label, scores in enumerate(probabilities):
        near = (scores > SCORE).nonzero()[:, 0]
        near = near[scores[near].argsort(descending=True, stable=True)[:CANDIDATES]]
        kept = near[suppress(boxes[near], scores[near], OVERLAP)][:PER_CLASS]
        parts.append((boxes[kept], torch.full((len(kept),), label), scores[kept]))
    found = [torch.cat(column) for column in zip(*parts, strict=True)]
    order = found[2].argsort(descending=True, stable=True)
    return found[0][order], found[1][order], found[2][order]


def to_input(images: NDArray[np.uint8]) -> Tensor:
    """Images (B, H, W, 3) as the network takes them."""
    return torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() / 255


@torch.no_grad()
def detect(network: Ssd, images: NDArray[np.uint8], batch: int = 20) -> list[Boxes]:
    """Detections in each of the images (N, H, W, 3)."""
    network.eval()
    decoded = Decoded(network)
    found = []
    for start in range(0, len(images), batch):
        boxes, probabilities = decoded(to_input(images[start : start + batch]))
        found += [select(b, p) for b, p in zip(boxes, probabilities, strict=True)]
    return found


def measure(found: list[Boxes], samples: Samples, classes: int, scale: float = 1.0) -> Quality:
    """Compare detections with the truth; scale: the number of px of the camera's image for one px of the network's, for the
    errors.

    A detection on an object that does not count is neither right nor wrong.
    """
    precision = np.full(classes, np.nan)
    errors: list[float] = []
    right_at_half = wrong_at_half = asked = 0
    truth = [tuple(torch.from_numpy(a) for a in samples.of(i)) for i in range(len(samples))]
    for label in range(classes):
        rows: list[tuple[float, bool]] = []
        objects = 0
        for (boxes, labels, scores), (true, true_label, counts) in zip(found, truth, strict=True):
            mine, theirs = labels == label, true_label == label
            objects += int(counts[theirs].sum())
            for sure, off in _hits(boxes[mine], scores[mine], true[theirs], counts[theirs]):
                if off is None:
                    continue
                rows.append((sure, off >= 0))
                if off >= 0 and sure >= 0.5:
                    errors.append(scale * off)
        asked += objects
        table = np.array(rows, dtype=np.float64).reshape(-1, 2)
        score, right = table[:, 0], table[:, 1] > 0
        right_at_half += int(right[score >= 0.5].sum())
        wrong_at_half += int((~right[score >= 0.5]).sum())
        if objects:
            precision[label] = average_precision(score, right, objects)
    boxes_at_half = max(right_at_half + wrong_at_half, 1)
    return Quality(precision, np.array(errors), right_at_half / max(asked, 1), wrong_at_half / boxes_at_half)


def average_precision(score: NDArray[np.float64], right: NDArray[np.bool_], objects: int) -> float:
    """Return the area under the precision envelope over the recall, for boxes (M,) with a `score` each. right: (M,) whether
    a box finds an object. objects: the number of all."""
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(right[order])
    recall = np.concatenate([[0.0], hits / objects])
    precision = np.maximum.accumulate((hits / np.arange(1, len(hits) + 1))[::-1])[::-1]
    return float((np.diff(recall) * precision).sum())


def _hits(boxes: Tensor, scores: Tensor, true: Tensor, counts: Tensor) -> list[tuple[float, float | None]]:
    """For each box, best first: its score and the distance of the middles (-1: wrong; None: on what does not count)."""
    taken: set[int] = set()
    result: list[tuple[float, float | None]] = []
    share = overlap(boxes, true)
    for i in scores.argsort(descending=True, stable=True).tolist():
        free = [j for j in range(len(true)) if j not in taken and share[i, j] >= 0.5]
        counting = [j for j in free if counts[j]]
        if counting:
            best = max(counting, key=lambda j: float(share[i, j]))
            taken.add(best)
            off = (boxes[i, :2] + boxes[i, 2:] - true[best, :2] - true[best, 2:]) / 2
            result.append((float(scores[i]), float(off.norm())))
        else:
            result.append((float(scores[i]), None if free else -1.0))
    return result

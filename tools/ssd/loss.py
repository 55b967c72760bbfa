"""The loss of the SSD paper: cross entropy over the objects and the hardest background, smooth L1 over the offsets."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

HARD_NEGATIVES = 3
"""The number of background boxes for each box on an object (Liu et al. 2016, section 2.2)."""
NEGATIVES_AT_LEAST = 30
"""The least number of background boxes in an image, so that an image without an object teaches something too."""


def hardest(background_loss: Tensor, target: Tensor) -> Tensor:
    """Which background boxes (B, A) count: in each image the ones with the highest loss, 3 for each box on an object."""
    wanted = (HARD_NEGATIVES * (target > 0).sum(dim=1)).clamp(min=NEGATIVES_AT_LEAST)
    losses = background_loss.masked_fill(target != 0, -1.0)
    rank = losses.argsort(dim=1, descending=True).argsort(dim=1)
    return (rank < wanted[:, None]) & (target == 0)


def ssd_loss(logits: Tensor, offsets: Tensor, target: Tensor, target_offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Loss of the classes and of the boxes, each a sum divided by the number of boxes on objects in the batch.

    logits (B, A, C), offsets (B, A, 4) as the network gives them; target (B, A), target_offsets (B, A, 4) from `match`.
    """
    positive = target > 0
    entropy = functional.cross_entropy(logits.transpose(1, 2), target.clamp(min=0), reduction="none")
    negative = hardest(entropy.detach(), target)
    count = positive.sum().clamp(min=1)
    classes = (entropy * (positive | negative)).sum() / count
    boxes = functional.smooth_l1_loss(offsets[positive], target_offsets[positive], beta=0.5, reduction="sum") / count
    return classes, boxes


def batch_targets(pairs: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Stack what `match` gave for each image of a batch."""
    return torch.stack([target for target, _ in pairs]), torch.stack([offsets for _, offsets in pairs])

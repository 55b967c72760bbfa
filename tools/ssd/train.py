"""Training: random flips, zooms and colours of rendered images, AdamW with one cosine, a checkpoint after every round."""

from __future__ import annotations

import math
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from objslam.simulation.shapes import LABELS
from ssd.boxes import match
from ssd.data import RAW_SCALE, SIZE, Samples, load_samples, shard_files
from ssd.evaluate import detect, measure, to_input
from ssd.loss import batch_targets, ssd_loss
from ssd.model import Ssd

BATCH = 16
ROUND = 150
"""The number of steps between two checkpoints."""
WARM_UP = 150
RATE = 2e-3
CHECKED = 160
"""The number of held-out images on which the model is measured after a round. At the end, it is all of them."""

Sample = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64], NDArray[np.bool_]]


def augment(
    image: NDArray[np.uint8],
    boxes: NDArray[np.float32],
    label: NDArray[np.int64],
    counts: NDArray[np.bool_],
    rng: np.random.Generator,
) -> Sample:
    """Flip, zoom and shift an image (H, W, 3) and its boxes, and change its colours; boxes cut in half no longer count."""
    height, width = image.shape[:2]
    zoom = float(np.exp(rng.uniform(-0.25, 0.3)))
    spare = np.array([width, height]) * (1 - zoom)
    shift = rng.uniform(np.minimum(spare, 0), np.maximum(spare, 0))
    flip = bool(rng.random() < 0.5)
    sign, start = (-1.0, width - 1 - shift[0]) if flip else (1.0, shift[0])
    place = np.array([[sign * zoom, 0.0, start], [0.0, zoom, shift[1]]])
    grey = tuple(int(v) for v in rng.integers(0, 256, 3))
    moved_image = cv2.warpAffine(image, place, (width, height), borderMode=cv2.BORDER_CONSTANT, borderValue=grey)
    # a pixel's middle goes from x to zoom * x + shift; its edges, where boxes end, lie half a pixel to either side of it
    moved = (boxes - 0.5) * np.float32(zoom) + np.tile(shift, 2).astype(np.float32) + 0.5
    if flip:
        moved = np.column_stack([width - moved[:, 2], moved[:, 1], width - moved[:, 0], moved[:, 3]])
    limit = np.tile(np.array([width, height], dtype=np.float32), 2)
    inside = np.clip(moved, 0, limit).astype(np.float32)
    sides, full = inside[:, 2:] - inside[:, :2], moved[:, 2:] - moved[:, :2]
    left = (sides > 2).all(axis=1)
    whole = (sides.prod(axis=1) >= 0.6 * full.prod(axis=1)) & (sides.max(axis=1) >= 8) & (sides.min(axis=1) >= 4)
    tones = np.linspace(0, 1, 256)[:, None] ** np.exp(rng.normal(0, 0.2)) * np.exp(
        rng.normal(0, 0.15) + rng.normal(0, 0.05, 3)
    )
    table = np.clip(tones * 255 + rng.normal(0, 6), 0, 255).astype(np.uint8)
    coloured = cv2.LUT(moved_image, table.reshape(256, 1, 3))
    return np.asarray(coloured, dtype=np.uint8), inside[left], label[left], counts[left] & whole[left]


def batch_of(samples: Samples, network: Ssd, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """A random batch: images (B, 3, H, W), target classes (B, A) and offsets (B, A, 4)."""
    images, targets = [], []
    for number in rng.integers(len(samples), size=BATCH):
        image, boxes, label, counts = augment(samples.images[number], *samples.of(int(number)), rng)
        images.append(image)
        truth = (torch.from_numpy(np.ascontiguousarray(a)) for a in (boxes, label, counts))
        targets.append(match(network.defaults, *truth))
    return to_input(np.stack(images)), *batch_targets(targets)


def rate_at(step: int, steps: int) -> float:
    """The learning rate: a short rise, then half a cosine down to a hundredth."""
    if step < WARM_UP:
        return RATE * (step + 1) / WARM_UP
    share = (step - WARM_UP) / max(steps - WARM_UP, 1)
    return RATE * (0.01 + 0.99 * (0.5 + 0.5 * math.cos(math.pi * min(share, 1.0))))


def train(data: Path, out: Path, steps: int, seed: int) -> Ssd:
    """Train for `steps` steps, from the checkpoint in `out` if there is one. The log goes to stdout.

    The batches of a round depend only on the seed and on the round. So a run that was stopped and continued gives the same
    network, if the images in `data` are the same. New images there are used from the next round on.
    """
    held_out = load_samples(data, "held_out")
    shards = 0
    torch.manual_seed(seed)
    network = Ssd(len(LABELS), SIZE).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    decay = [p for p in network.parameters() if p.ndim > 1]
    rest = [p for p in network.parameters() if p.ndim <= 1]
    optimiser = torch.optim.AdamW([{"params": decay, "weight_decay": 0.02}, {"params": rest, "weight_decay": 0.0}], lr=RATE)
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = out / "checkpoint.pt"
    done = 0
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        done = state["step"]
    print(f"{sum(p.numel() for p in network.parameters())} parameters, from step {done}", flush=True)
    while done < steps:
        there = len(shard_files(data, "train"))
        if there > shards:
            samples, shards = load_samples(data, "train"), there
            print(f"{len(samples)} images to learn from, {len(held_out)} held out", flush=True)
        rng = np.random.default_rng([seed, done])
        started, sums = time.perf_counter(), np.zeros(2)
        network.train()
        for step in range(done, min(done + ROUND, steps)):
            for group in optimiser.param_groups:
                group["lr"] = rate_at(step, steps)
            images, target, target_offsets = batch_of(samples, network, rng)
            with torch.autocast("cpu", dtype=torch.bfloat16):
                logits, offsets = network(images.contiguous(memory_format=torch.channels_last))
            classes, boxes = ssd_loss(logits.float(), offsets.float(), target, target_offsets)
            optimiser.zero_grad(set_to_none=True)
            (classes + boxes).backward()
            nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimiser.step()
            sums += [classes.item(), boxes.item()]
        count = min(ROUND, steps - done)
        done += count
        took = time.perf_counter() - started
        part = _first(held_out, CHECKED if done < steps else len(held_out))
        quality = measure(detect(network, part.images), part, len(LABELS), RAW_SCALE)
        state = {"network": network.state_dict(), "optimiser": optimiser.state_dict(), "step": done}
        torch.save(state, checkpoint.with_suffix(".part"))
        checkpoint.with_suffix(".part").rename(checkpoint)
        middle = float(np.median(quality.errors)) if len(quality.errors) else math.nan
        print(
            f"step {done}/{steps} classes {sums[0] / count:.3f} boxes {sums[1] / count:.3f} mAP {quality.mean:.3f} "
            f"lowest {np.nanmin(quality.precision):.3f} recall {quality.recall:.3f} false {quality.false:.3f} "
            f"middle {middle:.2f} px, {took / count / BATCH * 1000:.1f} ms an image",
            flush=True,
        )
    return network


def _first(samples: Samples, count: int) -> Samples:
    end = int(np.searchsorted(samples.image, count))
    return Samples(
        samples.images[:count], samples.image[:end], samples.boxes[:end], samples.label[:end], samples.counts[:end]
    )

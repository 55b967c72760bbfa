"""The network: a small residual backbone, features passed down from coarse to fine, and a head at each of three strides."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ssd.boxes import LEVELS, PER_CELL, decode, default_boxes


def _conv(into: int, out: int, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(into, out, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(out), nn.ReLU())


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = _conv(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


class Ssd(nn.Module):
    """Images (B, 3, H, W), RGB in [0, 1], to class logits (B, A, 1 + classes) and offsets (B, A, 4) of the default boxes."""

    defaults: Tensor

    def __init__(self, classes: int, size: tuple[int, int], width: int = 64) -> None:
        super().__init__()
        self.classes = classes
        self.size = size
        self.stem = nn.Sequential(_conv(3, 16, 2), _conv(16, 32, 2), _Residual(32))
        self.stages = nn.ModuleList(
            [
                nn.Sequential(_conv(32, 64, 2), _Residual(64), _Residual(64)),
                nn.Sequential(_conv(64, 96, 2), _Residual(96), _Residual(96)),
                nn.Sequential(_conv(96, 128, 2), _Residual(128)),
            ]
        )
        self.lateral = nn.ModuleList([_conv(channels, width, kernel=1) for channels in (64, 96, 128)])
        self.heads = nn.ModuleList(
            [nn.Sequential(_conv(width, width), nn.Conv2d(width, PER_CELL * (5 + classes), 3, 1, 1)) for _ in LEVELS]
        )
        for head in self.heads:
            bias = head.get_parameter("1.bias").data.view(PER_CELL, 5 + classes)
            bias.zero_()
            bias[:, 0] = 4.0  # nearly all default boxes are background: start from there
        self.register_buffer("defaults", default_boxes(size), persistent=False)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        x = self.stem((images - 0.45) * 4.0)
        maps = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        passed: Any = None
        outputs: list[Tensor] = []
        for lateral, head, features in reversed(list(zip(self.lateral, self.heads, maps, strict=True))):
            mine = lateral(features)
            if passed is not None:
                mine = mine + functional.interpolate(passed, size=mine.shape[-2:], mode="nearest")
            passed = mine
            out = head(mine).permute(0, 2, 3, 1)
            outputs.insert(0, out.reshape(out.shape[0], -1, 5 + self.classes))
        joined = torch.cat(outputs, dim=1)
        return joined[..., : 1 + self.classes], joined[..., 1 + self.classes :]


class Decoded(nn.Module):
    """The network with boxes (B, A, 4), px, and class probabilities without background (B, classes, A) for outputs."""

    def __init__(self, network: Ssd) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        logits, offsets = self.network(images)
        probabilities = logits.softmax(dim=2)[..., 1:].transpose(1, 2)
        return decode(offsets, self.network.defaults), probabilities

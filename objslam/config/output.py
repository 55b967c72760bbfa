"""The settings of what a run writes: the surface of the room, the recording, the picture."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from objslam.config.section import Device, Positive, Section


class Reconstruction(Section):
    """The surface of the room, from depth images fused at the solved poses."""

    use: bool = True
    """whether there is one where the log has depth images."""
    before: bool = False
    """also one at the poses as the log brought them, to compare."""
    cloud: bool = False
    """also its points alone, with normals, in a file of their own."""
    device: Device = "auto"
    voxel: Positive = 0.02
    """m; the size of a voxel."""
    truncation: Positive = 0.06
    """m; distance from a surface within which depths are averaged: more than their error, less than things are thick, and at
    least 2 voxels."""
    max_depth: Positive = 4.0
    """m; depths beyond it are not used."""
    min_views: Annotated[int, Field(ge=1)] = 3
    """depth images that must have seen a surface before it counts."""
    stride: Annotated[int, Field(ge=1)] = 1
    """one depth image in this many is used."""
    max_frames: Annotated[int, Field(ge=1, le=65535)] = 1000
    """depth images at the most; of more, some are left out evenly."""
    max_blocks: Annotated[int, Field(ge=2048)] = 80_000
    """blocks of 6^3 voxels that the grid grows to at the most, at 4.3 kB each."""


class Output(Section):
    """What a run writes."""

    recording: bool = True
    images: Annotated[int, Field(ge=0)] = 1000
    """images of each camera in the recording at the most, evenly spread; 0: none."""
    image_width: Annotated[int, Field(ge=16)] = 480
    """px; in the recording wider images are made smaller, by a whole number."""
    picture: bool = True

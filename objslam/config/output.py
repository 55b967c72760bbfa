"""The settings of the outputs of a run: surface reconstruction, recording and picture."""

from typing import Annotated

from pydantic import Field

from objslam.config.section import Count, Device, Positive, Section


class Reconstruction(Section):
    """Configure the surface of the room, which is fused from depth images at the estimated poses."""

    use: bool = True
    """Reconstruct the surface if the log has depth images."""
    before: bool = False
    """Also reconstruct the surface at the poses of the log, for comparison."""
    cloud: bool = False
    """Also write the points of the surface with normals to a separate file."""
    device: Device = "auto"
    voxel: Positive = 0.02
    """Edge length of a voxel in m."""
    truncation: Positive = 0.06
    """Distance in m from a surface within which depths are averaged. It must exceed the depth error, be below the thickness
    of things, and be at least 2 voxels."""
    max_depth: Positive = 4.0
    """Maximum depth in m. Larger depths are ignored."""
    min_views: Count = 3
    """Minimum number of depth images that show a surface before the surface is kept."""
    stride: Count = 1
    """Step between the depth images that are used. 1 uses every depth image."""
    max_frames: Annotated[int, Field(ge=1, le=65535)] = 1000
    """Maximum number of depth images. Above it, some images are skipped evenly."""
    max_blocks: Annotated[int, Field(ge=2048)] = 80_000
    """Maximum number of blocks of 6^3 voxels in the grid. A block takes 4.3 kB."""


class Output(Section):
    """Configure the files that a run writes."""

    recording: bool = True
    images: Annotated[int, Field(ge=0)] = 1000
    """Maximum number of images of each camera in the recording, evenly spread. 0 records no images."""
    image_width: Annotated[int, Field(ge=16)] = 480
    """Maximum width in px of an image in the recording. A wider image is reduced by an integer factor."""
    picture: bool = True

"""Read and write views.parquet, the camera poses of all images of a result, including images without a box."""

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import Keyframes
from objslam.core.validity import rigid_poses, valid_stamps
from objslam.errors import LogError, OutputError
from objslam.io.camera_yaml import dump_camera, parse_camera

_CAMERAS, _MARGINS = b"objslam.cameras", b"objslam.margins"  # The keys of the cameras and the margins in the file's header.
_IGNORED = b"objslam.ignored_labels"  # The key of a JSON list. Older files lack it.
_BETWEEN = "\n---\n"  # The line between the YAML texts of two cameras.


@dataclass(frozen=True)
class Views:
    """F camera frames in the order of time.

    stamps: (F,) s, on the clock of the poses. frame_stamps: (F,) s, as in the log, before any correction of a clock. camera:
    (F,) index into `cameras`. map_T_camera: (F, 4, 4) pose of the camera. margin: the setting `rays.border` of the run, px.
    margin_share: the setting `rays.border_share` of the run. ignored: the setting `rays.ignore_labels` of the run. The
    frames say nothing about objects with such a label.
    """

    stamps: Floats
    frame_stamps: Floats
    camera: Ints
    map_T_camera: Floats
    cameras: tuple[Camera, ...]
    margin: float
    margin_share: float
    ignored: tuple[str, ...] = ()

    @classmethod
    def of(cls, frames: Keyframes, cameras: tuple[Camera, ...], settings: Settings) -> Self:
        """Return the views of `frames`. settings: those of the run."""
        rays = settings.rays
        told = rays.border, rays.border_share, rays.ignore_labels
        return cls(frames.stamps, frames.frame_stamps, frames.camera, frames.map_T_camera, cameras, *told)


def dump_views(views: Views) -> bytes:
    """Return the content of views.parquet. Each frame is one row, and the header has the calibrations and the margins."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    pose = pa.FixedSizeListArray.from_arrays(pa.array(views.map_T_camera.reshape(-1)), 16)
    stamps = {"stamp": views.stamps, "frame_stamp": views.frame_stamps}
    table = pa.table({**stamps, "camera": views.camera, "map_T_camera": pose})
    cameras = _BETWEEN.join(dump_camera(camera) for camera in views.cameras)
    margins = f"{float(views.margin)!r} {float(views.margin_share)!r}"
    buffer = io.BytesIO()
    header = {_CAMERAS: cameras.encode(), _MARGINS: margins.encode(), _IGNORED: json.dumps(views.ignored).encode()}
    pq.write_table(table.replace_schema_metadata(header), buffer)
    return buffer.getvalue()


def read_views(file: Path) -> Views:
    """Read a views.parquet. Raises OutputError for any other content."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(file, partitioning=None)
        header = table.schema.metadata or {}
        texts = header[_CAMERAS].decode().split(_BETWEEN)
        cameras = tuple(parse_camera(text.encode(), str(file), Ledger(), None) for text in texts)
        margin, share = (float(word) for word in header[_MARGINS].decode().split())
        ignored = json.loads(header.get(_IGNORED, b"[]"))
        if not isinstance(ignored, list) or not all(isinstance(label, str) for label in ignored):
            raise ValueError("the ignored labels are not a list of texts")
        stamps = np.asarray(table["stamp"].to_numpy(), dtype=np.float64)
        own = "frame_stamp" if "frame_stamp" in table.column_names else "stamp"  # Older files have one column.
        frame_stamps = np.asarray(table[own].to_numpy(), dtype=np.float64)
        camera = np.asarray(table["camera"].to_numpy(), dtype=np.int64)
        flat = np.asarray(table["map_T_camera"].combine_chunks().flatten().to_numpy(zero_copy_only=False), dtype=np.float64)
        poses, rigid = rigid_poses(flat.reshape(len(stamps), 4, 4))
        if not (rigid.all() and valid_stamps(np.append(stamps, frame_stamps)).all() and np.isfinite([margin, share]).all()):
            raise ValueError("a pose, a stamp or a margin is not valid")
        if len(camera) and not 0 <= camera.min() <= camera.max() < len(cameras):
            raise ValueError("a frame names a camera that is not in the file")
    except (OSError, pa.ArrowException, AttributeError, KeyError, ValueError, TypeError, RecursionError, LogError) as error:
        raise OutputError(f"not what a run writes: {str(error).splitlines()[0][:100]}", where=str(file)) from error
    return Views(stamps, frame_stamps, camera, poses, cameras, margin, share, tuple(ignored))

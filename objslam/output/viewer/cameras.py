"""Cameras in a recording: moving frusta, images, boxes, and the objects of the map projected into the images."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera, in_view
from objslam.core.geometry import inverse
from objslam.core.object_map import ObjectMap
from objslam.core.result import RunResult
from objslam.output.plot.style import captions, ray_kinds
from objslam.output.viewer.images import choose_images, jpegs
from objslam.output.viewer.objects import colours
from objslam.output.viewer.paths import send_poses
from objslam.output.viewer.rays import RAY_COLOURS, kind_colours
from objslam.output.viewer.times import moments, stamp_column
from objslam.output.viewer.view_point import label_rows

_BLOCK = 500_000  # The number of pairs of an object and an image tested at once. A larger value takes more memory.
_NEAR = 0.2  # The least distance, m, at which a camera is expected to see an object.
_BEYOND = 1.2  # The largest distance at which an object is expected in view, as a multiple of its longest used ray.
_LIGHTER = 0.35  # The share of white, in [0, 1], mixed into colours for images. The colours are made for white pages.
_FRUSTUM = 0.05  # The depth of a frustum, as a share of the map's size.


def camera_path(camera: Camera) -> str:
    """Return the path of the entity of a camera in the recording."""
    return str(rr.new_entity_path(["map", "camera", camera.name])).lstrip("/")


def log_cameras(recording: Any, result: RunResult, size: float) -> int:
    """Log each camera as an entity that moves with the robot, `map/camera/NAME`. Return the number of unreadable images.

    Below this entity, `image` has the images, `boxes` has the boxes in the colours of their objects, and `map` has the
    projected objects. Images and all pixel coordinates are scaled down to the width `output.image_width`. size: the size of
    the map, m, which determines the depth of the frusta.
    """
    unread = 0
    map_T_camera = result.map_T_base @ result.keyframes.base_T_camera
    for index, camera in enumerate(result.cameras):
        mine = np.flatnonzero(result.keyframes.camera == index)
        if len(mine) == 0:
            continue
        images = result.images[index] if index < len(result.images) else None
        # Scaling by a whole number is fast, and each pixel is the mean of whole pixels.
        scale = 1 / np.ceil(camera.width / result.settings.output.image_width) if images is not None else 1.0
        path = camera_path(camera)
        log_pinhole(recording, path, camera, scale, size)
        stamps, poses = result.keyframes.stamps[mine], map_T_camera[mine]
        send_poses(recording, path, stamps, poses)
        if images is not None:
            shown, which = choose_images(images, stamps, result.settings.output.images)
            shape = (round(camera.width * scale), round(camera.height * scale))
            unread += _send_images(recording, path, stamps, shown, jpegs(images, which, *shape))
        _send_boxes(recording, path, result, mine, scale)
        _send_objects(recording, path, result, camera, stamps, poses, scale)
    return unread


def log_pinhole(recording: Any, path: str, camera: Camera, scale: float, size: float) -> None:
    """Log the static frustum of a camera. scale: the factor on pixel coordinates. size: the size of the map, m."""
    matrix = np.diag([scale, scale, 1.0]) @ camera.matrix
    pinhole = rr.Pinhole(
        image_from_camera=matrix,
        resolution=[camera.width * scale, camera.height * scale],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_FRUSTUM * size,
        color=RAY_COLOURS["used"],
        line_width=-1.5,  # A negative width is in points on the screen.
    )
    recording.log(path, pinhole, static=True)


def _send_images(recording: Any, path: str, stamps: Floats, shown: Ints, images: Iterator[bytes | None]) -> int:
    """Send an image for each stamp with an index in `shown` (n,), and return the number of unreadable images.

    All other stamps get an empty image, because an older image would not fit their boxes.
    """
    blobs, counts = [], np.zeros(len(stamps), dtype=np.int64)
    for place, blob in zip(shown.tolist(), images, strict=True):
        if blob is not None:
            blobs.append(blob)
            counts[place] = 1
    if blobs:
        columns = rr.EncodedImage.columns(blob=blobs).partition(counts)
        recording.send_columns(f"{path}/image", [stamp_column(stamps)], columns)
        recording.log(f"{path}/image", rr.EncodedImage.from_fields(media_type="image/jpeg"), static=True)
    return len(shown) - len(blobs)


def _send_boxes(recording: Any, path: str, result: RunResult, mine: Ints, scale: float) -> None:
    number = np.full(len(result.keyframes), -1)
    number[mine] = np.arange(len(mine))
    rays = np.flatnonzero(number[result.rays.keyframe] >= 0)
    stamps, counts, order = moments(result.keyframes.stamps[mine], number[result.rays.keyframe[rays]])
    rays = rays[order]
    low, high = np.split(scale * result.rays.box[rays], 2, axis=1)
    columns = rr.Boxes2D.columns(centers=(low + high) / 2, half_sizes=(high - low) / 2, colors=box_colours(result)[rays])
    recording.send_columns(f"{path}/boxes", [stamp_column(stamps)], columns.partition(counts))
    recording.log(f"{path}/boxes", rr.Boxes2D.from_fields(radii=rr.Radius.ui_points(1.5)), static=True)


def box_colours(result: RunResult) -> NDArray[np.uint8]:
    """Return the colour (R, 3), RGB, of each box: its object's light colour, red if rejected, or grey if unexplained."""
    colour, used = kind_colours(result), ray_kinds(result)["used"]
    colour[used] = light_colours(result.map)[result.association.object[used]]
    return colour


def light_colours(objects: ObjectMap) -> NDArray[np.uint8]:
    """Return the colour (N, 3), RGB, of each object, lightened so that it stands out on images."""
    light = [[round(c + _LIGHTER * (255 - c)) for c in colour] for colour in colours(objects)]
    return np.array(light, dtype=np.uint8).reshape(-1, 3)


def _send_objects(
    recording: Any, path: str, result: RunResult, camera: Camera, stamps: Floats, poses: Floats, scale: float
) -> None:
    """Send, for each stamp, the resolved objects that are in view, `PATH/map`, and their labels, `PATH/map/labels`."""
    resolved = [i for i, o in enumerate(result.map.objects) if o.status == "ok"]
    if not resolved:
        return
    used = np.flatnonzero(ray_kinds(result)["used"])
    index = result.association.object[used]
    positions = np.stack([o.position for o in result.map.objects])
    reach = np.zeros(len(positions))
    np.fmax.at(reach, index, np.linalg.norm(positions[index] - result.origins[used], axis=1))
    frame, seen, pixels = points_in_frames(camera, poses, positions[resolved], _BEYOND * reach[resolved])
    pixels *= scale
    names = np.array(captions(result.map), dtype=object)[resolved]
    palette = light_colours(result.map)[resolved]
    at = [stamp_column(stamps)]
    dots = rr.Points2D.columns(positions=pixels, colors=palette[seen])
    recording.send_columns(f"{path}/map", at, dots.partition(np.bincount(frame, minlength=len(stamps))))
    recording.log(f"{path}/map", rr.Points2D.from_fields(radii=rr.Radius.ui_points(4)), static=True)
    widths = np.array([len(name) for name in names])
    hung, shown = label_rows(frame, pixels, widths[seen], (scale * camera.width, scale * camera.height))
    frame, seen, hung = frame[shown], seen[shown], hung[shown]
    labels = rr.Points2D.columns(positions=hung, colors=palette[seen], labels=names[seen].tolist())
    recording.send_columns(f"{path}/map/labels", at, labels.partition(np.bincount(frame, minlength=len(stamps))))
    points = rr.Points2D.from_fields(radii=rr.Radius.ui_points(0), show_labels=True)
    recording.log(f"{path}/map/labels", points, static=True)


def points_in_frames(camera: Camera, map_T_camera: Floats, points: Floats, farthest: Floats) -> tuple[Ints, Ints, Floats]:
    """Project points (N, 3) in map, m, into images at the camera poses (K, 4, 4), and return the points that are in view.

    Args:
        farthest: (N,) m, the distance up to which a camera is expected to see each point.
    Returns:
        For each view of a point: the index of the pose (S,), the index of the point (S,), and the raw pixel (S, 2).
    """
    cos = np.cos(camera.view_angle)
    found: list[tuple[Ints, Ints, Floats]] = []
    step = max(1, _BLOCK // max(len(points), 1))
    for begin in range(0, len(map_T_camera), step):
        to = inverse(map_T_camera[begin : begin + step])
        local = np.einsum("kij,nj->kni", to[:, :3, :3], points) + to[:, None, :3, 3]
        distance, ahead = np.linalg.norm(local, axis=2), local[..., 2]
        pose, point = np.nonzero((distance > _NEAR) & (ahead >= cos * distance) & (distance <= farthest))
        inside, pixels = in_view(camera, local[pose, point])
        found.append((pose[inside] + begin, point[inside], pixels))
    pose, point, pixels = (np.concatenate(c) for c in zip(*found, strict=True))
    return pose, point, pixels

"""Scenes for association: simulated drives with the truth beside, and rays made by hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from objslam.association.global_association import associate_globally
from objslam.association.observations import PosedRays
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2, widest_angle
from objslam.core.ground.flattening import LEVEL
from objslam.core.types import Association, Keyframes, Rays
from objslam.evaluation.alignment import match_points
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.simulation import DriveSettings, make_camera, simulate
from objslam.triangulation.triangulate import triangulate


@dataclass(frozen=True)
class Scene:
    """What association gets, and the truth: whose (R,) each ray is (-1 nobody's; moving objects come after the standing
    ones), points (N, 3) and their label (N,) index into the rays' label_names."""

    keyframes: Keyframes
    rays: Rays
    cameras: tuple[Camera, ...]
    whose: Ints
    points: Floats
    label: Ints

    def associate(self, settings: Settings | None = None, **changes: Any) -> Association:
        rays = changes.pop("rays", self.rays)
        keyframes = changes.pop("keyframes", self.keyframes)
        posed = PosedRays(
            rays,
            keyframes,
            self.cameras,
            changes.pop("map_T_camera", keyframes.map_T_camera),
            changes.pop("sigma", rays.sigma),
            changes.pop("position_sigma", 0.0),
            changes.pop("flat_scale", LEVEL),
        )
        return associate_globally(posed, settings or Settings(), **changes)

    def well_seen(self) -> Bools:
        """(N,) the objects that 10 rays see under 10 degrees of parallax."""
        _, directions = self.rays.in_map(self.keyframes.map_T_camera)
        mine = [directions[self.whose == i] for i in range(len(self.points))]
        return np.array([len(d) >= 10 and widest_angle(d) >= np.radians(10) for d in mine])

    def place(self, association: Association) -> Floats:
        """Positions (M, 3) of the associated objects by Eq. 1."""
        origins, directions = self.rays.in_map(self.keyframes.map_T_camera)
        settings = Settings().triangulation
        return triangulate(origins, directions, association.object, association.count, self.rays.sigma, settings).positions

    def compare(self, association: Association, radius: float = 0.5) -> tuple[Ints, Ints, Floats]:
        """Matched objects and points, and their errors, m."""
        positions = self.place(association)
        found, true = match_points(positions, self.points, association.label[:, None] == self.label, radius)
        return found, true, np.linalg.norm(positions[found] - self.points[true], axis=1)


def drive(settings: DriveSettings, seed: int, pixel_sigma: float = 3.0) -> Scene:
    """A simulated drive without identities."""
    log = simulate(settings.model_copy(update={"tracks": "perfect"}), seed)
    chosen = Settings.model_validate({"rays": {"pixel_sigma": pixel_sigma}})
    keyframes = build_keyframes(log, chosen, Ledger())
    rays = build_rays(log, keyframes, chosen, Ledger())
    assert log.truth is not None
    return Scene(
        keyframes=keyframes,
        rays=replace(rays, track_id=np.full(len(rays), -1)),
        cameras=tuple(c.camera for c in log.cameras),
        whose=rays.track_id,
        points=np.array([o.position for o in log.truth.objects]),
        label=np.array([rays.label_names.index(o.label) for o in log.truth.objects]),
    )


def watch(
    points: Floats,
    map_T_base: Floats,
    *,
    label: Ints | None = None,
    names: tuple[str, ...] = ("cup",),
    missed: float = 0.0,
    pixel_sigma: float = 1.0,
    size: float = 0.1,
    seed: int = 0,
) -> Scene:
    """What a camera on poses (K, 4, 4) sees of points (N, 3), without any false box; size m of the objects."""
    rng = np.random.default_rng(seed)
    camera, count = make_camera(), len(map_T_base)
    label = np.zeros(len(points), dtype=np.int64) if label is None else label
    keyframes = Keyframes(
        stamps=np.arange(count) * 0.2,
        camera=np.zeros(count, dtype=np.int64),
        frame=np.arange(count),
        base_T_camera=np.broadcast_to(camera.base_T_camera, (count, 4, 4)).copy(),
        map_T_base=map_T_base,
        localized_every=1.0,
    )
    to_camera = inverse(keyframes.map_T_camera)
    local = np.einsum("kij,nj->kni", to_camera[:, :3, :3], points) + to_camera[:, None, :3, 3]
    frame, whose = np.nonzero((local[..., 2] > 0.3) & (rng.random(local.shape[:2]) >= missed))
    local = local[frame, whose]
    pixel = project(camera, local) + pixel_sigma * rng.standard_normal((len(frame), 2))
    half = camera.focal * size / local[:, 2:] / 2
    inside = ((pixel - half > 0) & (pixel + half < [camera.width - 1, camera.height - 1])).all(axis=1)
    boxes = np.column_stack([pixel - half, pixel + half])[inside]
    return Scene(
        keyframes,
        rays_of_boxes(frame[inside], boxes, label[whose[inside]], camera, names, pixel_sigma),
        (camera,),
        whose[inside],
        points,
        label,
    )


def passed_row(pixel_sigma: float) -> tuple[Scene, Floats]:
    """Return a row of ten equal posts that a robot passes, and the true distances (R,) m. Bushes hide the posts from most
    directions."""
    posts = np.column_stack([5.0 * np.arange(10), np.full(10, 1.5), np.full(10, 0.5)])
    poses = lift_se2(np.column_stack([np.linspace(-6.0, 44.0, 200), np.zeros((200, 2))]))
    scene = watch(posts, poses, pixel_sigma=pixel_sigma)
    ahead, aside = (posts[scene.whose, :2] - poses[scene.rays.keyframe, :2, 3]).T
    seen = np.flatnonzero(abs(np.degrees(np.arctan2(aside, ahead)) - 20.0) < 5.0)
    scene = replace(scene, rays=scene.rays.take(seen), whose=scene.whose[seen])
    cameras = scene.keyframes.map_T_camera[scene.rays.keyframe, :3, 3]
    return scene, np.linalg.norm(posts[scene.whose] - cameras, axis=1)


def rays_of_boxes(
    frame: Ints, boxes: Floats, label: Ints, camera: Camera, names: tuple[str, ...], pixel_sigma: float = 1.0
) -> Rays:
    """Rays of boxes (R, 4) px of an undistorted camera."""
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    direction = np.column_stack([centre, np.ones(len(boxes))]) @ np.linalg.inv(camera.matrix).T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    nothing = np.full(len(boxes), np.nan)
    return Rays(
        keyframe=frame,
        direction=direction,
        sigma=pixel_sigma / camera.focal * direction[:, 2] ** 1.5,
        range=nothing,
        range_sigma=nothing,
        range_bias=nothing,
        label=label,
        score=np.full(len(boxes), 0.9),
        box=boxes,
        track_id=np.full(len(boxes), -1),
        label_names=names,
    )


def join(*parts: Rays) -> Rays:
    """Rays of several sources, by frame."""
    order = np.argsort(np.concatenate([p.keyframe for p in parts]), kind="stable")
    columns = {
        name: np.concatenate([getattr(p, name) for p in parts])[order]
        for name in (
            "keyframe",
            "direction",
            "sigma",
            "range",
            "range_sigma",
            "range_bias",
            "label",
            "score",
            "box",
            "track_id",
        )
    }
    return Rays(**columns, label_names=parts[0].label_names)

"""Join the images of one stamp into one multiframe: one pose in the graph, with rays from several camera centres.

Together the cameras are one generalised camera (Pless 2003, Using many cameras as one), with the frame of the first image's
camera. So a rig adds one pose and one motion for each stamp, however many cameras it has.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import inverse
from objslam.core.types import Keyframes, Rays

TOGETHER = 0.01
"""The longest time (s) between the logged stamps of the first image and any other image of a multiframe. Within this time,
the odometry is assumed exact: at 1 m/s it errs by less than a millimetre. A longer time joins more images and has larger
errors. This time is well above the jitter of cameras with a common trigger."""


@dataclass(frozen=True)
class Multiframes:
    """The keyframes (images) that share a pose.

    number: (K,) the multiframe of each keyframe, non-decreasing from 0. first: (P,) the first keyframe of each multiframe.
    """

    number: Ints
    first: Ints

    @classmethod
    def of(cls, keyframes: Keyframes) -> Self:
        """Join keyframes of different cameras whose stamps, as logged, agree within `TOGETHER`.

        A motion that the odometry did not measure separates two multiframes.
        """
        apart = ~keyframes.measured if keyframes.odom_T_base is not None else np.zeros(max(len(keyframes) - 1, 0), bool)
        first: list[int] = []
        cameras: set[int] = set()
        begin, number = -np.inf, np.zeros(len(keyframes), dtype=np.int64)
        columns = (keyframes.stamps.tolist(), keyframes.camera.tolist(), [True, *apart.tolist()])
        for k, (stamp, camera, alone) in enumerate(zip(*columns, strict=True)):
            if alone or camera in cameras or not 0 <= stamp - begin <= TOGETHER:
                first.append(k)
                cameras, begin = set(), stamp
            cameras.add(camera)
            number[k] = len(first) - 1
        return cls(number, np.array(first, dtype=np.int64))

    @classmethod
    def single(cls, count: int) -> Self:
        """Give each of `count` keyframes its own pose."""
        return cls(np.arange(count), np.arange(count))

    def keyframes(self, images: Keyframes) -> Keyframes:
        """Return the first keyframe of each of the P multiframes, from K images.

        The clocks of the images may have been corrected after the images were joined. One measurement of the absolute pose
        is shared by fewer multiframes than images, so `localized_every` is smaller.
        """
        if len(self.first) == len(images):
            return images
        shared = images.localized_every * len(self.first) / len(images)
        return replace(images.take(self.first), localized_every=max(shared, 1.0) if images.localized_every else 0.0)

    def rays(self, images: Keyframes, rays: Rays) -> Rays:
        """Return the rays of images as the rays of the multiframes, in the frame of the first camera."""
        if len(self.first) == len(images):
            return rays
        offset, direction = rays.in_map(self.first_T_camera(images))
        return replace(rays, keyframe=self.number[rays.keyframe], direction=direction, offset=offset)

    def first_T_camera(self, images: Keyframes) -> Floats:
        """Return the poses (K, 4, 4) of the cameras of images in the frame of the first camera of their multiframe."""
        path_T_camera = _path(images) @ images.base_T_camera
        poses = inverse(path_T_camera[self.first])[self.number] @ path_T_camera
        own = self.first[self.number] == np.arange(len(images))
        poses[own] = np.eye(4)  # With rounding errors here, all rays would get an offset.
        return np.asarray(poses)

    def map_T_base(self, images: Keyframes, map_T_camera: Floats) -> Floats:
        """Return the base poses (K, 4, 4) at the images, from the poses (P, 4, 4) of the first camera of each multiframe."""
        map_T_base = map_T_camera @ inverse(images.base_T_camera[self.first])
        if len(self.first) == len(images):
            return map_T_base
        return map_T_base[self.number] @ self._motion(images)

    def _motion(self, images: Keyframes) -> Floats:
        """Return the motions (K, 4, 4) of base from the first image of the multiframe to each image."""
        path = _path(images)
        return inverse(path[self.first])[self.number] @ path


def _path(images: Keyframes) -> Floats:
    """Return the poses (K, 4, 4) of base from which motions are taken. If there is odometry, they are its poses."""
    return images.map_T_base if images.odom_T_base is None else images.odom_T_base

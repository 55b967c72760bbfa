"""Find the clocks of cameras, and the order of their frames, before there is a map. At the right clock offset, bearings turn
opposite to the robot."""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import kind
from objslam.core.geometry import angles_off
from objslam.core.trajectory import Trajectory
from objslam.core.types import Keyframes, Rays
from objslam.frontend.shared_errors import SharedErrors

_STEP = 0.02
"""The distance (s) between the tried offsets. A solve converges from ten times this distance, so a smaller step is only
slower."""
_LONGEST = 1.0
"""The longest time (s) between two bearings that are compared. Over a longer time, the robot drives past the object, and its
bearing changes without a turn."""
_MOST = 3000
"""The most pairs of bearings of a camera that are compared, spread over the log. A larger number is slower."""
_SURE = 5.0
"""The least log odds of a found offset against the expected offset. With a smaller value, solves for robots that hardly turn
begin at an offset that fits by chance. With a larger value, solves for short drives begin at a wrong clock."""
_TRIGGER, _TRIGGERED = 0.01, 0.9
"""The limits for cameras with a common trigger. At least the share `_TRIGGERED` of their images must follow the previous
image within `_TRIGGER` (s). The first image of each moment does not count. Images of such cameras keep the order of their
stamps, because found clocks have larger errors than the trigger. With a larger time or a smaller share, more cameras count
as cameras with a common trigger."""


def clocks_of_turns(errors: SharedErrors) -> Floats:
    """Return shared errors (P,) from which a search can begin. They are the prior mean, with the clocks that the robot's
    turns show.

    Two bearings of one label from neighbouring images differ by the turn of the robot between the images, and by parallax.
    At the right offset, the turns in the bearings are nearest to the turns of the odometry. The offsets are judged by the
    prior of the clock and by Laplace's distribution of unknown width. A search that begins at a clock 0.2 s off can end at a
    wrong optimum, where a large noise of turns explains the effect of the wrong clock.

    An interpolated pose has less noise midway between two poses of the odometry, because it averages the noise of both. If
    the images come at the rate of the odometry, an offset of half a step would therefore fit better. At some offsets, the
    noise of the odometry alone is smaller by a factor. The mean angle at such an offset is multiplied by this factor.
    """
    theta, odometry, cameras = errors.mean.copy(), errors.log.odometry, [one.camera.name for one in errors.log.cameras]
    if odometry is None or len(odometry) < 2 or errors.keyframes.odom_T_base is None:
        return theta
    limit = errors.settings.calibration.max_clock
    offsets = np.arange(-limit, limit + _STEP / 2, _STEP)
    for k, name in enumerate(errors.names):
        if kind(name) != "clock":
            continue
        stamps, bearings, weight = _pairs(errors, cameras.index(name.rpartition(".")[0]))
        if not len(stamps):
            continue
        tried = np.append(offsets, theta[k])
        missed = _missed(odometry, stamps, bearings, tried)
        noise = _noise_of_turns(odometry.stamps, stamps, tried)
        missed *= np.maximum(noise[-1] / np.maximum(noise, 1e-9), 1.0)
        floor = float(np.median(errors.rays.sigma))
        cost = weight * np.log(missed + floor)
        cost += (tried - errors.mean[k]) ** 2 / (2 * errors.prior[k, k])
        best = int(cost.argmin())
        if cost[best] < cost[-1] - _SURE:
            theta[k] = offsets[best]
    return theta


def in_order_of_clocks(frames: Keyframes, rays: Rays, errors: SharedErrors | None) -> tuple[Keyframes, Rays]:
    """Return frames in the order in which the images were taken, and the rays with indices into these frames.

    Frames are in the order of their stamps. If the clocks of two cameras differ by more than the time between two frames,
    images that were taken one after the other change places. The path of a graph would then go to and fro, and each piece of
    the path would count as a separate measurement. Images of cameras with a common trigger stay in the order of their
    stamps. errors: the shared errors of the frames, None if no clock is estimated.
    """
    cameras = () if errors is None else errors.cameras
    if errors is None or len(cameras) < 2:
        return frames, rays
    if (np.diff(frames.stamps) <= _TRIGGER).sum() >= _TRIGGERED * (1 - 1 / len(cameras)) * len(frames):
        return frames, rays
    found = dict(zip(errors.names, clocks_of_turns(errors).tolist(), strict=True))
    offset = np.array([found.get(f"{name}.clock", 0.0) for name in cameras])
    order = np.lexsort((frames.camera, frames.stamps + offset[frames.camera]))
    place = np.argsort(order)
    by_frame = np.argsort(place[rays.keyframe], kind="stable")
    sorted_rays = rays.take(by_frame)
    return frames.take(order), replace(sorted_rays, keyframe=place[sorted_rays.keyframe])


def _pairs(errors: SharedErrors, camera: int) -> tuple[Floats, Floats, float]:
    """Return the stamps (n, 2), s, of pairs of bearings of one label, and the bearings (n, 2, 3), unit, in base.

    The last value is the number of independent pairs. It is smaller than n, because pairs of the same images share the turn,
    and each image is compared with two others. A label with several boxes in an image has no pairs in that image.
    """
    keyframes, rays = errors.keyframes, errors.rays
    mine = np.flatnonzero(keyframes.camera[rays.keyframe] == camera)
    _, first, number = np.unique(
        np.stack([rays.label[mine], rays.keyframe[mine]]), axis=1, return_index=True, return_counts=True
    )
    single = mine[first[number == 1]]  # In the order of the labels, then of the keyframes.
    one, two = single[:-1], single[1:]
    apart = keyframes.stamps[rays.keyframe[two]] - keyframes.stamps[rays.keyframe[one]]
    near = np.flatnonzero((rays.label[one] == rays.label[two]) & (apart > 0) & (apart <= _LONGEST))
    images = len(np.unique(rays.keyframe[two[near]]))
    if len(near) > _MOST:
        near = near[np.linspace(0, len(near) - 1, _MOST).astype(np.int64)]
    pair = np.column_stack([one[near], two[near]])
    turn = keyframes.base_T_camera[rays.keyframe[pair], :3, :3]
    return keyframes.stamps[rays.keyframe[pair]], np.einsum("npij,npj->npi", turn, rays.direction[pair]), images / 2


def _missed(odometry: Trajectory, stamps: Floats, bearings: Floats, offsets: Floats) -> Floats:
    """Return the mean angle (m,), rad, between the second bearing of each pair and the first bearing turned opposite to the
    odometry.

    stamps: (n, 2) s and bearings: (n, 2, 3), of `_pairs`. offsets: (m,) s, of the clock.
    """
    found, rotations = np.zeros(len(offsets)), np.ascontiguousarray(odometry.poses[:, :3, :3])
    for i, offset in enumerate(offsets.tolist()):
        before, after = (_turned(odometry.stamps, rotations, stamps[:, k] + offset) for k in (0, 1))
        fixed = np.einsum("nij,nj->ni", before, bearings[:, 0])
        told = np.einsum("nji,nj->ni", after, fixed)
        found[i] = angles_off(np.zeros(3), bearings[:, 1], told).mean()
    return found


def _noise_of_turns(known: Floats, stamps: Floats, offsets: Floats) -> Floats:
    """Return the mean noise (m,) of the turns between pairs of stamps (n, 2), s, at offsets (m,), s, of the clock.

    The noise is a random walk with steps at stamps `known` (N,), s, interpolated linearly. It is in units of the walk after
    1 s.
    """
    found, step = np.zeros(len(offsets)), np.diff(known)
    for i, offset in enumerate(offsets.tolist()):
        before, after = (np.clip(np.searchsorted(known, stamps[:, k] + offset), 1, len(known) - 1) for k in (0, 1))
        first, last = (
            np.clip((stamps[:, k] + offset - known[at - 1]) / step[at - 1], 0.0, 1.0) for k, at in ((0, before), (1, after))
        )
        across = (1 - first) ** 2 * step[before - 1] + known[after - 1] - known[before] + last**2 * step[after - 1]
        found[i] = np.sqrt(np.where(before == after, (last - first) ** 2 * step[after - 1], across)).mean()
    return found


def _turned(known: Floats, rotations: Floats, stamps: Floats) -> Floats:
    """Return rotations (N, 3, 3), known at stamps `known` (N,), s, interpolated linearly at `stamps` (n,), s: (n, 3, 3).

    The result shortens vectors a little, which does not change their angles. This takes a tenth of the time of a rotation.
    """
    after = np.clip(np.searchsorted(known, stamps), 1, len(known) - 1)
    begin, end = known[after - 1], known[after]
    share = np.clip((stamps - begin) / (end - begin), 0.0, 1.0)[:, None, None]
    return np.asarray((1 - share) * rotations[after - 1] + share * rotations[after])

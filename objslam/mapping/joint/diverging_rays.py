"""Find labels that name several objects, without a solve: their rays cannot show a single place."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import angles_off, lengths
from objslam.core.rotation import cross
from objslam.core.types import Keyframes, Rays
from objslam.frontend.tracks import associate_tracks

_SOON = 3.0
"""The longest time (s) between two rays that are compared. In a longer time, the odometry may err by too much. In a shorter
time, the robot sees fewer things of a label."""
_APART = np.radians(20.0)
"""Two rays diverge if one of them must turn by at least this angle (rad) to meet the other. Errors of clock, camera and
odometry turn rays too. Six recorded drives with names were tested with clocks off by up to 1 s, or turns off by 20 %. At
most one pair of a drive exceeded this angle, and up to 4 pairs exceeded 15 degrees. With a larger angle, fewer labels of
several things are found."""
_MANY, _SHARE = 5, 0.1
"""A label diverges if at least this number and this share of its pairs diverge. In a test with six recorded drives, the 15
to 17 things of a drive got only five labels. These labels had 44 to 712 diverging pairs. With larger values, fewer labels
are found."""
_MOST = 0.5
"""Labels are no names if at least this share of the labels with `_MANY` rays diverge. The diverging labels must also have at
least this share of the rays. Rays to things that move diverge too, but seldom for half of the labels. With a larger share,
more maps of names are tried. Each takes a solve of up to a minute."""


def labels_diverge(keyframes: Keyframes, rays: Rays) -> bool:
    """Return whether the labels of most rays diverge, so that they name no single objects at rest.

    A robot that looks from one chair to another has two rays of the label within seconds, and the odometry knows how far it
    turned. If the rays diverge, no place is on both rays. Only rays of tracks are compared, because false boxes are single.
    A ray is compared with the previous ray of its label, if that ray is in another track.

    The result is False without odometry or without rays.
    """
    if keyframes.odom_T_base is None or not len(rays):
        return False
    label, off = _pairs(keyframes, rays)
    count = len(rays.label_names)
    rays_of = np.bincount(rays.label, minlength=count)
    number, far = np.bincount(label, minlength=count), np.bincount(label[off > _APART], minlength=count)
    diverge = (far >= _MANY) & (far > _SHARE * number)
    labels = int(diverge.sum()), int((rays_of >= _MANY).sum())
    return bool(labels[0] and labels[0] >= _MOST * labels[1] and rays_of[diverge].sum() >= _MOST * len(rays))


def _pairs(keyframes: Keyframes, rays: Rays) -> tuple[Ints, Floats]:
    """Return the label (P,) of each compared pair of rays, and the angle (P,) in rad by which the two rays miss each
    other."""
    assert keyframes.odom_T_base is not None
    track, time = associate_tracks(keyframes, rays).object, keyframes.stamps[rays.keyframe]
    some = np.flatnonzero(track >= 0)
    some = some[np.lexsort((time[some], rays.label[some]))]
    one, two = some[:-1], some[1:]
    near = (rays.label[one] == rays.label[two]) & (track[one] != track[two]) & (time[two] - time[one] <= _SOON)
    one, two = one[near], two[near]
    origin, direction = rays.in_map(keyframes.odom_T_base @ keyframes.base_T_camera)
    return rays.label[two], angles_to_ray(origin[one], direction[one], origin[two], direction[two])


def angles_to_ray(origin: Floats, direction: Floats, seen_from: Floats, look: Floats) -> Floats:
    """Return the smallest angle (P,), rad, between the other ray of each pair and the places on the first ray.

    Seen from the other origin, the places on the first ray lie on an arc. The arc goes from the direction of the first ray's
    origin to the direction of the first ray. origin, direction: (P, 3) of the first ray. seen_from, look: (P, 3) origin and
    direction of the other ray. Origins are in m, and directions are unit vectors.
    """
    back = origin - seen_from
    far = lengths(back)[:, None]
    begin = np.where(far > 0, back / np.maximum(far, 1e-12), direction)
    normal = cross(begin, direction)
    size = lengths(normal)
    between = (_products(cross(normal, begin), look) > 0) & (_products(cross(direction, normal), look) > 0)
    beside = np.arcsin(np.clip(np.abs(_products(normal, look)) / np.maximum(size, 1e-12), 0.0, 1.0))
    ends = [angles_off(np.zeros_like(look), look, end) for end in (begin, direction)]
    return np.where(between & (size > 1e-9), beside, np.minimum(*ends))


def _products(one: Floats, two: Floats) -> Floats:
    """Return the scalar products (P,) of vectors (P, 3)."""
    return np.asarray(np.einsum("pi,pi->p", one, two))

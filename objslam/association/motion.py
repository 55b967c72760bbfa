"""Does it move? Rays of a thing that moves slowly can meet for a while; a moving point then explains them much better."""

from __future__ import annotations

import numpy as np

from objslam.association.extent import grouped_quantile
from objslam.association.landmarks import State, sizes, variance
from objslam.association.refit import sums
from objslam.association.sightings import Sightings
from objslam.types import Floats, Ints

_RARE = 3.0  # log odds against motion before its rays are looked at
_WAY = 0.5  # of an object's size
_MOST = 10  # rays that count


def rest_odds(s: Sightings, stamps: Floats, state: State) -> Floats:
    """Log odds (N,), at most 0, of a point at rest against one of constant velocity; stamps: (F,) of the frames.

    By BIC, from the share of the squared deviations that a velocity explains. The middle of a real box wanders slowly over
    its object as the view changes, which looks like motion: so many rays count as few, and a way within the size of the
    object is none.
    """
    explained, way = _with_velocity(s, stamps, state)
    size = 2.0 * np.clip(state.number, 1, _MOST)  # each ray has two coordinates
    odds = _RARE + 1.5 * np.log(size) + 0.5 * size * np.log(np.clip(1 - explained, 1e-6, 1.0))
    return np.where(way > _WAY * sizes(s, state), np.minimum(odds, 0.0), 0.0)


def _with_velocity(s: Sightings, stamps: Floats, state: State) -> tuple[Floats, Floats]:
    """Which share of its rays' squared deviations a velocity of each landmark explains, and how far it goes, m: (N,)."""
    count = len(state.landmarks)
    held = np.flatnonzero(state.matched >= 0)
    index, r = state.matched[held], s.take(held)
    time = _standard(stamps[r.frame], index, count)
    to = state.landmarks.position[index] - r.origin
    distance = np.maximum(np.linalg.norm(to, axis=1), 1e-6)
    toward = to / distance[:, None]
    # as in `refit`: along the line of sight nothing changes, so a point that drives along with the camera gains nothing
    across = np.eye(3) - toward[:, :, None] * toward[:, None, :]
    spread = variance(r, distance, state.landmarks.noise[index])
    offset = to - np.einsum("ri,ri->r", to, r.direction)[:, None] * r.direction
    weighted = across / spread[:, None, None]
    pull = -(weighted @ offset[:, :, None])[:, :, 0]
    blocks = [sums((weighted * (time**p)[:, None, None]).reshape(-1, 9), index, count).reshape(-1, 3, 3) for p in range(3)]
    information = np.block([[blocks[0], blocks[1]], [blocks[1], blocks[2]]])
    information += (1e-6 * np.trace(information, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(6)
    right = np.concatenate([sums(pull, index, count), sums(pull * time[:, None], index, count)], axis=1)
    moving = np.linalg.solve(information, right[:, :, None])[:, :, 0]
    resting = np.linalg.solve(information[:, :3, :3], right[:, :3, None])[:, :, 0]
    gain = (moving * right).sum(axis=1) - (resting * right[:, :3]).sum(axis=1)
    total = np.maximum(np.bincount(index, np.einsum("pi,pi->p", offset, offset) / spread, count), 1e-9)
    duration = grouped_quantile(time, index, count, 1.0) - grouped_quantile(time, index, count, 0.0)
    return gain / total, np.nan_to_num(np.linalg.norm(moving[:, 3:], axis=1) * duration)


def _standard(time: Floats, index: Ints, count: int) -> Floats:
    """Times (P,) with mean 0 and standard deviation 1 within each landmark."""
    number = np.maximum(np.bincount(index, minlength=count), 1)
    centred = time - (np.bincount(index, time, count) / number)[index]
    spread = np.sqrt(np.bincount(index, centred**2, count) / number)
    return np.asarray(centred / np.maximum(spread[index], 1e-9))

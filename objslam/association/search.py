"""Global association with known poses: which box is of which object, when nobody says how many objects there are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.assign import gate_limit
from objslam.association.evidence import Rates, chance_odds, detection_rates
from objslam.association.extent import grouped_median
from objslam.association.matches import Landmarks, choose, gated_edges, track_bonus, variance
from objslam.association.refit import refit
from objslam.association.sightings import Sightings, sight
from objslam.association.structure import merges
from objslam.association.visibility import View, Visits, visits
from objslam.ledger import Ledger
from objslam.types import Association, Bools, Camera, Floats, Ints, Keyframes, Rays

_SEARCHES = 8
_SETTLES = 3
_ROUNDS = 10
_SUBSAMPLE = 4096
_NOISE_LIMITS = (0.3, 3.0)
_POOLED = 30.0
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True)
class State:
    """What is believed at the moment: landmarks, and matched (R,), the landmark of each sighting or -1."""

    landmarks: Landmarks
    matched: Ints

    @property
    def number(self) -> Ints:
        """(N,) rays of each landmark."""
        return np.bincount(self.matched[self.matched >= 0], minlength=len(self.landmarks))

    def keep(self, which: Bools) -> State:
        """Only some of the landmarks (N,); the others' rays go free."""
        number = np.append(np.cumsum(which) - 1, -1)
        kept = np.append(which, False)
        return State(self.landmarks.take(which), np.where(kept[self.matched], number[self.matched], -1))


def labels_of(s: Sightings, state: State) -> Ints:
    """How many rays of each label each landmark has, (N, L)."""
    n, labels = state.landmarks.accepts.shape
    held = state.matched >= 0
    return np.bincount(state.matched[held] * labels + s.label[held], minlength=n * labels).reshape(n, labels)


def settle(s: Sightings, state: State, gate: float, times: int = _SETTLES) -> State:
    """Assignment and refit in turns until nothing changes, or for some times."""
    for _ in range(times):
        edges = gated_edges(s, state.landmarks, gate)
        cost = edges.cost - track_bonus(edges, s.track, state.matched)
        matched = choose(edges, cost, s.frame, gate)
        same = np.array_equal(matched, state.matched)
        held = np.flatnonzero(matched >= 0)
        position, covariance = refit(s, held, matched[held], state.landmarks.position, state.landmarks.noise)
        landmarks = state.landmarks.placed(position, covariance)
        state = State(landmarks, matched)
        state = replace(state, landmarks=replace(landmarks, noise=_noise(s, state)))
        state = state.keep((state.number >= 3) & np.isfinite(position).all(axis=1))
        if same:
            break
    return state


def _noise(s: Sightings, state: State) -> Floats:
    held = np.flatnonzero(state.matched >= 0)
    index = state.matched[held]
    n = len(state.landmarks)
    to = state.landmarks.position[index] - s.origin[held]
    depth = np.einsum("ri,ri->r", to, s.direction[held])
    offset = np.sqrt(np.maximum((to * to).sum(axis=1) - depth**2, 0))
    rel = offset / np.sqrt(variance(s.take(held), np.linalg.norm(to, axis=1), np.ones(len(held)))) / _RAYLEIGH_MEDIAN
    kind = labels_of(s, state).argmax(axis=1)
    L = state.landmarks.accepts.shape[1]
    number = np.bincount(index, minlength=n)
    pooled = grouped_median(rel, kind[index], L)
    num_c = np.bincount(kind[index], minlength=L)
    pooled = np.where(num_c > 0, (num_c * np.nan_to_num(pooled) + _POOLED) / (num_c + _POOLED), 1.0)
    own = np.nan_to_num(grouped_median(rel, index, n), nan=1.0)
    noise = (number * own + _POOLED * pooled[kind]) / (number + _POOLED)
    return np.clip(noise, *_NOISE_LIMITS)


def explore(s: Sightings, state: State, gate: float, parallax: float, settings, seed: int, turn: int) -> State:
    from objslam.association.hypotheses import Search, discover

    labels = state.landmarks.accepts.shape[1]
    found, kinds = [], []
    for label in np.unique(s.label):
        free = np.flatnonzero((s.label == label) & (state.matched < 0))
        if len(free) < 3:
            continue
        rng = np.random.default_rng([seed, turn, int(label)])
        if len(free) > _SUBSAMPLE:
            frames = np.unique(s.frame[free])
            some = rng.permutation(frames)[: int(len(frames) * _SUBSAMPLE / len(free))]
            free = free[np.isin(s.frame[free], some)]
        search = Search(1024, 2.5, gate, parallax, "cpu")
        points = discover(s.take(free), search, rng)
        found.append(points)
        kinds.append(np.full(len(points), label))
    kind = np.concatenate(kinds) if kinds else np.zeros(0, dtype=np.int64)
    if not len(kind):
        return state
    accepts = np.zeros((len(kind), labels), dtype=bool)
    accepts[np.arange(len(kind)), kind] = True
    old = state.landmarks
    n = len(kind)
    joined = Landmarks(
        np.concatenate([old.position, *found]),
        np.concatenate([old.covariance, np.zeros((n, 3, 3))]),
        np.concatenate([old.noise, np.ones(n)]),
        np.concatenate([old.accepts, accepts]),
    )
    return State(joined, state.matched)


def associate(
    rays: Rays,
    keyframes: Keyframes,
    cameras: tuple[Camera, ...],
    settings,
    *,
    map_T_camera: Floats,
    sigma: Floats,
    position_sigma: float,
    seed: int = 0,
    ledger: Ledger | None = None,
    debug: bool = False,
    share: float = 0.0,
):
    s, ray, keyframe = sight(rays, keyframes, cameras, map_T_camera, sigma, position_sigma)
    view = View(cameras, keyframes.camera[keyframe], map_T_camera[keyframe], settings.rays.border, share)
    gate = gate_limit(0.999)
    labels = len(rays.label_names)
    state = State(Landmarks(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros((0, labels), dtype=bool)), np.full(len(s), -1))
    for turn in range(_SEARCHES):
        before = len(state.landmarks)
        state = explore(s, state, gate, np.radians(2.0), settings, seed, turn)
        if len(state.landmarks) == before:
            break
        state = settle(s, state, gate, 2)
        kind = labels_of(s, state).argmax(axis=1)
        seen = visits(s, state.matched, state.landmarks.position, kind, view)
        o2 = chance_odds(s, state.matched, state.landmarks.noise, state.landmarks.position, kind, seen, view, gate)
        if debug: print("turn", turn, len(state.landmarks), (o2<0).sum(), (state.matched < 0).sum())
        state = state.keep(o2 >= 0)
        if len(state.landmarks) <= before: break
    for fuse in (False, True):
        for round_ in range(_ROUNDS):
            kind = labels_of(s, state).argmax(axis=1)
            seen = visits(s, state.matched, state.landmarks.position, kind, view)
            rates = detection_rates(seen, kind)
            target = merges(s, state.landmarks, state.matched, kind, seen, rates, gate, fuse)
            gone = target != np.arange(len(target))
            if debug: print("round", fuse, round_, len(state.landmarks), "merged", gone.sum(), "rates", rates.mean.round(2), rates.concentration)
            if not gone.any():
                break
            accepts = state.landmarks.accepts.copy()
            np.logical_or.at(accepts, target, state.landmarks.accepts)
            state = State(replace(state.landmarks, accepts=accepts), np.append(target, -1)[state.matched])
            state = state.keep(~gone)
            state = settle(s, state, gate)
    for _ in range(_ROUNDS):
        kind = labels_of(s, state).argmax(axis=1)
        seen = visits(s, state.matched, state.landmarks.position, kind, view)
        rates = detection_rates(seen, kind)
        o1 = rates.log_odds(seen, kind)
        o2 = chance_odds(s, state.matched, state.landmarks.noise, state.landmarks.position, kind, seen, view, gate)
        exist = 1 / (1 + np.exp(-o1)) / (1 + np.exp(-o2))
        if debug: print("exist", len(exist), (exist < 0.5).sum(), rates.concentration)
        if (exist >= 0.5).all():
            break
        state = state.keep(exist >= 0.5)
        state = settle(s, state, gate)
    return s, ray, state, seen, rates, kind, exist

"""Global association with known poses: which box is of which object, when nobody says how many objects there are.

Per label, points where rays of different frames meet are scored against all its rays at once; the best are refitted, their
rays taken out, and what is left is searched again. Then objects are merged, fused across labels and dropped, each by what
explains the boxes, and the misses, more cheaply.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam import config
from objslam.association.assign import gate_limit
from objslam.association.evidence import chance_odds, detection_rates, prior_odds, size_odds
from objslam.association.extent import grouped_median, grouped_quantile
from objslam.association.labels import adopted
from objslam.association.landmarks import BEHIND, Landmarks, State, offsets, variance
from objslam.association.matches import choose, gated_edges, track_bonus
from objslam.association.motion import rest_odds
from objslam.association.refit import refit, sums
from objslam.association.sightings import Sightings, sight
from objslam.association.structure import RAYLEIGH_MEDIAN, close_pairs, merges
from objslam.association.visibility import View, Visits, visits
from objslam.errors import ConfigError
from objslam.types import Association, Bools, Camera, Floats, Ints, Keyframes, Rays

_TURNS = 8  # searches among the rays that are left
_ROUNDS = 12  # of merging, and of merging and dropping, at the most
_SETTLED = 3  # times that assignment and refit take turns after a change
_SAMPLE = 4096  # rays of one label that a search looks at
_MIN_RAYS = 3  # of an object
_MIN_SUPPORT = 2.5  # of a point in a search, where a ray that fits perfectly counts 1,
_ABOVE = 3.0  # and by how many standard deviations it exceeds what strays give
_CHANCE = 3.0  # log odds against strays that a point needs to be kept in the search
_PARALLAX = np.radians(2.0)  # of two rays that make a point
_NOISE = (1.0, 3.0)  # times the noise that was promised, never less: its tails are heavy
_FAR = 1e6  # m from the robot
_POOLED = 30.0  # rays of an object that weigh its own noise as much as that of its class


@dataclass(frozen=True)
class _Work:
    s: Sightings
    view: View
    labels: int
    gate: float
    settings: config.AssociationSettings
    device: str
    seed: int

    def visits(self, state: State) -> Visits:
        return visits(self.s, state.matched, state.landmarks.position, state.kind(self.s), self.view)


def associate(
    rays: Rays,
    keyframes: Keyframes,
    cameras: tuple[Camera, ...],
    settings: config.Settings,
    *,
    map_T_camera: Floats,
    sigma: Floats,
    position_sigma: float = 0.0,
    seed: int = 0,
    guess: tuple[Association, Floats] | None = None,
) -> Association:
    """Which ray belongs to which object, at the camera poses (K, 4, 4) of the keyframes.

    keyframes: all frames that were looked at, those without any box too: what was not seen counts as well. sigma: (R,) rad
    and position_sigma: m, the noise of the rays with that of the poses. guess: an association of these rays to begin from,
    and where its objects are, (N, 3), NaN for those to forget. Objects come sorted by label, then by the frame that saw them
    first, and nothing depends on the order of rays and keyframes. Rays that no object at rest explains have none.
    """
    s, ray, keyframe = sight(rays, keyframes, cameras, map_T_camera, sigma, position_sigma)
    view = View(
        stamps=keyframes.stamps[keyframe],
        cameras=cameras,
        camera=keyframes.camera[keyframe],
        map_T_camera=map_T_camera[keyframe],
        margin=settings.rays.border,
        margin_share=settings.rays.border_share,
    )
    gate = gate_limit(settings.association.gate)
    work = _Work(s, view, len(rays.label_names), gate, settings.association, _device(settings), seed)
    state = _begin(work, ray, guess)
    for turn in range(_TURNS):
        before = len(state.landmarks)
        state = _settle(work, _explore(work, state, turn, _PARALLAX), 2)
        state = _merge_round(work, _not_by_chance(work, state))
        state = _drop(work, state, _existence(work, state))
        if len(state.landmarks) <= before:
            break
    state = _with_far_ones(work, state)
    for _ in range(_ROUNDS):  # rays of what is dropped go free, and may show that others are one
        state = _merge_all(work, state)
        before = len(state.landmarks)
        state = _drop_all(work, state)
        if len(state.landmarks) == before:
            break
    if settings.association.fuse_labels:
        accepts = adopted(s, state, work.visits(state), view, gate)
        state = _drop_all(work, _settle(work, replace(state, landmarks=replace(state.landmarks, accepts=accepts))))
    return _result(work, state, ray)


def _begin(work: _Work, ray: Ints, guess: tuple[Association, Floats] | None) -> State:
    """The landmarks that are guessed, or none; ray: (R,) which ray each sighting is."""
    if guess is None:
        nothing = Landmarks.new(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.int64), work.labels)
        return State(nothing, np.full(len(work.s), -1, dtype=np.int64))
    association, position = guess
    landmarks = Landmarks.new(position, np.ones(len(position)), association.label, work.labels)
    state = State(landmarks, association.object[ray])
    return _settle(work, state.keep((state.number >= _MIN_RAYS) & _near(work, position)))


def _device(settings: config.Settings) -> str:
    """Scoring pays on CUDA whenever it is there."""
    import torch

    device, there = settings.triangulation.device, torch.cuda.is_available()
    if device == "cuda" and not there:
        raise ConfigError("torch sees no CUDA device", hint="set triangulation.device=auto")
    return ("cuda" if there else "cpu") if device == "auto" else device


def _explore(work: _Work, state: State, turn: int, parallax: float) -> State:
    """Landmarks added where the rays that no landmark has agree, label by label."""
    from objslam.association.hypotheses import Search, discover

    noise = _class_noise(work, state)
    landmarks = state.landmarks
    for label in np.unique(work.s.label[state.matched < 0]).tolist():
        free = np.flatnonzero((work.s.label == label) & (state.matched < 0))
        if len(free) < _MIN_RAYS:
            continue
        rng = np.random.default_rng([work.seed, turn, label])
        if len(free) > _SAMPLE:
            frames = np.unique(work.s.frame[free])
            some = rng.permutation(frames)[: int(len(frames) * _SAMPLE / len(free))]
            free = free[np.isin(work.s.frame[free], some)]
        pool = work.s.take(free)
        pool = replace(pool, sigma=pool.sigma * noise[label], place=pool.place * noise[label])
        # of so many rays so many pass any point by chance, and support half each
        chance = np.pi * work.gate * float((pool.sigma**2).sum()) / work.view.solid_angle
        support = max(_MIN_SUPPORT, 0.5 * (chance + _ABOVE * np.sqrt(chance)))
        search = Search(work.settings.hypotheses, support, work.gate, parallax, work.device)
        points = discover(pool, search, rng)
        new = Landmarks.new(points, np.full(len(points), noise[label]), np.full(len(points), label), work.labels)
        landmarks = landmarks.and_also(new)
    return State(landmarks, state.matched)


def _with_far_ones(work: _Work, state: State) -> State:
    """Landmarks added where rays agree that have no parallax: seen from afar, or by a robot that hardly moves."""
    known = len(state.landmarks)
    state = _settle(work, _explore(work, state, _TURNS, 0.0), 2)
    held = np.flatnonzero(state.matched >= 0)
    index, direction = state.matched[held], work.s.direction[held]
    mean = sums(direction, index, len(state.landmarks))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    off = np.linalg.norm(np.cross(direction, mean[index]), axis=1)
    narrow = np.nan_to_num(grouped_quantile(off, index, len(mean), 1.0)) < np.sin(_PARALLAX)
    return _not_by_chance(work, state.keep(narrow | (np.arange(len(narrow)) < known)))


def _settle(work: _Work, state: State, times: int = _SETTLED) -> State:
    """Assignment and refit in turns, until nothing changes or for some times."""
    for _ in range(times):
        edges = gated_edges(work.s, state.landmarks, work.gate)
        matched = choose(edges, edges.cost - track_bonus(edges, work.s.track, state.matched), work.s.frame, work.gate)
        same = np.array_equal(matched, state.matched)
        held = np.flatnonzero(matched >= 0)
        old = state.landmarks
        position = refit(work.s, held, matched[held], old.position, old.noise)
        state = State(replace(old, position=position), matched)
        state = State(replace(state.landmarks, noise=_noise(work, state)), matched)
        state = state.keep((state.number >= _MIN_RAYS) & _near(work, position))
        if same:
            break
    return state


def _near(work: _Work, position: Floats) -> Bools:
    """Which places (N, 3) are somewhere on the robot's way, and not where parallel rays meet."""
    return np.asarray((np.abs(position - work.s.origin[:1]) < _FAR).all(axis=1))


def _deviations(work: _Work, state: State) -> tuple[Floats, Ints]:
    """By how many (assumed) standard deviations each ray with a landmark passes it, and which landmark that is: (P,)."""
    held = np.flatnonzero(state.matched >= 0)
    index, r = state.matched[held], work.s.take(held)
    off2, distance = offsets(r, state.landmarks.position[index])
    return np.minimum(np.sqrt(off2 / variance(r, distance, np.ones(len(r)))), BEHIND), index


def _class_noise(work: _Work, state: State) -> Floats:
    """By what factor (L,) the rays of each label are noisier than assumed, drawn to 1 where they are few."""
    deviation, index = _deviations(work, state)
    kind = state.kind(work.s)[index]
    number = np.bincount(kind, minlength=work.labels)
    middle = np.nan_to_num(grouped_median(deviation, kind, work.labels)) / RAYLEIGH_MEDIAN
    return np.clip((number * middle + _POOLED) / (number + _POOLED), *_NOISE)


def _noise(work: _Work, state: State) -> Floats:
    """The same factor for each landmark (N,), drawn to that of its class."""
    deviation, index = _deviations(work, state)
    own = np.minimum(np.nan_to_num(grouped_median(deviation, index, len(state.landmarks))) / RAYLEIGH_MEDIAN, _NOISE[1])
    of_class = _class_noise(work, state)[state.kind(work.s)]
    return np.clip((state.number * own + _POOLED * of_class) / (state.number + _POOLED), *_NOISE)


def _not_by_chance(work: _Work, state: State) -> State:
    """Only landmarks whose rays are more than strays that meet."""
    return state.keep(chance_odds(work.s, state, state.kind(work.s), work.visits(state), work.view, work.gate) >= _CHANCE)


def _merge_round(work: _Work, state: State, across_labels: bool = False) -> State:
    if len(state.landmarks) < 2:
        return state
    kind, seen = state.kind(work.s), work.visits(state)
    rates = detection_rates(seen, kind, work.labels)
    target = merges(work.s, state, kind, seen, rates, work.gate, across_labels)
    if (target == np.arange(len(target))).all():
        return state
    return _settle(work, state.merge(target))


def _merge_all(work: _Work, state: State) -> State:
    for across_labels in (False, True) if work.settings.fuse_labels else (False,):
        for _ in range(_ROUNDS):
            before = len(state.landmarks)
            state = _merge_round(work, state, across_labels)
            if len(state.landmarks) == before:
                break
    return state


def _drop_all(work: _Work, state: State) -> State:
    while True:
        before = len(state.landmarks)
        state = _drop(work, state, _existence(work, state))
        if len(state.landmarks) == before:
            return state


def _drop(work: _Work, state: State, existence: Floats) -> State:
    """Without the landmarks that exist less likely (N,) than the settings ask for; of neighbours the weaker go first."""
    failing = existence < work.settings.min_existence
    if not failing.any():
        return state
    return _settle(work, state.keep(~failing | _has_weaker(work, state, failing)))


def _existence(work: _Work, state: State) -> Floats:
    """How likely each landmark is an object at rest (N,)."""
    from scipy.special import expit

    kind, seen = state.kind(work.s), work.visits(state)
    rates = detection_rates(seen, kind, work.labels)
    by_rate = prior_odds(work.s, state, kind) + rates.log_odds(seen, kind)
    by_rate += size_odds(work.s, state, kind) + rest_odds(work.s, work.view.stamps, state)
    by_chance = chance_odds(work.s, state, kind, seen, work.view, work.gate)
    return np.asarray(expit(by_rate) * expit(by_chance))


def _has_weaker(work: _Work, state: State, failing: Bools) -> Bools:
    """Whether a weaker failing landmark (N,) stands so near that it may hold boxes of this one: it has to go first."""
    number, kind = state.number, state.kind(work.s)
    a, b = close_pairs(work.s, state, work.gate)
    rivals = failing[a] & failing[b] & (kind[a] == kind[b])
    a, b = a[rivals], b[rivals]
    result = np.zeros(len(failing), dtype=bool)
    result[np.where(number[a] > number[b], a, b)] = True
    return result


def _result(work: _Work, state: State, ray: Ints) -> Association:
    """The objects in an order of their own; ray: (R,) which ray each sighting is."""
    counts, kind = state.labels(work.s), state.kind(work.s)
    first = np.full(len(kind), len(work.s))
    held = np.flatnonzero(state.matched >= 0)
    np.minimum.at(first, state.matched[held], held)
    order = np.lexsort((first, kind))
    number = np.append(np.empty(len(kind), dtype=np.int64), -1)
    number[order] = np.arange(len(kind))
    matched = np.empty(len(ray), dtype=np.int64)
    matched[ray] = number[state.matched]
    weights = counts[order] / np.maximum(counts[order].sum(axis=1, keepdims=True), 1)
    return Association(matched, kind[order], weights, _existence(work, state)[order])

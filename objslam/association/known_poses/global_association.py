"""Global association at known poses: assign rays to an unknown number of objects.

A search finds points where rays of one label meet, and the best points become landmarks. A second search finds points with
few rays, whose odds against chance decide. Then landmarks are merged, fused
across labels or dropped, if this explains the boxes and the misses at a lower cost.
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam import config
from objslam.association.gating import best_assignment, gate_limit, gated_edges, track_bonus
from objslam.association.known_poses.chance import Strays, chance_odds, total_odds, unmatched_costs
from objslam.association.known_poses.detection_rates import detection_rates
from objslam.association.known_poses.existence import existence
from objslam.association.known_poses.hypothesis_search import Search, discover
from objslam.association.known_poses.label_fusion import fused_labels
from objslam.association.known_poses.merging import close_pairs, merge_targets
from objslam.association.known_poses.sparse_search import SparseSearch, discover_sparse
from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import observe
from objslam.association.refinement import grouped_sums, refine
from objslam.association.visibility import CameraFrames
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.statistics import grouped_quantile
from objslam.core.types import Association, Keyframes, Rays

_TURNS = 8  # The most searches among the unassigned rays. They end once a search finds nothing.
_ROUNDS = 12  # The most rounds of merging and dropping. Without a limit, they could repeat for ever.
_ALTERNATIONS = 3  # The most alternations of assignment and refinement after a change. A larger value converges further.
_SAMPLE = 4096  # The most rays of one label that a search uses, in whole frames. Later searches use other frames.
_FRAMES = 12  # The fewest frames that a search uses. An object is where rays of several frames meet.
_MOST_RAYS = 1 << 14  # The most rays of one label that a search uses if frames have many rays. A larger value costs time.
_MIN_SUPPORT = 2.5  # The least support of a point in a search. A ray that fits perfectly counts 1.
_SPARSE_SAMPLE = 512  # The most rays of one label in a search for objects with few rays. A larger one costs time squared.
_ABOVE_CHANCE = 3.0  # The least excess of a point's support over the support by stray rays, in standard deviations.
_CHANCE_ODDS = 3.0  # The least log odds of a landmark against stray rays during the search. A larger one drops weak objects.
_PARALLAX = np.radians(2.0)  # The least angle (rad) between the rays of a pair. A larger angle finds fewer, surer points.
_FAR = 1e6  # The distance (m) from the first camera beyond which only parallel rays meet.


@dataclass(frozen=True)
class _Task:
    """The constants of one association. gate: the largest squared deviation of a match. device: the setting
    `triangulation.device`. seed: the seed of the random ray pairs."""

    gate: float
    settings: config.AssociationSettings
    strays: Strays
    device: str
    seed: int


def associate_globally(
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
    """Assign rays to objects at known camera poses.

    Objects are sorted by label, then by their first frame. Rays that no static object explains get no object. The result
    does not depend on the order of rays and keyframes.

    Args:
        keyframes: all observed frames. Frames without a box count as misses.
        map_T_camera: (K, 4, 4) of the keyframes.
        sigma: (R,) rad, the noise of the rays' angles, including the noise of the poses.
        position_sigma: m, the noise of the rays' origins.
        guess: an initial association of the rays, and the positions (N, 3) m of its objects. NaN drops an object.
    """
    obs, ray, keyframe = observe(rays, keyframes, cameras, map_T_camera, sigma, position_sigma)
    margins = settings.rays.border, settings.rays.border_share
    camera = keyframes.camera[keyframe]
    view = CameraFrames(keyframes.stamps[keyframe], cameras, camera, map_T_camera[keyframe], *margins)
    nothing = Landmarks.new(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.int64), len(rays.label_names))
    state = State(obs, view, nothing, np.full(len(ray), -1, dtype=np.int64))
    task = _Task(
        gate_limit(settings.association.gate),
        settings.association,
        Strays.of(obs, view, len(rays.label_names)),
        settings.triangulation.device,
        seed,
    )
    if guess is not None:
        association, position = guess
        landmarks = Landmarks.new(position, np.ones(len(position)), association.label, len(rays.label_names))
        state = replace(state, landmarks=landmarks, matched=association.object[ray])
        state = _alternate(task, state.keep(_plausible(task, state)))
    refuted = np.zeros(len(ray), dtype=bool)
    for turn in range(_TURNS):
        before = state.count
        state = _alternate(task, _discover(task, state, turn, _PARALLAX), 2)
        found = _merge_round(task, state.keep(_odds(task, state) >= _CHANCE_ODDS))
        state = _drop(task, found, _existence(task, found))
        refuted |= (found.matched >= 0) & (state.matched < 0)
        if state.count <= before:
            break
    for turn in range(_TURNS):
        before = state.count
        state = _alternate(task, _discover_sparse(task, state, turn, ~refuted), 2)
        state = _merge_round(task, state.keep(_odds(task, state) >= 0))
        state = _drop(task, state, _existence(task, state))
        if state.count <= before:
            break
    state = _add_distant(task, state)
    for _ in range(_ROUNDS):  # Without the rays of a dropped landmark, two other landmarks may turn out to be one object.
        merged = _merge_all(task, state)
        state, likely = _drop_all(task, merged)
        if state.count == merged.count:
            break
    if settings.association.fuse_labels:
        landmarks = replace(state.landmarks, accepts=fused_labels(state, task.gate))
        state, likely = _drop_all(task, _alternate(task, replace(state, landmarks=landmarks)))
    rates = detection_rates(state.history, state.label, len(state.unassigned))
    return replace(_result(state, likely, ray), log_odds=total_odds(state, task.gate, task.strays, rates))


def _discover(task: _Task, state: State, turn: int, parallax: float) -> State:
    """Add landmarks where unassigned rays of one label agree. turn: the number of the search, which changes the random
    pairs. parallax: as in `Search`."""
    obs, noise, landmarks = state.obs, state.class_noise, state.landmarks
    for label in np.flatnonzero(state.unassigned).tolist():
        free = np.flatnonzero((obs.label == label) & (state.matched < 0))
        rng = np.random.default_rng([task.seed, turn, label])
        if len(free) > _SAMPLE:
            frames = np.unique(obs.frame[free])
            some = rng.permutation(frames)[: max(int(len(frames) * _SAMPLE / len(free)), _FRAMES)]
            free = free[np.isin(obs.frame[free], some)]
        if len(free) > _MOST_RAYS:
            free = np.sort(rng.permutation(free)[:_MOST_RAYS])
        pool = obs.take(free)
        pool = replace(pool, sigma=pool.sigma * noise[label], position_sigma=pool.position_sigma * noise[label])
        # About `chance` stray rays pass any point within the gate, and each supports it by 0.5 on average.
        chance = np.pi * task.gate * float((pool.sigma**2).sum()) / state.view.solid_angle
        support = max(_MIN_SUPPORT, 0.5 * (chance + _ABOVE_CHANCE * np.sqrt(chance)))
        points = discover(pool, Search(task.settings.hypotheses, support, task.gate, parallax, task.device), rng)
        new = Landmarks.new(points, np.full(len(points), noise[label]), np.full(len(points), label), len(noise))
        landmarks = landmarks.and_also(new)
    return replace(state, landmarks=landmarks)


def _add_distant(task: _Task, state: State) -> State:
    """Add landmarks where rays without parallax agree. Such rays come from distant objects, or from a robot that hardly
    moves."""
    known = state.count
    state = _alternate(task, _discover(task, state, _TURNS, 0.0), 2)
    index, direction = state.owner, state.obs.direction[state.assigned]
    mean = grouped_sums(direction, index, state.count)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    off = np.linalg.norm(np.cross(direction, mean[index]), axis=1)
    narrow = np.nan_to_num(grouped_quantile(off, index, len(mean), 1.0)) < np.sin(_PARALLAX)
    first = np.arange(len(narrow)) < known
    state = state.keep(narrow | first)
    return state.keep((_odds(task, state) >= _CHANCE_ODDS) | (np.arange(state.count) < known))


def _discover_sparse(task: _Task, state: State, turn: int, allowed: Bools) -> State:
    """Add landmarks where few unassigned rays of one label agree. allowed: (R,) the rays that may be used."""
    obs, noise, landmarks = state.obs, state.class_noise, state.landmarks
    for label in np.flatnonzero(state.unassigned).tolist():
        free = np.flatnonzero((obs.label == label) & (state.matched < 0) & allowed)
        free = _some_frames(obs.frame, free, _SPARSE_SAMPLE, np.random.default_rng([task.seed, turn, label]))
        pool = obs.take(free)
        pool = replace(pool, sigma=pool.sigma * noise[label], position_sigma=pool.position_sigma * noise[label])
        number = float(state.unassigned[label])
        search = SparseSearch(task.strays.take(free), number, task.gate, _PARALLAX, 0.0)
        points = discover_sparse(pool, search)
        new = Landmarks.new(points, np.full(len(points), noise[label]), np.full(len(points), label), len(noise))
        landmarks = landmarks.and_also(new)
    return replace(state, landmarks=landmarks)


def _some_frames(frame: Ints, rays: Ints, most: int, rng: np.random.Generator) -> Ints:
    """Return the rays of a random part of the frames if there are more than `most` rays."""
    if len(rays) <= most:
        return rays
    frames = np.unique(frame[rays])
    some = rng.permutation(frames)[: max(int(len(frames) * most / len(rays)), _FRAMES)]
    rays = rays[np.isin(frame[rays], some)]
    return rays if len(rays) <= most else np.sort(rng.permutation(rays)[:most])


def _odds(task: _Task, state: State) -> Floats:
    """Return the log odds (N,) of each landmark over stray rays that meet."""
    rates = detection_rates(state.history, state.label, len(state.unassigned))
    return chance_odds(state, task.gate, task.strays, rates)


def _existence(task: _Task, state: State) -> Floats:
    return existence(state, task.gate, task.strays)


def _alternate(task: _Task, state: State, times: int = _ALTERNATIONS) -> State:
    """Alternate between assignment and refinement until no ray changes its landmark, at most `times` times."""
    for _ in range(times):
        obs, old, before = state.obs, state.landmarks, state.matched
        edges = gated_edges(obs, old, task.gate)
        cost = edges.cost - track_bonus(edges, obs.track, before)
        cost -= unmatched_costs(state, edges, task.strays, task.gate)
        matched = best_assignment(edges, cost, obs.frame, 0.0)
        held = np.flatnonzero(matched >= 0)
        position = refine(obs, held, matched[held], old.position, old.noise)
        state = State(obs, state.view, replace(old, position=position), matched)
        plausible = _plausible(task, state)
        state = replace(state, landmarks=replace(state.landmarks, noise=state.noise)).keep(plausible)
        if np.array_equal(matched, before):
            break
    return state


def _plausible(task: _Task, state: State) -> Bools:
    """Return which landmarks (N,) have two rays or a range, and are not so far away that only parallel rays meet there."""
    near = (np.abs(state.landmarks.position - state.obs.origin[:1]) < _FAR).all(axis=1)
    ranged = np.bincount(state.owner, np.isfinite(state.obs.range[state.assigned]), state.count) > 0
    return np.asarray(((state.ray_count > 1) | ranged) & near)


def _merge_round(task: _Task, state: State, across_labels: bool = False) -> State:
    if state.count < 2:
        return state
    target = merge_targets(state, task.gate, task.strays, across_labels)
    return state if (target == np.arange(len(target))).all() else _alternate(task, state.merge(target))


def _merge_all(task: _Task, state: State) -> State:
    for across_labels in (False, True) if task.settings.fuse_labels else (False,):
        for _ in range(_ROUNDS):
            before = state.count
            state = _merge_round(task, state, across_labels)
            if state.count == before:
                break
    return state


def _drop_all(task: _Task, state: State) -> tuple[State, Floats]:
    """Drop landmarks until all others are likely enough to exist. Also return the probability (N,) that each exists."""
    while True:
        likely = _existence(task, state)
        left = _drop(task, state, likely)
        if left.count == state.count:
            return left, likely
        state = left


def _drop(task: _Task, state: State, likely: Floats) -> State:
    """Drop landmarks whose probability (N,) is below association.min_existence.

    If two neighbours of one label both fail, the one with more rays is kept in this call. It may get boxes back from the
    other one, and the next call judges it again.
    """
    failing = likely < task.settings.min_existence
    if not failing.any():
        return state
    number, label = state.ray_count, state.label
    a, b = close_pairs(state, task.gate)
    rivals = failing[a] & failing[b] & (label[a] == label[b])
    keep = ~failing
    keep[np.where(number[a] > number[b], a, b)[rivals]] = True
    return _alternate(task, state.keep(keep))


def _result(state: State, existence: Floats, ray: Ints) -> Association:
    """Return the association with its objects in their final order. existence: (N,) probability of each landmark. ray: (R,)
    the ray of each observation."""
    counts, label = state.label_count, state.label
    first = np.full(len(label), len(ray))
    np.minimum.at(first, state.owner, state.assigned)
    order = np.lexsort((first, label))
    matched = np.append(np.argsort(order), -1)[state.matched][np.argsort(ray)]
    weights = counts[order] / np.maximum(counts[order].sum(axis=1, keepdims=True), 1)
    return Association(matched, label[order], weights, existence[order])

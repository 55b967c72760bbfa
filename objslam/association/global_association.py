"""Global association at known poses: assign rays to an unknown number of objects.

A search finds points where rays of one label meet, and the best points become landmarks. Then landmarks are merged, fused
across labels or dropped, if this explains the boxes and the misses at a lower cost. At the end, the sizes of boxes decide
between landmarks that bearings do not tell apart.
"""

from dataclasses import dataclass, replace
from itertools import count, islice

import numpy as np

from objslam import config
from objslam.association.crossings.exchanged_rays import annealed, learned
from objslam.association.crossings.ghost_pairs import replace_ghosts
from objslam.association.crossings.one_or_two import find_crossings, without_smaller_bundles
from objslam.association.existence import beyond_chance, existence, rest_odds
from objslam.association.gating import alternate, gate_limit, near, size_costs
from objslam.association.hypothesis_search import WRONG_RANGE, Search, discover, ranged_by_size
from objslam.association.label_fusion import fused_labels
from objslam.association.landmarks import Landmarks, State
from objslam.association.merging import better_neighbours, merge_targets
from objslam.association.observations import Observations, PosedRays, observe
from objslam.association.refinement import right_by_chance
from objslam.association.visibility import frames_of
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lengths
from objslam.core.ground.flattening import flattened_points
from objslam.core.rotation import cross
from objslam.core.statistics import grouped_quantile, grouped_sums
from objslam.core.types import Association

_TURNS = 8
"""The most searches of one kind among unassigned rays. They end when a search finds none. A larger number may find more."""
_ROUNDS = 12  # The most rounds of merging and dropping. Without a limit, they could repeat for ever.
_SAMPLE = 4096
"""The most rays of one label that a search uses, in whole frames. Later searches use other frames. More rays are slower."""
_FRAMES = 12
"""The fewest frames that a search uses, because an object is where rays of several frames meet. More frames are slower."""
_MOST_RAYS = 1 << 14  # The most rays of one label that a search uses if frames have many rays. A larger value costs time.
_MIN_SUPPORT = 2.5
"""The least support of a point in a search. A ray that fits perfectly counts 1. A larger value finds fewer points."""
_ABOVE_CHANCE = 3.0
"""The least excess of a point's support over that of stray rays, in standard deviations. A larger one finds surer points."""
_CHANCE_ODDS = 3.0  # The least log odds of a landmark against stray rays during the search. A larger one drops weak objects.
_CLEAR_MOTION = 3.0
"""Several points at rest are tried for rays if the log odds of a moving point over one point at rest exceed this value. A
smaller value tries more often, which takes time."""
_EXPLAINED = 0.9
"""The least share of the rays of moving points that points at rest must explain to replace them. With a smaller share, parts
of the path of a moving thing become objects. With a larger share, wrong boxes keep things at rest from being found."""
_PARALLAX = np.radians(2.0)  # The least angle (rad) between the rays of a pair. A larger angle finds fewer, surer points.


@dataclass(frozen=True)
class _Task:
    """The constants of one association. gate: the largest squared deviation of a match. device: the setting
    `triangulation.device`. seed: the seed of the random ray pairs. ranged: the rays with the ranges that count in the
    first searches."""

    gate: float
    settings: config.AssociationSettings
    device: str
    seed: int
    ranged: Observations


def associate_globally(
    of: PosedRays,
    settings: config.Settings,
    *,
    seed: int = 0,
    guess: tuple[Association, Floats] | None = None,
    drifts: bool = False,
    solved: bool = False,
    repaired: bool = False,
) -> Association:
    """Assign rays to objects at known camera poses.

    Objects are sorted by label, then by their first frame. Rays that no static object explains get no object. The order of
    rays and keyframes does not matter.

    Args:
        seed: the seed of the random pairs of rays.
        guess: an initial association of the rays, and the positions (N, 3) m of its objects. NaN drops an object.
        drifts: whether the poses drift as the odometry does, so that objects at rest seem to move.
        solved: whether the poses are from a joint solve. The rays of one thing meet there, as at localised poses.
        repaired: whether the guess has no landmarks at crossings of rays. Skipping the search for them halves the time.
    """
    rays, keyframes, cameras = of.rays, of.keyframes, of.cameras
    obs, ray, keyframe = observe(of)
    view = frames_of(keyframes, keyframe, cameras, of.map_T_camera, settings, drifts=drifts, cut=rays.cut)
    nothing = Landmarks.none(len(rays.label_names))
    state = State(obs, view, nothing, np.full(len(ray), -1, dtype=np.int64))
    sized = np.array([c.sees_size for c in cameras])[keyframes.camera[rays.keyframe[ray]]]
    gate = gate_limit(settings.association.gate)
    ranged = ranged_by_size(obs, sized, gate, _PARALLAX, seed) if view.localized else obs
    task = _Task(gate, settings.association, settings.triangulation.device, seed, ranged)
    if guess is not None:
        association, position = guess
        known = flattened_points(position, of.scale), np.ones(len(position)), association.label
        state = replace(state, landmarks=Landmarks.new(*known, len(rays.label_names)), matched=association.object[ray])
        state = _alternate(task, learned(state.keep(_plausible(task, state))))
    state, refuted, moving = _search(task, state, nothing)
    if moving.count and keyframes.localized_every:  # At poses that drift, things at rest seem to move.
        state, refuted = _at_rest(task, state, refuted, moving)
    state, likely, dropped = _merged_and_dropped(task, _add_distant(task, state))
    refuted |= dropped
    # At poses that drift, the rays of one thing fall into bundles that do not meet.
    if (solved or keyframes.localized_every) and not repaired:
        for repair in (_without_crossings, _without_ghosts):
            state, likely, dropped = repair(task, state, likely, sized)
            refuted |= dropped
    if state.ratio is not None:
        state, likely = _drop_all(task, annealed(state, task.gate, lambda now: _alternate(task, now)))
    if settings.association.fuse_labels:
        accepts = fused_labels(state, task.gate)
        if (accepts != state.landmarks.accepts).any():
            fused = replace(state, landmarks=replace(state.landmarks, accepts=accepts))
            state, likely = _drop_all(task, _alternate(task, fused))
    state, likely = _by_size(task, state, likely, sized)
    if solved or keyframes.localized_every:
        # This step comes last. The things of these bundles get no landmarks, so a later assignment would undo the step.
        state, likely = _kept(task, without_smaller_bundles(state, sized), likely)
    return replace(_result(state, likely, ray), refuted=(refuted & (state.matched < 0))[np.argsort(ray)])


def _search(task: _Task, state: State, excluded: Landmarks) -> tuple[State, Bools, State]:
    """Search for landmarks, and drop unlikely ones, until a search finds none. excluded: landmarks that must not be found.

    A robot that passes a row of equal things sees one thing after another in the same direction. These rays meet far away,
    at a point with more rays than each thing, but no range confirms the point. So at localised poses, a ray whose range is
    wrong for a point gives it no support in the first searches. `ranged_by_size` may give missing ranges. In later searches,
    and at poses that drift, wrong ranges only lower the support. With drift, a right range may seem wrong on a later visit.

    Also returns the rays (R,) that belonged to a dropped landmark, and the landmarks that seemed to move, with their rays.
    """
    refuted, moving = np.zeros(len(state.matched), dtype=bool), state.keep(np.zeros(state.count, dtype=bool))
    strict = state.view.localized and np.isfinite(task.ranged.range).any()
    turns = count()
    for share in (1.0, WRONG_RANGE) if strict else (WRONG_RANGE,):
        for turn in islice(turns, _TURNS):
            before = state.count
            state = _alternate(task, _discover(task, state, turn, _PARALLAX, excluded, share), 2)
            state = _merge_round(task, learned(state.keep(beyond_chance(state, task.gate, _CHANCE_ODDS))))
            likely = existence(state, task.gate)
            moving = moving.joined(state.keep(_seems_to_move(task, state, likely)))
            kept = _drop(task, state, likely)
            refuted |= (state.matched >= 0) & (kept.matched < 0)
            state = kept
            if state.count <= before:
                break
    return state, refuted, moving


def _seems_to_move(task: _Task, state: State, likely: Floats) -> Bools:
    """Return which landmarks (N,) are unlikely to exist, while a moving point explains their rays clearly better."""
    unlikely = likely < task.settings.min_existence
    return unlikely & (rest_odds(state) < -_CLEAR_MOTION) if unlikely.any() else unlikely


def _at_rest(task: _Task, state: State, refuted: Bools, moving: State) -> tuple[State, Bools]:
    """Replace landmarks that seem to move by several at rest, if these explain nearly all of their rays.

    The rays to two things of one label may cross between the two things. If the things are seen at different times, a point
    at the crossing seems to move from one thing to the other. This point can have more rays than each thing, so every search
    finds it. Points at rest explain only parts of the path of a thing that really moves.
    """
    left = state.keep(~_seems_to_move(task, state, existence(state, task.gate)))
    other, more, _ = _search(task, left, moving.landmarks)
    label, labels = state.obs.label[moving.assigned], len(state.unassigned)
    held = np.bincount(label[other.matched[moving.assigned] >= 0], minlength=labels)
    better = held > _EXPLAINED * np.bincount(label, minlength=labels)
    state = state.keep(~better[state.label]).joined(other.keep(better[other.label]))
    return state, (refuted | more) & (state.matched < 0)


def _discover(
    task: _Task,
    state: State,
    turn: int,
    parallax: float,
    excluded: Landmarks | None = None,
    wrong_range: float = WRONG_RANGE,
) -> State:
    """Add landmarks where unassigned rays of one label agree. turn: the number of the search, which changes the random
    pairs. parallax, wrong_range: as in `Search`. excluded: landmarks that must not be found."""
    obs, noise, landmarks = state.obs, state.class_noise, state.landmarks
    for label in np.flatnonzero(state.unassigned).tolist():
        free = np.flatnonzero((obs.label == label) & (state.matched < 0))
        if len(free) < task.settings.min_rays:
            continue
        rng = np.random.default_rng([task.seed, turn, label])
        if len(free) > _SAMPLE:
            frames = np.unique(obs.frame[free])
            some = rng.permutation(frames)[: max(int(len(frames) * _SAMPLE / len(free)), _FRAMES)]
            free = free[np.isin(obs.frame[free], some)]
        if len(free) > _MOST_RAYS:
            free = np.sort(rng.permutation(free)[:_MOST_RAYS])
        pool, judged = obs.take(free).noisier(noise[label]), None
        # About `chance` stray rays pass any point within the gate, and each supports it by 0.5 on average.
        chance = np.pi * task.gate * float((pool.sigma**2).sum()) / (state.view.solid_angle * obs.scale)
        if wrong_range == 1.0:  # Then most strays do not count, because their ranges are wrong for the point.
            judged = task.ranged.take(free).noisier(noise[label])
            chance *= float(right_by_chance(judged).mean())
        support = max(_MIN_SUPPORT, 0.5 * (chance + _ABOVE_CHANCE * np.sqrt(chance)))
        search = Search(task.settings.hypotheses, support, task.gate, parallax, task.device, wrong_range)
        known = None if excluded is None else excluded.position[excluded.accepts[:, label]]
        points = discover(pool, search, rng, known, judged)
        new = Landmarks.new(points, np.full(len(points), noise[label]), np.full(len(points), label), len(noise))
        landmarks = landmarks.and_also(new) if len(points) else landmarks
    return state if landmarks is state.landmarks else replace(state, landmarks=landmarks)


def _add_distant(task: _Task, state: State) -> State:
    """Add landmarks where rays without parallax agree: those of distant objects, or of a robot that hardly moves."""
    known = state.count
    state = _alternate(task, _discover(task, state, _TURNS, 0.0), 2)
    index, direction = state.owner, state.obs.direction[state.assigned]
    mean = grouped_sums(direction, index, state.count)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    off = lengths(cross(direction, mean[index]))
    narrow = np.nan_to_num(grouped_quantile(off, index, len(mean), 1.0)) < np.sin(_PARALLAX)
    state = state.keep(narrow | (np.arange(len(narrow)) < known))
    return state.keep(beyond_chance(state, task.gate, _CHANCE_ODDS))


def _alternate(task: _Task, state: State, times: int = 3) -> State:
    return alternate(state, task.gate, lambda now: _plausible(task, now), times)


def _by_size(task: _Task, state: State, likely: Floats, sized: Bools) -> tuple[State, Floats]:
    """Assign the rays once more, by bearing and size. likely: (N,) probability that each landmark exists. The landmarks with
    enough rays and their probabilities are returned.

    Sizes count only here, at the end. Before the end, an often hidden landmark needs all its rays, or it would be dropped.
    sized: (R,) whether the camera of each ray sees sizes.
    """
    obs = state.obs
    every = alternate(
        replace(state, obs=replace(obs, size=np.where(sized[:, None], obs.size, 0.0))),
        task.gate,
        lambda now: np.ones(now.count, dtype=bool),
        unmatched=lambda now, edges: task.gate - size_costs(now, edges),
    )
    return _kept(task, replace(every, obs=obs), likely)


def _plausible(task: _Task, state: State) -> Bools:
    """Return which landmarks (N,) have enough rays and are near enough. Farther away, only parallel rays meet."""
    return (state.ray_count >= task.settings.min_rays) & near(state)


def _kept(task: _Task, state: State, likely: Floats) -> tuple[State, Floats]:
    """Return the plausible landmarks, and their probabilities to exist. likely: (N,) the probabilities of all landmarks."""
    stays = _plausible(task, state)
    return state.keep(stays), likely[stays]


def _merge_round(task: _Task, state: State, across_labels: bool = False) -> State:
    if state.count < 2:
        return state
    target = merge_targets(state, task.gate, across_labels)
    return state if (target == np.arange(len(target))).all() else _alternate(task, state.merge(target))


def _merge_all(task: _Task, state: State) -> State:
    for across_labels in (False, True) if task.settings.fuse_labels else (False,):
        for _ in range(_ROUNDS):
            before = state.count
            state = _merge_round(task, state, across_labels)
            if state.count == before:
                break
    return state


def _merged_and_dropped(task: _Task, state: State) -> tuple[State, Floats, Bools]:
    """Merge and drop landmarks until none is left to drop. Also return existence (N,), and the rays (R,) of dropped ones."""
    refuted = np.zeros(len(state.matched), dtype=bool)
    for _ in range(_ROUNDS):  # Without the rays of a dropped landmark, two other landmarks may turn out to be one object.
        merged = _merge_all(task, state)
        state, likely = _drop_all(task, merged)
        refuted |= (merged.matched >= 0) & (state.matched < 0)
        if state.count == merged.count:
            break
    return state, likely, refuted


def _without_ghosts(task: _Task, state: State, likely: Floats, sized: Bools) -> tuple[State, Floats, Bools]:
    """Replace pairs of landmarks at crossings by the two things whose rays cross there. Return what `_without_crossings`
    returns."""
    refuted, earlier, tried = np.zeros(len(state.matched), dtype=bool), set[bytes](), set[bytes]()
    while len(earlier) < _TURNS and (key := state.matched.tobytes()) not in earlier:
        earlier.add(key)
        replaced = replace_ghosts(state, task.gate, tried, task.seed)
        if replaced is state:
            break
        state, likely, dropped = _merged_and_dropped(task, _alternate(task, replaced))
        refuted |= dropped
    return state, likely, refuted


def _without_crossings(task: _Task, state: State, likely: Floats, sized: Bools) -> tuple[State, Floats, Bools]:
    """Split landmarks that are two things whose rays cross. Then search again among the rays that this sets free.

    Return what `_merged_and_dropped` returns. likely: (N,). sized: (R,) whether the camera of each ray sees sizes.
    """
    refuted, earlier = np.zeros(len(state.matched), dtype=bool), set[bytes]()
    tries = np.zeros(len(state.matched), dtype=np.int64)
    while (key := state.matched.tobytes()) not in earlier:  # Rays may return to the landmark that they left.
        earlier.add(key)
        found = find_crossings(state, sized, task.settings.min_rays)
        two = found.untried(state, tries)
        if len(earlier) > _TURNS or not two.any():
            break
        split = _alternate(task, state.split(found.landmark[two], found.second, found.position[two]))
        searched, lost, _ = _search(task, split, split.landmarks.take(np.zeros(0, dtype=np.int64)))
        state, likely, dropped = _merged_and_dropped(task, searched)
        refuted |= lost | dropped
    return state, likely, refuted


def _drop_all(task: _Task, state: State) -> tuple[State, Floats]:
    """Drop landmarks until all left are likely enough to exist. Also return the probability (N,) that each exists."""
    while True:
        likely = existence(state, task.gate)
        left = _drop(task, state, likely)
        if left.count == state.count:
            return left, likely
        state = left


def _drop(task: _Task, state: State, likely: Floats) -> State:
    """Drop landmarks whose probability (N,) is below association.min_existence, except for `better_neighbours`. The next
    call judges these again."""
    failing = likely < task.settings.min_existence
    if not failing.any():
        return state
    return _alternate(task, state.keep(~failing | better_neighbours(state, failing, task.gate)))


def _result(state: State, existence: Floats, ray: Ints) -> Association:
    """Return the association with its objects in their final order. existence: (N,). ray: (R,) of each observation."""
    counts, label = state.label_count, state.label
    first = np.full(len(label), len(ray))
    np.minimum.at(first, state.owner, state.assigned)
    order = np.lexsort((first, label))
    matched = np.append(np.argsort(order), -1)[state.matched][np.argsort(ray)]
    weights = counts[order] / np.maximum(counts[order].sum(axis=1, keepdims=True), 1)
    return Association(matched, label[order], weights, existence[order])

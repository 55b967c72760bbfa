"""Find objects from few rays, among the rays to which the global association gave no object.

The objects of the global association stay as they are. A new object may have any number of rays, but it has to be likelier
than stray boxes that meet by chance.
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam import config
from objslam.association.appearance.evidence import learn_ratio
from objslam.association.existence import rates_of_classes, static_odds
from objslam.association.few_rays.chance import Strays, chance_odds, log_evidence, unmatched_costs
from objslam.association.few_rays.place_errors import moments, place_errors
from objslam.association.few_rays.sparse_search import SparseSearch, discover_sparse
from objslam.association.gating import alternate, gate_limit, near
from objslam.association.landmarks import Landmarks, State
from objslam.association.merging import better_neighbours, merge_targets
from objslam.association.observations import PosedRays, observe
from objslam.association.refinement import refine
from objslam.association.visibility import frames_of
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.ground.flattening import flattened_points
from objslam.core.statistics import logistic
from objslam.core.types import Association

_MOVING = 6
"""The number of coordinates of a moving point: three of its position and three of its velocity. Such a point explains any
three rays."""
_ROUNDS = 12  # The most rounds of merging and dropping. Without a limit, they could repeat for ever.
_TURNS = 8
"""The most searches among the unassigned rays. No further search follows one that finds nothing. A larger number may find
more."""
_POWER = 0.4
"""The log odds against strays are multiplied by this factor, and then become a probability. The factor is below 1, because
boxes of near objects mix, so strays are not independent. On 10 simulated streets (`tools/bench_association.py`), 0.4 makes
the probabilities about 0.1 too large. A larger factor makes the probabilities larger."""
_PLACE_ROUNDS = 2
"""The number of rounds that correct the places and repeat the search. A third round gave the same objects on 30 simulated
streets. A larger number takes longer."""
_FIRST = 0.7
"""The noise of the places in the first search, as a share of the noise in the settings. With wide gates, near objects become
one object, and then the rays show no errors of places. On 30 simulated streets with the right noise in the settings, 0.7 and
1 give the same objects. With 1.2 times the true noise in the settings, 0.7 is better. With a smaller share, unusually large
errors are not found."""
_SAMPLE = 512  # The most rays of one label in a search. The time grows with the square of this number.
_PARALLAX = np.radians(2.0)  # The least angle (rad) between the rays of a pair. A larger angle finds fewer, surer points.


def add_few_ray_objects(
    of: PosedRays, settings: config.Settings, association: Association, positions: Floats, *, seed: int = 0
) -> Association:
    """Add the objects that can be found from a few unassigned rays. They come after the other objects.

    The association stays as it is in four cases. The poses are not localised. The settings do not allow the search. The
    association has no probability that its objects exist. Too few rays are free for another object.

    positions: (N, 3) m of the objects, NaN where unknown. seed: the seed of the random pairs of rays.
    """
    if association.existence is None or not (settings.association.few_rays and of.keyframes.localized_every):
        return association
    free = np.flatnonzero(_free(association))
    enough = np.bincount(of.rays.label[free]).max(initial=0) > 1  # Two rays of one label, as `_plausible` asks.
    if not enough and not np.isfinite(of.rays.range[free]).any():
        return association
    few, ray = _few(of, settings, association, positions)
    few, found = few.search(settings.association.min_existence, seed)
    old, new = association.count, found.count
    index = association.object.copy()
    index[ray[few.free]] = np.where(found.matched < 0, -1, found.matched + old)
    weights = found.label_count / np.maximum(found.ray_count, 1)[:, None]
    shares = association.label_weights
    return replace(
        association,
        object=index,
        label=np.append(association.label, found.label),
        label_weights=None if shares is None else np.concatenate([shares, weights]),
        existence=np.append(association.existence, few.existence(found)),
        few_rays=np.arange(old + new) >= old,
    )


@dataclass(frozen=True)
class FewRayEvidence:
    """The measures of how well the objects that a search finds among all rays explain the boxes.

    chance: the log odds of these objects over boxes that are all stray. detections: ln of the probability of the objects'
    detections and misses. explained: the share of the boxes with an object. ray, owner: (P,) the rays with an object, and
    their objects. moment: (P,) the index of the moment of each ray. shift: (P, 3) m, from the given to the corrected origin
    of each ray. positions: (N, 3) m of the objects.
    """

    chance: float
    detections: float
    explained: float
    ray: Ints
    owner: Ints
    moment: Ints
    shift: Floats
    positions: Floats


def few_ray_evidence(
    of: PosedRays, settings: config.Settings, *, seed: int = 0, correct_places: bool = False
) -> FewRayEvidence:
    """Return the evidence of all objects that a search for few rays finds.

    correct_places: whether to correct the places from which the objects were seen. The evidence is always computed at the
    given places, where each ray has its own error.
    """
    nothing = Association(np.full(len(of.rays), -1), np.zeros(0, dtype=np.int64))
    few, ray = _few(of, settings, nothing, np.zeros((0, 3)))
    given, least = few.known.obs, settings.association.min_existence
    few, landmarks = few.search(least, seed) if correct_places else (few, few.search_once(least, seed))
    found = few.joined(landmarks)
    held = found.assigned
    moment, shift = moments(found)[held], (found.obs.origin - given.origin)[held]
    members = ray[held], found.owner, moment, shift, found.landmarks.position
    if correct_places:
        found = replace(found, obs=given)
        at = refine(given, held, found.owner, found.landmarks.position, found.landmarks.noise)
        found = replace(found, landmarks=replace(found.landmarks, position=at))
    if not found.count:
        return FewRayEvidence(0.0, 0.0, 0.0, *members)
    rates = rates_of_classes(found)
    chance = log_evidence(found, few.gate, few.strays, rates)
    explained = float((found.matched >= 0).mean())
    return FewRayEvidence(chance, rates.log_likelihood(found.history, found.label), explained, *members)


def _few(of: PosedRays, settings: config.Settings, association: Association, positions: Floats) -> tuple["_Few", Ints]:
    """Return the search of `add_few_ray_objects`, and for each observation the index (P,) of its ray."""
    rays = of.rays
    obs, ray, keyframe = observe(of)
    positions = flattened_points(positions, obs.scale)
    view = frames_of(of.keyframes, keyframe, of.cameras, of.map_T_camera, settings, cut=rays.cut)
    known = np.isfinite(positions).all(axis=1)
    labels = len(rays.label_names)
    held = Landmarks.new(positions[known], np.ones(known.sum()), association.label[known], labels)
    state = State(obs, view, held, np.append(np.where(known, np.cumsum(known) - 1, -1), -1)[association.object[ray]])
    ratio = learn_ratio(obs, obs.frame, obs.track, association.object[ray], labels)
    state = replace(state, landmarks=replace(held, noise=state.noise), ratio=ratio)
    strays = Strays.of(obs, view, labels)
    return _Few(state, np.flatnonzero(_free(association)[ray]), strays, gate_limit(settings.association.gate)), ray


def _free(association: Association) -> Bools:
    """Return which rays (R,) may show further objects: those without an object, unless their object was refuted."""
    free = association.object < 0
    return free if association.refuted is None else free & ~association.refuted


@dataclass(frozen=True)
class _Few:
    """A search for more landmarks beside known ones. free: (F,) the rays that may show such landmarks. strays: the density
    of stray rays. gate: the largest squared deviation of a match."""

    known: State
    free: Ints
    strays: Strays
    gate: float

    def search(self, least: float, seed: int) -> tuple["_Few", State]:
        """Return the landmarks of the free rays whose probability to exist is not below `least`.

        The landmarks show the errors of the places from which they were seen. After a correction of these errors, a landmark
        may turn out to be several things. So the errors are corrected, and the search is repeated. Also return the search
        from the corrected places.
        """
        obs = self.known.obs
        if not obs.position_sigma:
            return self, self.search_once(least, seed)
        few = replace(self, known=replace(self.known, obs=replace(obs, position_sigma=_FIRST * obs.position_sigma)))
        found = few.search_once(least, seed)
        for _ in range(_PLACE_ROUNDS if found.count else 0):
            few = self.with_places_of(few.joined(found))
            found = few.search_once(least, seed)
        return few, found

    def with_places_of(self, joined: State) -> "_Few":
        """Return the search from corrected places. joined: all landmarks, known and new. They show the errors of the
        places."""
        obs = self.known.obs
        errors = place_errors(replace(joined, obs=obs))
        left = float(np.sqrt((errors.sigma[errors.place] ** 2).mean()))
        origin = obs.origin + errors.offset[errors.place]
        return replace(self, known=replace(self.known, obs=replace(obs, origin=origin, position_sigma=left)))

    def search_once(self, least: float, seed: int) -> State:
        """Return the landmarks of the free rays that are found from the present places."""
        labels, obs = len(self.known.unassigned), self.known.obs.take(self.free)
        found = State(obs, self.known.view, Landmarks.none(labels), np.full(len(obs), -1, dtype=np.int64), self.known.ratio)
        for turn in range(_TURNS):
            before = found.count
            found = self.settled(self.discover(found, np.random.default_rng([seed, turn])), 2)
            found = self.dropped(self.merged(found), least)
            if found.count <= before:
                break
        for _ in range(_ROUNDS):
            before = found.count
            found = self.dropped(self.settled(self.merged(found)), least)
            if found.count == before:
                break
        return found

    def discover(self, found: State, rng: np.random.Generator) -> State:
        """Add landmarks where few unassigned rays of one label agree."""
        obs, noise, landmarks = found.obs, self.known.class_noise, found.landmarks
        strays = self.strays.take(self.free)
        for label in np.flatnonzero(found.unassigned).tolist():
            rays = _some_frames(obs.frame, np.flatnonzero((obs.label == label) & (found.matched < 0)), rng)
            pool = obs.take(rays).noisier(noise[label])
            search = SparseSearch(strays.take(rays), float(found.unassigned[label]), self.gate, _PARALLAX, 0.0)
            points = discover_sparse(pool, search)
            new = Landmarks.new(points, np.full(len(points), noise[label]), np.full(len(points), label), len(noise))
            landmarks = landmarks.and_also(new)
        return replace(found, landmarks=landmarks)

    def settled(self, found: State, times: int = 3) -> State:
        """Alternate between assignment and refinement."""
        strays = self.strays.take(self.free)
        return alternate(
            found, self.gate, _plausible, times, lambda now, edges: unmatched_costs(now, edges, strays, self.gate)
        )

    def merged(self, found: State) -> State:
        """Merge new landmarks that are one object. Drop those whose object has a known landmark."""
        every, known = self.joined(found), self.known.count
        if every.count < 2:
            return found
        target = merge_targets(every, self.gate, across_labels=False)
        taken = np.zeros(every.count, dtype=bool)
        taken[target[:known]] = True
        taken[known:] |= target[known:] < known
        own = np.where(target >= known, target - known, np.arange(every.count) - known)[known:]
        return found.merge(own).keep(~taken[known:][own == np.arange(found.count)])

    def dropped(self, found: State, least: float) -> State:
        """Drop landmarks until all landmarks left are likely enough to exist. `better_neighbours` stay for one more turn."""
        while (failing := self.existence(found) < least).any():
            left = self.settled(found.keep(~failing | better_neighbours(found, failing, self.gate)))
            if left.count == found.count:
                return self.settled(found.keep(~failing))
            found = left
        return found

    def existence(self, found: State) -> Floats:
        """Return the probability (N,) that each new landmark is a static object, and not strays that meet by chance."""
        every = self.joined(found)
        rates = rates_of_classes(every)
        odds = chance_odds(every, self.gate, self.strays, rates) + _alike_odds(every)
        return np.asarray(logistic(static_odds(every, self.gate, fitted=_MOVING)) * logistic(_POWER * odds))[
            self.known.count :
        ]

    def joined(self, found: State) -> State:
        """Return the known landmarks, followed by the new ones."""
        matched = self.known.matched.copy()
        matched[self.free] = np.where(found.matched < 0, -1, found.matched + self.known.count)
        return replace(self.known, landmarks=self.known.landmarks.and_also(found.landmarks), matched=matched)


def _alike_odds(state: State) -> Floats:
    """Return the log odds (N,) that the rays of each landmark show one object, from their appearance. 0 without vectors."""
    if state.looks is None:
        return np.zeros(state.count)
    each = state.looks.ray_odds(state.obs, state.assigned, state.owner, np.ones(len(state.owner), dtype=bool))
    number = np.maximum(state.looks.number, 1)
    # The first ray of a landmark has no ray to be compared with. The sum compares each ray with all others.
    return np.asarray(np.bincount(state.owner, each, state.count) * (number - 1) / number)


def _plausible(state: State) -> Bools:
    """Return which landmarks (N,) have two rays or a range, and are near enough."""
    ranged = np.bincount(state.owner, np.isfinite(state.obs.range[state.assigned]), state.count) > 0
    return np.asarray(((state.ray_count > 1) | ranged) & near(state))


def _some_frames(frame: Ints, rays: Ints, rng: np.random.Generator) -> Ints:
    """Return the rays of a random part of the frames if there are more than `_SAMPLE` rays."""
    if len(rays) <= _SAMPLE:
        return rays
    order = rng.permutation(np.unique(frame[rays]))
    number = np.cumsum(np.bincount(frame[rays], minlength=int(frame[rays].max()) + 1)[order])
    chosen = rays[np.isin(frame[rays], order[: max(int(np.searchsorted(number, _SAMPLE)), 2)])]
    return chosen if len(chosen) <= _SAMPLE else np.sort(rng.permutation(chosen)[:_SAMPLE])

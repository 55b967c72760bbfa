"""Drop phantoms, or warn of them. A phantom is an object where rays of several things meet, because the poses err."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.noise import NoiseFactors
from objslam.core.statistics import grouped_median
from objslam.mapping.checks.finding import NEIGHBOURS, Finding
from objslam.mapping.joint.relocalization import Relocalization
from objslam.mapping.moves.odometry_witness import lasting_by_odometry, lasting_long

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.arrays import Floats, Ints
    from objslam.core.types import Association
    from objslam.frontend.shared_errors import SharedErrors
    from objslam.mapping.joint.joint_alternation import JointState
    from objslam.mapping.solution import Solution

_LARGE = 1.0
"""The least size of a localisation's errors that last for seconds, as a multiple of the noise `localization`, at which
phantoms are searched. At 1, the lasting errors alone are as large as all errors together should be. With a larger value,
fewer maps take the time of the search."""
_APART = 2.0
"""The least distance between two things of one label that can be distinguished, as a multiple of the shift of their rays.
Lasting errors of poses shift the rays to a thing, and the shift grows with its distance. A ray errs by more than 2 standard
deviations in 5 % of the cases. With a larger value, runs warn of more maps."""
BENT = "a path that may be bent to false objects"
"""The name of the finding that the odometry contradicts both the poses and the boxes. The path may then be bent, because
some labels have several objects."""
_BENT = 3.0
"""The least factor on the noise of the odometry at which a run warns of false objects. A path that is bent to false objects
hides how far the poses err. An earlier map at the given poses must also have shown that the poses err. At 3, the settings
explain only a ninth of the variance. With a larger value, runs warn of fewer maps."""
UNTOLD = "errors of poses that the solve does not show"
"""The name of the finding that a map at the given poses shows large errors of the poses, and the solved map shows none."""
_MOST = 60
"""The most objects that are tried as phantoms. The least likely objects are tried first. Each object takes a search of the
path and a solve. With a larger number, more phantoms are found in large maps, and the search takes longer."""
_LOST = 0.5
"""The largest share of a phantom's rays that find no other object when the phantom is taken out. Such rays count as false
boxes, which explains the log worse. Three phantoms of simulated drives had 0 to 0.2. Without an object that had more than
half, the log odds fell by 17 and more. With a larger share, more objects are tried with a solve."""
_COARSE = 100.0
"""The largest loss of log evidence on the most likely path with all objects, at which phantoms are searched. With a larger
loss, the path search is too coarse for the log, and each path without an object loses about as much. In 12 simulated drives
the path lost at most 20, and a dropped object gained at most 50. In a museum, it lost 360 or more with each of 60 objects
taken out. With a larger value, more logs take the time of the search."""


def has_lasting_errors(state: JointState) -> bool:
    """Return whether the noise of the state says that the localisation errs for seconds."""
    if state.errors is None or not state.keyframes.localized_every:
        return False
    return bool(max(state.errors.noise.lasting_factors) >= _LARGE)


def begins_with_lasting_errors(state: JointState) -> bool:
    """Return whether the odometry shows that the localisation errs for seconds, before any ray has an object. In a solve,
    false objects hide such errors."""
    return has_lasting_errors(state) and state.errors is not None and max(lasting_long(state.errors.noise)) >= _LARGE


def check_neighbours(
    solution: Solution, errors: SharedErrors | None, settings: Settings, earlier: tuple[float, float] | None = None
) -> Finding | None:
    """Return a finding if a localisation errs for seconds, and equal things are too near each other to be distinguished.

    During such errors, all rays pass their things on the same side, so a ray to one thing may point at its neighbour. A
    joint solve bends the path until such rays fit, so the residuals do not show the error. The odometry may show it, or an
    earlier map at the given poses. If only the earlier map shows errors, false objects may hide them from the solve. errors:
    the shared errors with all frames, before the solve. earlier: the errors of headings, rad, and of places, m, that an
    earlier map at the given poses showed.
    """
    keyframes, estimate, association = solution.keyframes, solution.estimate, solution.association
    noise = estimate.noise or NoiseFactors()
    number = np.bincount(association.label[np.isfinite(estimate.covariance[:, 0, 0])])
    if not keyframes.localized_every or number.max(initial=0) < 2:
        return None
    said = np.array([settings.localization.yaw, settings.localization.xy])
    size = np.maximum(noise.lasting_factors, lasting_by_odometry(errors)) * said
    if earlier is not None:  # These errors were a finding of the earlier map.
        size = np.maximum(size, earlier)
    elif (size < _LARGE * said).all():
        return None
    yaw, place = size.tolist()
    held = np.flatnonzero((estimate.weight > 0) & (association.object >= 0))
    owner, origins = association.object[held], estimate.map_T_base[solution.rays.keyframe[held], :3, 3]
    away = grouped_median(np.linalg.norm(estimate.positions[owner] - origins, axis=1), owner, association.count)
    shift = np.hypot(yaw * away, place)
    placed = np.flatnonzero(np.isfinite(estimate.covariance[:, 0, 0]) & np.isfinite(shift))
    apart = np.linalg.norm(estimate.positions[placed, None, :2] - estimate.positions[None, placed, :2], axis=2)
    equal = association.label[placed][:, None] == association.label[placed]
    equal &= ~np.eye(len(placed), dtype=bool)
    near = (apart < _APART * np.maximum(shift[placed][:, None], shift[placed])) & equal
    if not near.any() and earlier is not None and (bent := max(noise.along, noise.across, noise.turning)) >= _BENT:
        message = (
            f"{int(equal.any(axis=1).sum())} of {len(placed)} objects share their label with others, the localisation errs "
            f"for seconds, and the boxes agree only if the odometry is {bent:.1f} times as noisy as the settings say. The "
            "path may be bent to objects that are false"
        )
        return Finding(BENT, message, spoils=False)
    alone, seen = keyframes.odom_T_base is None, max(noise.heading, noise.place)
    if not near.any() and earlier is not None and alone and seen < np.hypot(1.0, _LARGE):
        message = (
            f"at the given poses, the boxes show that the localisation errs by {np.degrees(earlier[0]):.2g} deg and "
            f"{100 * earlier[1]:.2g} cm for seconds, but the solved map shows smaller errors. "
            f"{int(equal.any(axis=1).sum())} of {len(placed)} objects share their label with others, and may be false"
        )
        return Finding(UNTOLD, message, spoils=False)
    if not near.any():
        return None
    many = int(near.any(axis=1).sum())
    return Finding(
        NEIGHBOURS,
        f"{many} of {len(placed)} objects have a neighbour of the same label that is too near to be told apart, because the "
        f"localisation errs by {np.degrees(yaw):.2g} deg and {100 * place:.2g} cm for seconds. Their boxes may be "
        "exchanged, and objects may be missing or false",
        spoils=False,
    )


def without_phantoms(state: JointState) -> JointState:
    """Return the state without phantoms, or the state itself if there are none. Without its phantoms, the log is better
    `explained`.

    If headings err for seconds, a ray to one thing passes its neighbours. Rays to several things then meet at points without
    a thing, and a solve bends the path until they agree. Each ray then fits, so no round of association frees it. Here each
    object is taken out of the map in turn. The most likely path without the object gives its rays to other objects. If this
    explains the log better, the object is a phantom (`_without_least_likely`). The shared errors and the noise are fixed in
    these trials. The first trial keeps all objects. If its result is much worse, the path search is too coarse for the log
    (`_COARSE`), and the search ends. If its result is better, the other trials begin at this result. After
    `joint.max_solves` solves, the search ends, and the state is unfinished.
    """
    assert state.association is not None
    best = replace(state.attempt(), hold=state.errors is not None)
    best = begin = best.solve("association", state.association, state.solved_poses)
    assert best.estimate is not None
    search = Relocalization.of(best)
    if search is None:
        return state
    whole = _solved_along(best, *search.found())
    if whole.explained < best.explained - _COARSE:
        return state
    best = whole if whole.explained > best.explained else best
    best, unfinished = _without_least_likely(best, search, _candidates(state))
    if best is begin:
        return replace(state, unfinished=unfinished)
    assert best.association is not None
    assert best.estimate is not None
    guess = best.association, best.estimate.positions
    # Without an association, the first round is solved also if it agrees with the guess, which still lists the phantoms.
    rounds = replace(best, hold=state.hold, association=None).alternated(best.estimate.map_T_base, guess)
    return replace(state.better(rounds), unfinished=unfinished)


def _without_least_likely(begin: JointState, search: Relocalization, candidates: Ints) -> tuple[JointState, bool]:
    """Return the state without those candidates whose loss explains the log better. Also return whether the solves ended
    first.

    The candidate with the largest gain is dropped, again and again. Each loss changes the gains of the others. But a gain
    rarely grows, so a candidate is tried again only when its last gain is the largest (lazy greedy search; Minoux 1978). In
    a simulated warehouse with 60 candidates and ten phantoms, this took 69 trials.

    search: the path search of `begin`, or of a state with other poses.
    """
    best, top, number = begin, None, 0
    gains = {j: np.inf for j in candidates.tolist() if _is_placed(begin, j)}  # Infinite: not tried yet.
    while gains:
        j = max(gains, key=gains.__getitem__)
        if top is not None and j == top[0]:
            best, top = top[1], None
            gains = {i: gain for i, gain in gains.items() if i != j and _is_placed(best, i)}
            continue
        if best.spent:
            return best, True
        there = search if search.state is best else Relocalization.of(best)
        if there is None:
            break
        search, number = there, number + 1
        best.progress("phantoms", number, number + len(gains))
        other = _without(search, j)
        gains[j] = -np.inf if other is None else other.explained - best.explained
        if other is None or gains[j] <= 0:
            del gains[j]
        elif top is None or gains[j] >= gains[top[0]]:
            top = j, other
    return best, False


def _is_placed(state: JointState, j: int) -> bool:
    """Return whether object `j` has a position."""
    assert state.estimate is not None
    return bool(np.isfinite(state.estimate.positions[j, 0]))


def _candidates(state: JointState) -> Ints:
    """Return the objects that may be phantoms, with the least likely first. Only labels with several objects can have
    phantoms."""
    association, estimate = state.association, state.estimate
    assert association is not None
    assert estimate is not None
    placed = np.isfinite(estimate.positions[:, 0])
    several = np.bincount(association.label[placed], minlength=association.label.max(initial=0) + 1) > 1
    found = np.flatnonzero(placed & several[association.label])
    if association.existence is not None:
        found = found[np.argsort(association.existence[found], kind="stable")]
    return found[:_MOST]


def _without(search: Relocalization, j: int) -> JointState | None:
    """Return the state after a solve without object `j`, with the objects of the rays along the most likely path. Return
    None if most rays of the object find no other object (`_LOST`)."""
    state = search.state
    assert state.association is not None
    path, found = search.found(without=j)
    mine = (state.association.object == j) & state.agree
    if mine.any() and (found.object[mine] < 0).mean() > _LOST:
        return None
    return _solved_along(state, path, found)


def _solved_along(state: JointState, path: Floats, association: Association) -> JointState:
    """Return the state after a solve with the given objects of the rays. path: (K, 4, 4) map_T_base, where the solve
    begins. Each such state has a trace of its own, so that the rounds of trials that fail are not kept."""
    return state.attempt().counted(association).solve("association", association, path @ state.keyframes.base_T_camera)

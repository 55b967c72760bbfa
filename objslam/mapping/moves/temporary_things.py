"""Find things that were there for a part of the drive only, such as cars that parked.

Other visits to the place of such a thing do not show it, although they look at the place as the detections did."""

import numpy as np

from objslam.association.existence import looks_alike
from objslam.association.landmarks import State
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.result import Doubt, RunResult
from objslam.core.statistics import BETWEEN_VISITS
from objslam.mapping.moves.driven_through import first_names

_BOXES = 10
"""The fewest boxes of a thing that is judged. Fewer boxes hardly show how often a thing at rest is missed. With a larger
number, fewer things are named."""
_MISSES = 15
"""The fewest frames of other visits that look at the place as the detections did, and show no box of the thing. On a
simulated street with 20 cars that parked for a time, these cars had 16 to 32 such frames. Of 130 things that stayed and had
`_BOXES` boxes, two had more than 14, and both were confused with a car. With a larger number, fewer things are named."""
_FACTOR = 3
"""The least number of these frames, as a multiple of the most frames without a box between two boxes of the thing. In
between, the thing was there, so these frames show how something hides it, or how a detector misses it. With a larger
multiple, fewer things are named."""


def there_for_a_time(result: RunResult, state: State, objects: Ints, paired: set[int]) -> list[Doubt]:
    """Return a doubt for each object that was probably not there before its first visit, or after its last one.

    state: the state of N objects. objects: (N,) the indices of the objects in the map. paired: the ids of objects that
    another doubt explains. One of them may be a second object of a thing, at another place.
    """
    history, stamps, places = state.history, state.view.stamps, state.view.map_T_camera[:, :2, 3]
    bounds = np.searchsorted(history.object, np.arange(state.count + 1))
    found = []
    for k, j in enumerate(objects.tolist()):
        rows = slice(bounds[k], bounds[k + 1])
        frame, detected, thing = history.frame[rows], history.detected[rows], state.landmarks.position[k, :2]
        item = result.map.objects[j]
        if item.id in paired or detected.sum() < _BOXES:
            continue
        before, after = _other_visits(stamps[frame], detected)
        if max(before.sum(), after.sum()) < _MISSES:
            continue
        alike = looks_alike(places[frame], detected, thing)
        least = max(_MISSES, _FACTOR * _longest_gap(detected[alike]))
        absent = {"before": int((before & alike).sum()), "after": int((after & alike).sum())}
        if max(absent.values()) >= least:
            first, last = stamps[frame][detected].min(), stamps[frame][detected].max()
            rays = np.flatnonzero(result.association.object == j)
            found.append(_in_words(item.label, item.id, item.position, rays, (float(first), float(last)), absent, least))
    return found


def _other_visits(stamps: Floats, detected: Bools) -> tuple[Bools, Bools]:
    """Return which frames (n,) are of visits before that of the first detection, and after that of the last one."""
    first, last = stamps[detected].min(), stamps[detected].max()
    return stamps < first - BETWEEN_VISITS, stamps > last + BETWEEN_VISITS


def _longest_gap(detected: Bools) -> int:
    """Return the most frames between two detections that follow each other."""
    return int(np.diff(np.flatnonzero(detected)).max(initial=1)) - 1


def _in_words(
    label: str,
    number: int,
    position: Floats,
    rays: Ints,
    seen: tuple[float, float],
    absent: dict[str, int],
    least: int,
) -> Doubt:
    """Return the doubt about an object. seen: s, the stamps of its first and its last box. absent: the numbers of frames
    without it, before and after. least: the number of frames that is enough."""
    said = []
    if absent["before"] >= least:
        said.append(f"before its first box, at stamp {seen[0]:.3f}, {absent['before']} frames")
    if absent["after"] >= least:
        said.append(f"after its last box, at stamp {seen[1]:.3f}, {absent['after']} frames")
    came, left = absent["before"] >= least, absent["after"] >= least
    what = "came and left" if came and left else "came" if came else "left"
    return Doubt(
        "moved",
        what,
        label,
        f"{label} #{number} was probably there for a part of the drive only: {', and '.join(said)} look at its place as the "
        f"detections did, and do not show it. It {what}, or something else hides it then.",
        (number,),
        position,
        rays,
        {"frames_before": float(absent["before"]), "frames_after": float(absent["after"])},
    )


def in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentence of the assessment about these objects, as a list that is empty without doubts."""
    if not doubts:
        return []
    names = first_names([f"{one.label} #{one.objects[0]}" for one in doubts])
    return [f"Probably there for a part of the drive only: {names} (`objslam explain`)."]

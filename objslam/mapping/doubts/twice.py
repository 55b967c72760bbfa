"""Find a place that a map holds twice: the robot lost it, was carried, or its odometry restarted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import ObjectMap

if TYPE_CHECKING:
    from objslam.association.registration.map_registration import Registration

_FEWEST = 4
"""The fewest objects of each part. Three common objects are never evidence enough for a registration. A larger number saves
time, and misses more losses if there are few objects."""
_SPANNING = 0.5
"""The largest share of objects that both parts of the drive show. After a loss, an object is in both parts only if another
object is at its place by chance. A larger share searches more maps."""
_FEWEST_MATCHES = 0.5
"""The least share of the objects of the smaller part that the other part has too. Rooms of a building have some furniture in
common. A larger share finds fewer losses."""


@dataclass(frozen=True)
class Twice:
    """A place that is twice in a map.

    stamp: s, when the place was lost. first, second: the numbers of objects seen before and after this time. registration:
    the registration of the first objects to the second.
    """

    stamp: float
    first: int
    second: int
    registration: Registration

    def in_words(self) -> str:
        """Return the sentence for the assessment."""
        matches = len(self.registration.matches)
        return (
            f"The {self.first} objects seen before stamp {self.stamp:.3f} and the {self.second} objects seen after it look "
            f"like one place mapped twice ({matches} match): the odometry or the localisation was lost there, or the robot "
            "was carried. Map both parts of the log (`--end`, `--begin`), and join them with `objslam merge`."
        )


def find_twice(objects: ObjectMap) -> Twice | None:
    """Return the place that a map holds twice, None if there is none.

    A robot that loses its place sees all objects again as new ones. So there is a time by which nearly all known objects
    were seen for the last time. All objects that are seen later are new. If the objects before this time register to the
    objects after it, both show one place.
    """
    usable = [i for i, o in enumerate(objects.objects) if o.status == "ok" and o.covariance is not None]
    first = np.array([objects.objects[i].first_seen for i in usable])
    last = np.array([objects.objects[i].last_seen for i in usable])
    stamp = _cut(first, last)
    if stamp is None:
        return None
    from objslam.association.registration.object_maps import register  # Few maps need scipy.spatial, which loads slowly.

    before = [objects.objects[i] for i, end in zip(usable, last, strict=True) if end <= stamp]
    after = [objects.objects[i] for i, begin in zip(usable, first, strict=True) if begin > stamp]
    found = register(*(replace(objects, objects=tuple(part), gone=()) for part in (before, after)))
    if not found.accepted or len(found.matches) < _FEWEST_MATCHES * min(len(before), len(after)):
        return None
    return Twice(stamp, len(before), len(after), found)


def _cut(first: Floats, last: Floats) -> float | None:
    """Return the time (s) that divides the objects best. None if no time does. first, last: (N,) s, the times at which each
    object was seen first and last."""
    times = np.unique(last)
    before = np.searchsorted(np.sort(last), times, side="right")
    after = len(first) - np.searchsorted(np.sort(first), times, side="right")
    spanning = len(first) - before - after
    smaller = np.minimum(before, after)
    good = np.flatnonzero((smaller >= _FEWEST) & (spanning <= _SPANNING * len(first)))
    if not len(good):
        return None
    # An object that both parts show is evidence against the cut. An object of the smaller part is evidence for the cut, of
    # the same weight.
    return float(times[good[np.argmax((smaller - spanning)[good])]])

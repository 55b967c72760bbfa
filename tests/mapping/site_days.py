"""A place that changes over the days: objects are moved, added and taken, and each day is seen in a frame of its own."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, lift_se2
from objslam.core.object_map import MapObject, ObjectMap, SeenFrom
from objslam.mapping.sites.merge import merge_sessions
from objslam.mapping.sites.session import Session

LABELS = ("cup", "book", "chair", "plant", "bottle", "bag", "lamp", "box")
DAY = 86_400.0
SIGMA = 0.03  # m, the noise of a position.


class Place:
    """`truth`: id -> (label, position). `past`: what was taken or moved away, id -> day."""

    def __init__(self, rng, count=40, size=12.0):
        self.rng, self.size, self.next = rng, size, 0
        self.truth, self.past, self.moved = {}, {}, {}
        for _ in range(count):
            self.add()

    def spot(self):
        """A place that is a metre from all others."""
        while True:
            at = np.append(self.rng.uniform(0, self.size, 2), self.rng.uniform(0.2, 1.5))
            if all(np.linalg.norm(at - p) > 1.0 for _, p in self.truth.values()):
                return at

    def add(self):
        self.truth[self.next] = (LABELS[self.rng.integers(len(LABELS))], self.spot())
        self.next += 1

    def change(self, share, day):
        """Move, add and take away this share of the objects, a third each."""
        for _ in range(round(share * len(self.truth))):
            what = self.rng.integers(3)
            one = int(self.rng.choice(list(self.truth)))
            label, at = self.truth[one]
            if what == 0:
                self.add()
                continue
            self.past[one] = (day, label, at)
            del self.truth[one]
            if what == 1:
                self.truth[self.next] = (label, self.spot())
                self.moved[self.next] = one
                self.next += 1


class Day(Session):
    """A session in which 60 frames have an object in view, but for one in ten objects, in place of cameras."""

    def looks(self, objects, positions, session_T_map):
        drawn = np.random.default_rng(int(self.when)).random(len(objects)) < 0.9
        return np.where(drawn, 60, 0)


def session(place, day, wrong_label=0.05, missed=0.05, phantoms=1.0):
    """What one day's run finds: noise, wrong labels, objects that are overlooked, and phantoms."""
    rng = place.rng
    own = lift_se2(rng.uniform(-5, 5, 3)) if day else np.eye(4)
    back, found = inverse(own), []
    seen = {k: v for k, v in place.truth.items() if rng.random() >= missed}
    extra = [(LABELS[rng.integers(len(LABELS))], place.spot()) for _ in range(rng.poisson(phantoms))]
    for label, at in [*seen.values(), *extra]:
        noisy = back[:3, :3] @ (at + rng.normal(0, SIGMA, 3)) + back[:3, 3]
        share = {label: 0.9, LABELS[rng.integers(len(LABELS))]: 0.1}
        said = label if rng.random() > wrong_label else LABELS[rng.integers(len(LABELS))]
        share = {said: 0.9} | {name: 0.1 for name in share if name != said}
        begin, cov, size = day * DAY, SIGMA**2 * np.eye(3), (0.2, 0.3)
        more = {"labels": share, "existence": 0.95, "seen_from": SeenFrom(0.5, 5.0, np.eye(3))}
        found.append(MapObject(len(found), said, noisy, cov, "ok", 30, 30, 60.0, 0.3, begin, begin + 600.0, size, **more))
    return Day(f"day {day}", ObjectMap(tuple(found))), own


def there(objects, at, within=0.25):
    """The object of a map at a place, None if there is none."""
    distance = np.linalg.norm(objects.positions - at, axis=1)
    return objects[int(distance.argmin())] if distance.min() < within else None


@dataclass(frozen=True)
class Month:
    """What 30 days of merges gave, one session after the other.

    right: (N,) whether an object or an empty place was told correctly from the second visit after its change. phantoms: the
    number of objects that one session saw and that two others, which had their places in view, did not. first_week,
    last_week: the errors (m) of the objects in the site. confirmed: (K,) whether the objects that more than three sessions
    saw are confirmed at the end.
    """

    right: Floats
    phantoms: int
    first_week: Floats
    last_week: Floats
    confirmed: Floats


def month(seed):
    """Merge the sessions of 30 days. A tenth of the objects moves, comes or goes each week."""
    place, site, since = Place(np.random.default_rng(seed)), None, {}
    right, errors, phantoms = [], [], 0
    for day in range(30):
        if day and day % 7 == 0:
            place.change(0.1, day)
            since |= {k: day for k in place.truth if k not in since and day}
        today, _ = session(place, day)
        (island,) = merge_sessions([today] if site is None else [site, today])
        site = Day("site", island.objects)
        known = [(k, there(site.objects, at)) for k, (_, at) in place.truth.items()]
        right += [o is not None for k, o in known if day > since.get(k, 0)]
        standing = np.array([at for _, at in place.truth.values()])
        for when, _, at in place.past.values():
            if day > when and np.linalg.norm(standing - at, axis=1).min() > 0.5:
                right.append(there(site.objects, at) is None)
        errors.append([np.linalg.norm(o.position - place.truth[k][1]) for k, o in known if o is not None])
        real = {o.id for _, o in known if o is not None}
        phantoms += sum(o.id not in real and o.life.sessions_seen == 1 < o.life.sessions_expected - 1 for o in site.objects)
    confirmed = [o.life.state == "confirmed" for o in site.objects if o.life.sessions_seen > 3]
    return Month(np.array(right), phantoms, np.concatenate(errors[:7]), np.concatenate(errors[-7:]), np.array(confirmed))

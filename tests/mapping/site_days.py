"""A place that changes over the days: objects are moved, added and taken, and each day is seen in a frame of its own."""

import numpy as np

from objslam.core.geometry import inverse, lift_se2
from objslam.core.object_map import MapObject, ObjectMap, SeenFrom
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

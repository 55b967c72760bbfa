"""What the boxes of the next frame may be of: landmarks and candidates as they are now, in arrays that only need selecting.

Made once a frame has been worked in, when there is time, so that the next one does not wait for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objslam.live.candidates import Candidate
from objslam.live.known import covariances, noise
from objslam.live.table import Table
from objslam.types import Floats, Ints

_NOBODY = -2  # the id of a candidate: no landmark's


@dataclass(frozen=True)
class Expected:
    """Landmarks, the first `landmarks` of them in the order of their table, then candidates in the order of their list.

    id (n,), negative for candidates; label (n,), negative for those that wait for a label alone; position (n, 3) m and its
    covariance (n, 3, 3); drift (n, 6, 6) gathered when it was last seen; noise (n,) factor on that of its rays. far: m, the
    greatest distance from which a landmark was seen.
    """

    landmarks: int
    id: Ints
    label: Ints
    position: Floats
    covariance: Floats
    drift: Floats
    noise: Floats
    far: float


def expect(known: Table, candidates: Sequence[Candidate]) -> Expected:
    """What is known by now, and the candidates."""
    count, more = len(known), len(candidates)
    every = np.arange(count)
    label = [-1 if c.by_label else c.label for c in candidates]
    place, spread, drift = (
        np.array([getattr(c, name) for c in candidates]).reshape(-1, *shape)
        for name, shape in (("position", (3,)), ("covariance", (3, 3)), ("drift", (6, 6)))
    )
    return Expected(
        landmarks=count,
        id=np.concatenate([known.id, np.full(more, _NOBODY)]),
        label=np.concatenate([known.label, np.array(label, dtype=np.int64)]),
        position=np.concatenate([known.position, place]),
        covariance=np.concatenate([covariances(known, every), spread]),
        drift=np.concatenate([known.drift, drift]),
        noise=np.concatenate([noise(known, every), np.ones(more)]),
        far=float(known.far.max(initial=0.0)),
    )

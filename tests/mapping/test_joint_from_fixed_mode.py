"""Joint mode at poses that err for seconds: things of one label on two tables, which rays of wrong poses confuse."""

from __future__ import annotations

import numpy as np
import pytest
from lasting_localization import with_lasting
from scipy.optimize import linear_sum_assignment

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.mapping import pipeline
from objslam.simulation import PoseNoise, make_camera, preset, simulate

LABELS = ("cup", "bottle", "bowl", "vase")


def tables(seed: int, factor: float, seconds: float) -> Log:
    """A drive of 44 s around two tables, twelve things of four labels on them, and a localisation that errs for seconds."""
    rng = np.random.default_rng(seed)
    placed: list[tuple[str, tuple[float, float, float]]] = []
    while len(placed) < 12:
        side = 2.0 * (-1) ** (len(placed) // 2 + len(placed))
        x, y = np.array([side, 0.0]) + rng.uniform([-0.7, -0.45], [0.7, 0.45])
        if all(np.hypot(x - other[0], y - other[1]) > 0.22 for _, other in placed):
            placed.append((LABELS[len(placed) % 4], (float(x), float(y), 0.8)))
    drive = preset(
        "demo",
        path=(1, 2),
        margin=1.2,
        laps=2,
        frames=220,
        localization=PoseNoise(xy=0.003, yaw=0.001),
        objects=0,
        placed=tuple(placed),
        cameras=(make_camera(position=(0.1, 0.0, 1.0)),),
        pixel_sigma=2.0,
        false=0.0,
    )
    return with_lasting(simulate(drive, seed), factor, seconds, seed)


@pytest.mark.long
def test_no_object_has_the_rays_of_two_things() -> None:
    """Such an object is between its things, or beside them, by some tenths of a metre."""
    log = tables(seed=0, factor=4.0, seconds=3.0)
    settings = load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false", "checks.use=false"))
    result = pipeline.run(log, settings, Ledger())
    assert log.truth is not None
    objects, things = result.map.resolved(), log.truth.objects
    off = np.array(
        [[np.linalg.norm(o.position - t.position) if o.label == t.label else 9.0 for t in things] for o in objects]
    )
    one, other = linear_sum_assignment(off)
    assert len(one) == len(objects) == len(things)
    assert off[one, other].max() < 0.4

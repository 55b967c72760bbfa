"""Put errors that last into the localisation of a log."""

from dataclasses import replace

import numpy as np

from objslam.core.geometry import lift_se2
from objslam.core.types import Log


def with_lasting(log: Log, factor: float, seconds: float, seed: int, xy: float = 0.02, yaw: float = 0.005) -> Log:
    """The log with a first-order Gauss-Markov process in its localisation: `factor` times xy (m) and yaw (rad)."""
    path, rng = log.localization, np.random.default_rng(seed)
    assert path is not None
    kept = np.exp(-np.median(np.diff(path.stamps)) / seconds)
    drawn = rng.standard_normal((len(path), 3)) * factor * [xy, xy, yaw]
    for i in range(1, len(drawn)):
        drawn[i] = kept * drawn[i - 1] + np.sqrt(1 - kept**2) * drawn[i]
    poses = path.poses @ lift_se2(np.column_stack([np.zeros((len(path), 2)), drawn[:, 2]]))
    poses[:, :2, 3] += drawn[:, :2]
    return replace(log, localization=replace(path, poses=poses))

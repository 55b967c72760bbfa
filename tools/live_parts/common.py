"""What the parts share: a session that is fed a whole log, and maps compared with each other and with the truth."""

from __future__ import annotations

import threading

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.config import Odometry, Settings, load_settings
from objslam.core.geometry import align
from objslam.core.object_map import ObjectMap
from objslam.core.types import Log
from objslam.live.adapters.replay import ReplayAdapter
from objslam.live.session.session import Session

ONLY_ODOMETRY = {"localization": None, "odometry": Odometry()}
QUIET = ("output.recording=false", "output.picture=false")


def settings_for(*changes: str) -> Settings:
    return load_settings(None, ("mode=joint", *QUIET, *changes))


def replayed(log: Log, settings: Settings) -> Session:
    """A session that has been fed a whole log, as fast as it takes it."""
    session = Session(settings, patient=True).start()
    ReplayAdapter(session, log, None, session.wait).run(threading.Event())
    session.wait()
    return session


def compare(a: ObjectMap, b: ObjectMap, radius: float = 1.0) -> tuple[int, int, int, float, float]:
    """Return how many objects both maps have, and how many only the first and only the second. Also return the RMSE, m, of
    the common ones before and after SE(2) alignment."""
    one, two = a.resolved(), b.resolved()
    gap = np.array([[np.linalg.norm(p.position - q.position) if p.label == q.label else 99.0 for q in two] for p in one])
    gap = gap.reshape(len(one), len(two))
    i, j = linear_sum_assignment(np.minimum(gap, 2 * radius))
    same = gap[i, j] < radius
    both = int(same.sum())
    if not both:
        return 0, len(one), len(two), np.nan, np.nan
    mine, theirs = (np.array([m[k].position for k in which[same].tolist()]) for m, which in ((one, i), (two, j)))
    pose, _ = align(mine, theirs, "se2")
    laid = mine @ pose[:3, :3].T + pose[:3, 3]
    rmse, aligned = (float(np.sqrt(((x - theirs) ** 2).sum(axis=1).mean())) for x in (mine, laid))
    return both, len(one) - both, len(two) - both, rmse, aligned


def against_truth(found: ObjectMap, log: Log) -> str:
    """Return a text: the objects found, missed and false, and the RMSE after SE(2) alignment."""
    truth = log.truth.objects
    one = found.resolved()
    place = np.array([o.position for o in one]).reshape(-1, 3)
    true = np.array([o.position for o in truth])
    for _ in range(2):
        gap = np.linalg.norm(place[:, None] - true, axis=2)
        gap[np.array([[o.label != t.label for t in truth] for o in one]).reshape(gap.shape)] = 99.0
        i, j = linear_sum_assignment(np.minimum(gap, 3.0))
        good = gap[i, j] < 1.5
        pose, _ = align(place[i[good]], true[j[good]], "se2")
        place = place @ pose[:3, :3].T + pose[:3, 3]
    error = np.linalg.norm(place[i[good]] - true[j[good]], axis=1)
    rmse = np.sqrt(np.mean(error**2)) if len(error) else np.nan
    return f"{good.sum()} of {len(truth)} objects, {len(one) - good.sum()} false, RMSE {rmse:.3f} m"

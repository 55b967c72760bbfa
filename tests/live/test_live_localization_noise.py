"""A session finds the noise of its localisation while it runs, so that its snapshots say how sure they are."""

from functools import cache

import numpy as np
import pytest
from driving import feed
from lasting_localization import with_lasting

from objslam.config import Odometry, load_settings
from objslam.evaluation.evaluate import evaluate
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session
from objslam.simulation import PoseNoise, preset, simulate

pytestmark = pytest.mark.long  # All tests, because two of them share a session.
ALONE = ("mode=joint", "output.recording=false", "checks.use=false", "bodies.use=false", "live.calibrate_from=60")
FACTOR, SECONDS = 4.0, 3.0


@cache
def drive(seed: int, odometry: Odometry | None):
    """A drive whose localisation errs by 8 cm and 1.1 degrees for some seconds. The settings say 2 cm and 0.3 degrees."""
    room = {"frames": 260, "classes": 12, "pixel_sigma": 2.0, "false": 0.0, "odometry": odometry}
    log = simulate(preset("demo", **room, localization=PoseNoise(xy=0.002, yaw=0.0005)), seed)
    return with_lasting(log, FACTOR, SECONDS, seed)


@cache
def shown(seed: int, odometry: Odometry | None, *more: str):
    """The map of the last snapshot of a session."""
    session = feed(Session(load_settings(None, (*ALONE, *more)), patient=True).start(), drive(seed, odometry))
    found = session.snapshot().map
    session.abort()
    return found


def scores(seed: int, odometry: Odometry | None, *more: str):
    """The squared Mahalanobis distances of the objects of a last snapshot, and its errors, m."""
    truth = drive(seed, odometry).truth
    found = evaluate(shown(seed, odometry, *more), truth, align="none", radius=1.0).objects
    assert len(found.matches) >= 10
    return np.array([one.squared_3d for one in found.matches]), found.errors


@pytest.mark.parametrize("odometry", [Odometry(), None], ids=["both", "localisation alone"])
def test_objects_of_a_snapshot_lie_inside_their_ellipsoids_though_the_localisation_errs_for_seconds(odometry):
    told = "noise.localization=false"  # Then the session believes the settings.
    (squared, errors), (too_sure, worse) = scores(1, odometry), scores(1, odometry, told)
    assert (too_sure < 7.815).mean() < 0.6
    assert (squared < 7.815).mean() > 0.75
    assert np.sqrt((errors**2).mean()) < np.sqrt((worse**2).mean())


def test_a_resumed_session_has_the_noise_that_it_had_found(tmp_path):
    log, settings = drive(1, None), load_settings(None, ALONE)
    pushes = list(events(log))
    session = Session(settings, tmp_path / "journal", patient=True).start()
    feed(session, log, 0, 3 * len(pushes) // 4)
    found = session._mapper.state.localization.noise
    session.abort()
    assert found.place > 2
    assert found.place_share > 0.5
    again = Session(settings, tmp_path / "journal", resume=True, patient=True).start()
    assert again._mapper.state.localization.noise == found
    feed(again, log, 3 * len(pushes) // 4, None)
    resumed = again.snapshot().map
    again.abort()
    for one, other in zip(shown(1, None).objects, resumed.objects, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)

"""Joint maps at a localisation whose errors last for seconds, as those of a GPS or of AMCL do."""

from dataclasses import replace

import numpy as np
from lasting_localization import with_lasting

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.simulation import PoseNoise, preset, simulate

QUIET = ("calibration.use=false", "checks.use=false", "bodies.use=false", "output.recording=false")


def run(seed: int, odometry: Odometry | None, *told: str):
    """The squared Mahalanobis distances (n,) of the objects in the plane, their RMSE (m), and the noise."""
    quiet = {"localization": PoseNoise(xy=0.005, yaw=0.001), "pixel_sigma": 1.0, "false": 0.0}
    log = simulate(preset("demo", odometry=odometry, objects=8, classes=8, frames=200, **quiet), seed)
    log = with_lasting(log, 10.0, 4.0, seed)  # 0.2 m and 0.05 rad.
    settings = load_settings(None, ("mode=joint", *QUIET, *told))
    result = pipeline.run(replace(log, name="lasting"), settings, Ledger())
    place = {item.label: item.position for item in log.truth.objects}
    objects = result.map.resolved()
    off = np.array([(item.position - place[item.label])[:2] for item in objects])
    covariance = np.array([item.covariance[:2, :2] for item in objects])
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    return squares, float(np.sqrt((off**2).sum(axis=1).mean())), result.summary["noise"]


WHITE = ("noise.localization=false", "localization.xy=0.2", "localization.yaw=0.05")
"""The true size of the errors, but as if they were new in each pose."""


def test_lasting_errors_are_found_and_the_sigmas_contain_them():
    """With the default noise, which promises 0.02 m. An honest mean is 2. The objects of a drive share most of their
    error, and a short drive has few independent errors."""
    first, _, noise = run(0, Odometry())
    assert noise["place_share"] > 0.5
    assert 4 < noise["place"] < 25
    assert np.mean(np.concatenate([first, run(1, Odometry())[0]])) < 5
    assert np.mean(first) < 0.5 * np.mean(run(0, Odometry(), *WHITE)[0])


def test_how_a_localisation_errs_does_not_change_the_noise_of_the_rest():
    """Two localisations of one drive, one with errors of places and one with errors of headings. Boxes and odometry are the
    same. If errors of poses counted as noise of rays and odometry, the factor across the path would differ by 14 %."""
    quiet = {"localization": PoseNoise(xy=0.003, yaw=0.001), "pixel_sigma": 1.0, "false": 0.0}
    log = simulate(preset("demo", odometry=Odometry(), objects=8, classes=8, frames=800, **quiet), 0)
    found = []
    for xy, yaw in ((0.04, 0.005), (0.01, 0.03)):
        errs = replace(with_lasting(log, 1.0, 16.0, 0, xy, yaw), name="lasting")
        noise = pipeline.run(errs, load_settings(None, ("mode=joint", *QUIET)), Ledger()).summary["noise"]
        found.append([noise[name] for name in ("rays", "along", "across", "turning")])
    np.testing.assert_allclose(found[0], found[1], rtol=0.1)
    np.testing.assert_allclose(found[0][1:], 1, atol=0.15)


def test_without_odometry_the_rays_show_them():
    squares, _, noise = run(0, None)
    assert noise["place_share"] > 0.5
    assert np.mean(squares) < 10
    assert np.mean(squares) < 0.2 * np.mean(run(0, None, *WHITE)[0])

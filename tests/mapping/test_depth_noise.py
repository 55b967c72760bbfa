"""A camera that tells the noise of its depths, against settings that tell the same noise."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from quick import HELD
from waiting import LIMIT

from objslam.config import Odometry, load_settings
from objslam.core.camera import RangeNoise
from objslam.core.diagnostics import Ledger
from objslam.core.noise import range_noise
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session
from objslam.mapping import pipeline
from objslam.simulation import DepthNoise, PoseNoise, preset, simulate

NOISE = RangeNoise(0.07, 0.01, 0.2)
IN_SETTINGS = tuple(f"depth.{name}={value}" for name, value in vars(NOISE).items())


def logs(**changes):
    """A log with depths, and the same log with a camera that tells their noise."""
    drive = {"objects": 8, "classes": 8, "frames": 120, "depth": DepthNoise(), "odometry": Odometry(), **changes}
    plain = simulate(preset("demo", **drive), 3)
    one = plain.cameras[0]
    return plain, replace(plain, cameras=(replace(one, camera=replace(one.camera, depth_noise=NOISE)),))


def table(objects):
    return {o.label: np.column_stack([o.position, o.covariance]) for o in objects.objects if o.covariance is not None}


@pytest.mark.parametrize(("mode", "path"), [("fixed", PoseNoise()), ("joint", None)])
def test_the_camera_and_the_settings_tell_the_same(mode, path):
    plain, told = logs(localization=path)
    settings = f"mode={mode}", "fixed.loss=huber", "output.recording=false", "association.method=by_label", *HELD
    by_camera = table(pipeline.run(told, load_settings(None, settings), Ledger()).map)
    by_settings = table(pipeline.run(plain, load_settings(None, (*settings, *IN_SETTINGS)), Ledger()).map)
    usual = table(pipeline.run(plain, load_settings(None, settings), Ledger()).map)
    assert len(by_camera) >= 6
    assert by_camera.keys() == by_settings.keys()
    for label, found in by_camera.items():
        np.testing.assert_allclose(found, by_settings[label], rtol=1e-9, atol=1e-12)
    assert any(np.abs(found - usual[label]).max() > 1e-6 for label, found in by_camera.items() if label in usual)


def test_a_live_session_takes_the_noise_of_the_camera():
    plain, told = logs(localization=None)

    def live(log, *more):
        session = Session(load_settings(None, (*HELD, *more)), patient=True).start()
        session.push_camera(log.cameras[0].camera)
        for _, frame, push in events(log):
            push(session)
            assert not frame or session.wait(LIMIT)
        return table(session.stop().map)

    by_camera, by_settings = live(told), live(plain, *IN_SETTINGS)
    assert len(by_camera) >= 6
    assert by_camera.keys() == by_settings.keys()
    for label, found in by_camera.items():
        np.testing.assert_allclose(found, by_settings[label], rtol=1e-6, atol=1e-9)


def test_noise_that_a_camera_tells_is_not_estimated():
    plain, told = logs(localization=None)
    settings = load_settings(None, ("mode=joint",))
    unknown = []
    for log in (plain, told):
        keyframes = build_keyframes(log, settings, Ledger())
        rays = build_rays(log, keyframes, settings, Ledger())
        unknown.append(shared_errors(log, keyframes, rays, settings).unknown_noise)
    assert unknown[0] - unknown[1] == {"ranges"}


def test_ranges_of_each_camera_have_its_noise():
    cameras = [replace(logs()[0].cameras[0].camera, depth_noise=noise) for noise in (None, NOISE)]
    settings = load_settings(None, ())
    sigma, bias = range_noise(np.array([1.0, 1.0, 3.0]), np.zeros(3), np.array([0, 1, 1]), cameras, settings)
    of, (least, per_m, shared) = settings.depth, astuple(NOISE)
    np.testing.assert_allclose(sigma, [of.sigma + of.sigma_per_m, least + per_m, least + 3 * per_m])
    np.testing.assert_allclose(bias, [of.bias, shared, shared])

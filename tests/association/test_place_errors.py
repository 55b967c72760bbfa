"""The errors of places that all boxes of a moment share, against simulated truth."""

import numpy as np
import pytest

from objslam.association.few_rays.place_errors import moments, place_errors
from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import Observations
from objslam.association.visibility import CameraFrames
from objslam.core.ground.flattening import LEVEL

GPS, SIGMA, RANGE = 2.0, 0.02, 0.3


def street(seed, wrong_ranges=0.0):
    """Return a state at places with errors, the errors (G, 3) of the places, and the true landmark of each ray."""
    rng = np.random.default_rng(seed)
    places = np.column_stack([8.0 * np.arange(40), np.zeros(40), np.ones(40)])
    things = np.column_stack([rng.uniform(0, 320, 60), rng.choice([-8, 8], 60), rng.uniform(0, 3, 60)])
    place, thing = np.nonzero(np.linalg.norm(places[:, None] - things, axis=2) < 20)
    to = things[thing] - places[place]
    distance = np.linalg.norm(to, axis=1)
    direction = to / distance[:, None] + SIGMA * rng.normal(size=to.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    measured = distance + RANGE * rng.normal(size=len(distance))
    wrong = rng.random(len(distance)) < wrong_ranges
    measured[wrong] = rng.uniform(2, 25, wrong.sum())
    error = GPS * rng.normal(size=places.shape)
    noise = np.full(len(place), SIGMA), measured, np.full(len(place), RANGE)
    lines = Observations.of_lines((places - error)[place], direction, *noise)
    obs = Observations(**{**vars(lines), "frame": place, "position_sigma": GPS})
    assert obs.scale == LEVEL
    view = CameraFrames(np.arange(40.0), (), np.zeros(40, dtype=np.int64), np.tile(np.eye(4), (40, 1, 1)), 0.0, 0.0)
    landmarks = Landmarks.new(things, np.ones(60), np.zeros(60, dtype=np.int64), 1)
    return State(obs, view, landmarks, thing), error


def test_places_are_corrected_as_well_as_their_sigma_says():
    normalised, before, after = [], [], []
    for seed in range(8):
        state, true = street(seed)
        found = place_errors(state)
        normalised.append((found.offset - true) / found.sigma[:, None])
        before.append(true)
        after.append(found.offset - true)
    assert np.abs(after).mean() < 0.4 * np.abs(before).mean()
    assert 0.8 < np.sqrt(np.mean(np.square(normalised))) < 1.25


def test_wrong_ranges_hardly_move_places():
    def errors(share):
        return np.concatenate([np.subtract(place_errors(s).offset, e) for s, e in (street(i, share) for i in range(4))])

    right, wrong = (np.sqrt((errors(share) ** 2).mean()) for share in (0.0, 0.15))
    assert wrong < 1.3 * right


def test_a_place_whose_rays_have_no_landmark_stays():
    state, _ = street(1)
    matched = np.where(state.obs.frame == 7, -1, state.matched)
    found = place_errors(State(state.obs, state.view, state.landmarks, matched))
    assert np.abs(found.offset[7]).max() < 1e-9
    assert found.sigma[7] == pytest.approx(GPS)
    assert np.array_equal(moments(state), state.obs.frame)


def test_many_landmarks_give_the_same_places(monkeypatch):
    state, _ = street(3)
    few = place_errors(state)
    monkeypatch.setattr("objslam.association.few_rays.place_errors._DENSE", 0)
    many = place_errors(state)
    np.testing.assert_allclose(many.offset, few.offset, atol=1e-8)
    np.testing.assert_allclose(many.sigma, few.sigma, rtol=1e-8)

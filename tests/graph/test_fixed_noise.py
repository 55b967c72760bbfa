"""Objects seen from few sides at fixed poses: noise moves them to no side, and their sigmas hold."""

import numpy as np
import pytest

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.assembly import fixed_pose_factors
from objslam.graph.batch_solver import solve_fixed
from objslam.graph.fixed_pose_triangulation import triangulate_at
from objslam.graph.variables import make_values

OBJECTS, EACH = 300, 40


def drive_past(angle: float, place: float, seed: int) -> tuple[Keyframes, Rays, Association, Floats, Floats]:
    """Objects that are passed on 1.2 m of a straight way, about 3 m ahead and 0.8 m beside its middle.

    angle: rad, the noise of rays. place: m, of their origins. Also returns the true points, and a unit vector towards each.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20, 20, (OBJECTS, 3))
    owner = np.repeat(np.arange(OBJECTS), EACH)
    way = np.tile(np.linspace(-0.6, 0.6, EACH), OBJECTS)
    origins = points[owner] - [3.0, 0.8, 0.1] + way[:, None] * [1.0, 0.0, 0.0]
    towards = points[owner] - origins
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    across = rng.normal(size=(2, len(owner), 3))
    across -= np.einsum("nri,ri->nr", across, towards)[..., None] * towards
    directions = towards + angle * across[0]
    poses = np.tile(np.eye(4), (len(owner), 1, 1))
    poses[:, :3, 3] = origins + place * across[1]
    keyframes = Keyframes(
        stamps=np.arange(len(owner), dtype=float),
        camera=np.zeros(len(owner), dtype=np.int64),
        frame=np.arange(len(owner)),
        base_T_camera=np.tile(np.eye(4), (len(owner), 1, 1)),
        map_T_base=poses,
        localized_every=1.0,
    )
    nothing = np.full(len(owner), np.nan)
    rays = Rays(
        keyframe=np.arange(len(owner)),
        direction=directions / np.linalg.norm(directions, axis=1, keepdims=True),
        sigma=np.full(len(owner), angle),
        range=nothing,
        range_sigma=nothing,
        range_bias=nothing,
        label=owner,
        score=np.ones(len(owner)),
        box=np.zeros((len(owner), 4)),
        track_id=np.full(len(owner), -1),
        label_names=tuple(map(str, range(OBJECTS))),
    )
    return keyframes, rays, Association(owner, np.arange(OBJECTS)), points, np.array([3.0, 0.8, 0.1]) / np.sqrt(9.65)


@pytest.mark.parametrize(("angle", "place"), [(0.01, 1e-4), (1e-3, 0.03), (0.008, 0.02)])
def test_noise_moves_an_object_to_no_side_and_sigma_holds(angle: float, place: float) -> None:
    """Eq. 1 draws the same objects towards the cameras, if directions are noisy."""
    keyframes, rays, association, points, away = drive_past(angle, place, seed=1)
    errors = {}
    for loss in ("l1", "huber"):
        changes = {"fixed": {"loss": loss}, "localization": {"xy": place, "yaw": 1e-6}}
        settings = Settings.model_validate(changes)
        start = triangulate_at(keyframes.map_T_camera, keyframes, rays, association, settings)
        estimate = solve_fixed(keyframes, rays, association, start, settings)
        assert estimate.solved.all()
        errors[loss] = (estimate.positions - points, estimate.covariance)
    off, covariance = errors["huber"]
    along = off @ away
    assert abs(along.mean()) < 4 * along.std() / np.sqrt(OBJECTS)
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    assert 0.9 < (squared < 7.81).mean() < 0.99
    plain = errors["l1"][0] @ away
    assert (along**2).mean() < (plain**2).mean()
    if angle > place / 3:
        assert plain.mean() < -8 * plain.std() / np.sqrt(OBJECTS)


def test_the_residual_is_that_of_the_noise_at_any_distance() -> None:
    """x / sqrt((angle d)^2 + place^2), and its change along the line of sight, by finite differences."""
    keyframes, rays, association, _, _ = drive_past(0.01, 0.02, seed=2)
    some = rays.take(np.arange(1))
    origins, directions = some.in_map(keyframes.map_T_camera)
    side = np.cross(directions[0], [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    noise = np.array([0.01]), 0.02

    def expected(distance: float) -> float:
        return 0.05 / np.hypot(0.01 * distance, 0.02)

    def residual(distance: float) -> float:
        factor = fixed_pose_factors(some, origins, directions, np.zeros(1, np.int64), np.array([3.0]), noise, "gnc")[0]
        point = origins[0] + distance * directions[0] + 0.05 * side
        return np.sqrt(2 * factor.error(make_values(np.zeros((0, 4, 4)), point[None], np.zeros(1, np.int64))))

    assert residual(3.0) == pytest.approx(expected(3.0), rel=2e-3)
    slope, true = ((one(3.1) - one(2.9)) / 0.2 for one in (residual, expected))
    assert slope == pytest.approx(true, rel=0.02)
    assert association.count == OBJECTS

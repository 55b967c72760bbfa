"""Things that hide each other in part: which edges count as hidden, and what that does to a map."""

from dataclasses import replace

import numpy as np
import pytest
from mapping.hiding_drives import FORWARD, Solid, boxes_at, hiding_drive, lines_between, scene

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Rays
from objslam.evaluation.evaluate import INSIDE_95_3D, evaluate
from objslam.mapping import pipeline
from objslam.mapping.bodies import fitting
from objslam.mapping.bodies.boxes_in_front import edges_behind_boxes, with_hidden_parts
from objslam.mapping.solution import CentreShift
from objslam.mapping.stages import described
from objslam.triangulation.bodies import solve
from objslam.triangulation.bodies.hidden_edges import Hidden

SETTINGS = load_settings(None, ("mode=fixed", "output.recording=false", "checks.use=false"))


def mapped(log):
    """The scores of a map at known poses: errors, squared Mahalanobis errors and size errors of the matched objects."""
    result = pipeline.run(log, SETTINGS, Ledger())
    matches = evaluate(result.map, log.truth, radius=1.0).objects.matches
    sizes = [m.body.size_error for m in matches if m.body is not None]
    return np.array([m.error for m in matches]), np.array([m.squared_3d for m in matches]), np.array(sizes)


@pytest.fixture
def no_hidden_edges(monkeypatch):
    """Every edge counts as the outline of its body."""

    def turn_off():
        none = lambda solution, cameras, settings, map_T_camera, half, ray: np.zeros((len(ray), 4), dtype=bool)  # noqa: E731
        monkeypatch.setattr(fitting, "edges_behind_boxes", none)
        flat = lambda edges, some, start, *_: Hidden(np.zeros((len(edges), 4), bool), np.zeros((len(start), 6, 6)))  # noqa: E731
        monkeypatch.setattr(solve, "hidden_edges", flat)

    return turn_off


@pytest.mark.long
def test_things_in_front_move_and_shrink_no_objects(no_hidden_edges):
    logs = [hiding_drive(seed) for seed in (0, 1)]
    errors, squared, sizes = (np.concatenate(part) for part in zip(*map(mapped, logs), strict=True))
    no_hidden_edges()
    plain, _, plain_sizes = (np.concatenate(part) for part in zip(*map(mapped, logs), strict=True))
    assert len(errors) >= len(plain) - 1
    assert (errors**2).mean() < 0.75**2 * (plain**2).mean()
    assert (squared <= INSIDE_95_3D).mean() > 0.9
    assert (sizes[:, 2] ** 2).mean() < (plain_sizes[:, 2] ** 2).mean()  # Things in front mostly hide the lower parts.
    assert abs(np.median(sizes)) < 0.05


@pytest.mark.parametrize("away", [2.8, 3.2])
def test_a_chair_before_one_end_of_a_desk_leaves_no_centre_that_is_too_sure(away):
    """The chair hides the same end from nearly all sides. Its centre is farther than that of the desk from some of them."""
    solids = [
        Solid("cuboid", "desk", np.array([0.0, away, 0.375]), np.array([0.7, 0.35, 0.375]), 0.0),
        Solid("cuboid", "chair", np.array([0.25, away - 0.75, 0.45]), np.array([0.25, 0.25, 0.45]), 0.0),
        *(Solid("cylinder", "bin", np.array([x, y, 0.3]), np.array([0.2, 0.2, 0.3]), 0.0) for x, y in ((3, -1), (-3, -1))),
    ]
    result = pipeline.run(hiding_drive(1, noise=0.5, solids=solids), SETTINGS, Ledger())
    (desk,) = (o for o in result.map.resolved() if o.label == "desk")
    off = desk.position - solids[0].centre
    assert np.linalg.norm(off) > 0.3
    assert off @ np.linalg.solve(desk.covariance, off) < INSIDE_95_3D


def test_edges_of_visible_parts_are_found_behind_boxes(monkeypatch):
    """Against the boxes that the things would have if nothing hid them."""
    log, found = hiding_drive(1, noise=0.5, frames=200), []

    def noted(solution, cameras, settings, map_T_camera, half, ray):
        hidden = edges_behind_boxes(solution, cameras, settings, map_T_camera, half, ray)
        found.append((solution, ray, hidden))
        return hidden

    monkeypatch.setattr(fitting, "edges_behind_boxes", noted)
    pipeline.run(log, SETTINGS, Ledger())
    solution, ray, hidden = found[-1]
    solids = scene(np.random.default_rng(1))
    lines, truth = lines_between(solids), log.truth.trajectory.poses
    true = np.zeros_like(hidden)
    for at, one in enumerate(ray.tolist()):
        pose = truth[solution.keyframes.frame[solution.rays.keyframe[one]]] @ FORWARD
        shown, boxes = boxes_at(solids, lines, pose)
        mine = np.abs(boxes - solution.rays.box[one]).max(axis=1).argmin()
        alone, whole = boxes_at([solids[shown[mine]]], {}, pose)
        true[at] = np.abs(whole[0] - boxes[mine]) > 12
        assert alone
    assert true.sum() > 60
    assert hidden[true].mean() > 0.9
    assert hidden[~true].mean() < 0.15


@pytest.fixture(scope="module")
def stages():
    """What two stages of one run made, by their names: (what went in, what came out) of the last call of each."""
    log, made = hiding_drive(0, frames=200), {}

    def noted(name):
        given = getattr(described, name)

        def stage(solution, *arguments):
            made[name] = solution, given(solution, *arguments)
            return made[name][1]

        return stage

    with pytest.MonkeyPatch.context() as patch:
        for name in ("with_bodies", "with_box_offsets"):
            patch.setattr(described, name, noted(name))
        pipeline.run(log, SETTINGS, Ledger())
    return log, made


def test_hidden_boxes_make_a_position_by_rays_less_sure(stages):
    log, made = stages
    solution, cameras = made["with_bodies"][1], tuple(c.camera for c in log.cameras)
    assert solution.hidden.any()
    assert not solution.hidden.all()
    more = with_hidden_parts(solution, cameras).estimate.covariance - solution.estimate.covariance
    used = (solution.association.object >= 0) & (solution.estimate.weight > 0)
    for j in range(solution.association.count):
        mine = used & (solution.association.object == j)
        assert (np.trace(more[j]) > 0) == solution.hidden[mine].any()
    clear = replace(solution, hidden=np.zeros_like(solution.hidden))
    assert with_hidden_parts(clear, cameras) is clear


def test_a_body_behind_things_has_the_errors_that_its_boxes_share(stages):
    before, after = stages[1]["with_box_offsets"]
    wider = {
        j: np.trace((after.bodies[j].covariance - body.covariance)[:3, :3])
        for j, body in enumerate(before.bodies)
        if body is not None
    }
    behind = {j for j in wider if before.bodies[j].behind}
    assert behind
    assert behind == {j for j, more in wider.items() if more > 0}


def test_a_shift_turns_rays_and_makes_them_noisier():
    count, flat = 4, np.zeros(4)
    ahead = np.tile([0.0, 0.0, 1.0], (count, 1))
    unknown = np.full(count, np.nan)
    none = np.zeros(count, dtype=int)
    rays = Rays(none, ahead, flat + 0.03, unknown, flat + 1, flat, none, flat, np.zeros((count, 4)), none - 1, ("thing",))
    shift = CentreShift(np.tile([0.1, 0.0, 0.0], (count, 1)), flat + 0.04).only(np.array([True, True, False, False]))
    turned = shift.apply(rays)
    np.testing.assert_allclose(np.arctan2(turned.direction[:, 0], turned.direction[:, 2]), np.arctan([0.1, 0.1, 0, 0]))
    np.testing.assert_allclose(np.linalg.norm(turned.direction, axis=1), 1.0)
    np.testing.assert_allclose(turned.sigma, [0.05, 0.05, 0.03, 0.03])

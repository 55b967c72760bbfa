"""Rows of large equal things, of which cameras see the near sides."""

from types import SimpleNamespace

import numpy as np
import pytest
from live.driving import feed
from mapping.body_drives import FORWARD
from mapping.hiding_drives import aisle, along_aisle, hiding_drive

from objslam.config import load_settings
from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.live.session.session import Session
from objslam.mapping import pipeline
from objslam.mapping.moves.near_sides import BACK, check_rows, moves_back, shift_ahead

QUIET = ("output.recording=false", "mode=joint")


def way(mount=FORWARD):
    """Keyframes of 40 poses on a circle."""
    turn = np.linspace(0, 2 * np.pi, 40)
    poses = lift_se2(np.column_stack([3 * np.cos(turn), 3 * np.sin(turn), turn]))
    return SimpleNamespace(
        map_T_base=poses, base_T_camera=np.repeat(mount[None], 40, axis=0), camera=np.zeros(40, dtype=int)
    )


def test_the_shift_is_along_the_view_of_each_camera():
    keyframes = way()
    back = keyframes.map_T_base.copy()
    back[:, :3, 3] -= 0.2 * back[:, :3, 0]
    assert shift_ahead(keyframes, back, None, ("front",)) == pytest.approx((-0.2, 0.0), abs=1e-9)
    aside = keyframes.map_T_base.copy()
    aside[:, :3, 3] += 0.2 * aside[:, :3, 1]
    assert shift_ahead(keyframes, aside, None, ("front",)) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_common_shift_of_the_map_is_no_shift_ahead():
    keyframes = way()
    moved = keyframes.map_T_base.copy()
    moved[:, 0, 3] += 0.5
    mean, sigma = shift_ahead(keyframes, moved, None, ("front",))
    assert abs(mean) < sigma / 2


def test_a_camera_that_is_moved_on_the_robot_counts():
    keyframes = way()
    found = Calibration(("front.x", "front.y"), np.array([-0.3, 0.1]), np.eye(2), np.ones(2))
    assert shift_ahead(keyframes, keyframes.map_T_base, found, ("front",))[0] == pytest.approx(-0.3)


def test_the_shift_has_the_covariance_of_the_cameras_places():
    """Two cameras that look ahead and back. What they have in common on the robot hardly counts."""
    keyframes = way()
    keyframes.camera = np.arange(40) % 2
    keyframes.base_T_camera[1::2] = lift_se2(np.array([0.0, 0.0, np.pi])) @ FORWARD
    names = ("front.x", "front.y", "rear.x", "rear.y", "front.tilt")
    covariance = np.diag([0.03, 0.1, 0.02, 0.1, 0.5]) ** 2
    covariance[0, 2] = covariance[2, 0] = 0.0003
    found = Calibration(names, np.array([-0.3, 0.1, -0.1, 0.2, 0.4]), covariance, np.ones(5))
    mean, sigma = shift_ahead(keyframes, keyframes.map_T_base, found, ("front", "rear"))
    assert mean == pytest.approx(-0.1)
    assert sigma == pytest.approx(np.sqrt(0.03**2 + 0.02**2 - 2 * 0.0003) / 2)


def test_a_camera_that_looks_down_tells_nothing():
    down = np.eye(4)
    down[:3, :3] = np.diag([1.0, -1.0, -1.0])
    keyframes = way(down)
    back = keyframes.map_T_base.copy()
    back[:, :3, 3] -= 0.2 * back[:, :3, 0]
    assert shift_ahead(keyframes, back, None, ("front",)) == (0.0, 0.0)


def test_small_and_unsteady_shifts_are_not_clear():
    settings = load_settings(None)
    assert moves_back((-0.2, 0.03), settings)
    assert not moves_back((0.2, 0.03), settings)
    assert not moves_back((-0.2, 0.15), settings)
    assert not moves_back((-1.5 * settings.localization.xy, 0.001), settings)


@pytest.mark.parametrize("ranged", [False, True])
def test_rays_with_ranges_do_not_count_for_a_neighbour(ranged):
    keyframes = way()
    keyframes.localized_every = 1.0
    back = keyframes.map_T_base.copy()
    back[:, :3, 3] -= 0.2 * back[:, :3, 0]
    estimate = SimpleNamespace(
        map_T_base=back, covariance=np.zeros((2, 3, 3)), calibration=None, weight=np.array([1.0, 1.0, 1.0, 0.0])
    )
    association = SimpleNamespace(label=np.zeros(2, dtype=int), object=np.array([0, 0, 1, -1]))
    rays = SimpleNamespace(range=np.array([1.0, 2.0, np.nan, np.nan]) if ranged else np.full(4, np.nan))
    solution = SimpleNamespace(keyframes=keyframes, estimate=estimate, association=association, rays=rays)
    assert (check_rows(solution, ("front",), load_settings(None)) is None) == ranged


@pytest.mark.parametrize("named", [False, True])
def test_a_row_of_lockers_is_doubted_unless_labels_tell_them_apart(named):
    solids = aisle(np.random.default_rng(0), named=named)
    log = hiding_drive(0, solids=solids, plane=along_aisle())
    result = pipeline.run(log, load_settings(None, QUIET), Ledger())
    places = np.array([one.position for one in result.map.resolved()])
    far = np.linalg.norm(places[:, None, :2] - [one.centre[:2] for one in solids], axis=2).min(axis=1)
    found = BACK in [one["name"] for one in result.summary["wrong_input"]]
    assert found == (not named)
    assert (result.summary["assessment"]["level"] == "good") == named
    assert (np.median(far) > 0.3) == (not named)


def test_a_session_doubts_such_a_row_too():
    """The map is half a spacing off, so a camera that would have to be at the bound of its place may be named too."""
    log = hiding_drive(0, solids=aisle(np.random.default_rng(0)), plane=along_aisle())
    settings = load_settings(None, ("output.recording=false", "noise.localization=false"))  # It is that of the settings.
    session = feed(Session(settings, patient=True).start(), log)
    result = session.stop()
    named = [one["name"] for one in result.summary["wrong_input"]]
    assert BACK in named
    assert result.summary["assessment"]["level"] == ("bad" if "front.x at its bound" in named else "check")

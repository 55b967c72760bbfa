"""What a camera sees: closed forms, and the projection against its inverse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from objslam.association.visibility import CameraFrames, _in_image
from objslam.core.camera import Camera, in_field, in_view, project, undistort
from objslam.live.mapper.landmark_table import LandmarkTable
from objslam.live.mapper.landmark_table import in_view as landmarks_in_view
from objslam.output.viewer.cameras import points_in_frames
from objslam.simulation import DriveSettings
from objslam.simulation.detector import views

LENSES = {
    "none": ("plumb_bob", [0.0] * 5),
    "plumb_bob": ("plumb_bob", [-0.28, 0.09, 0.001, -0.0005, 0.0]),
    "folds": ("plumb_bob", [-0.3, 0.0, 0.0, 0.0, 0.0]),
    "folds twice": ("plumb_bob", [-0.5, 0.1, 0.0, 0.0, 0.0]),
    "rational": ("rational_polynomial", [0.4, -0.1, 0.0006, 0.0003, -0.004, 0.75, -0.08, -0.02]),
    "prism": ("rational_polynomial", [-0.2, 0.05, 0.001, 0.0, 0.0, 0.1, 0.0, 0.0, 0.004, 0.001, -0.003, 0.002]),
    "fisheye": ("equidistant", [-0.01, 0.02, -0.015, 0.004]),
    "fisheye that grows": ("equidistant", [0.05, 0.01, 0.0, 0.0]),
    "fisheye that folds": ("equidistant", [-0.3, 0.0, 0.0, 0.0]),
}


def camera(model="plumb_bob", distortion=(0.0,) * 5, width=640, height=480, focal=500.0, centre=None):
    cx, cy = ((width - 1) / 2, (height - 1) / 2) if centre is None else centre
    matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return Camera("front", width, height, matrix, model, np.array(distortion))


def fisheye(width, distortion=(0.0,) * 4, focal=200.0):
    return camera("equidistant", distortion, width, width, focal)


def at(angle, around=0.0):
    """Unit vectors (N, 3) so far (rad) off the optical axis."""
    angle, around = np.broadcast_arrays(np.asarray(angle, dtype=float), around)
    return np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])


def rectangle(left, right, top, bottom):
    """The solid angle of a rectangle at z = 1."""
    corner = lambda x, y: np.arctan(x * y / np.sqrt(1 + x * x + y * y))  # noqa: E731
    return corner(right, bottom) - corner(left, bottom) - corner(right, top) + corner(left, top)


@pytest.mark.parametrize("centre", [(319.5, 239.5), (100.0, 400.0), (-900.0, 200.0)], ids=["middle", "off it", "outside"])
def test_the_solid_angle_of_a_pinhole(centre):
    sides = [(side - c) / 500 for c, most in zip(centre, (639.5, 479.5), strict=True) for side in (-0.5, most)]
    assert camera(centre=centre).solid_angle == pytest.approx(rectangle(*sides), rel=1e-12)


@pytest.mark.parametrize("width", [round(200 * np.pi) + 1, 1000], ids=["that fills the image", "with black around it"])
def test_a_fisheye_of_180_degrees_sees_the_half_sphere(width):
    assert fisheye(width).solid_angle == pytest.approx(2 * np.pi, rel=1e-12)


def test_a_lens_that_folds_back_sees_the_cone_up_to_there():
    wide = camera(distortion=LENSES["folds"][1], width=4000, height=4000)
    fold = np.arctan(np.sqrt(1 / 0.9))  # where r (1 - 0.3 r^2) is greatest
    assert wide.lens_angle == wide.view_angle == pytest.approx(fold, abs=1e-9)
    assert wide.solid_angle == pytest.approx(2 * np.pi * (1 - np.cos(fold)), rel=1e-9)
    fold = np.sqrt(1 / 0.9)
    assert fisheye(4000, (-0.3, 0.0, 0.0, 0.0)).lens_angle == pytest.approx(fold, abs=1e-9)
    assert fisheye(4000, (-0.3, 0.0, 0.0, 0.0)).solid_angle == pytest.approx(2 * np.pi * (1 - np.cos(fold)), rel=1e-9)


@pytest.mark.parametrize("lens", ["none", "fisheye", "fisheye that grows"])
def test_a_lens_that_never_folds_back_holds_up_to_90_degrees(lens):
    assert camera(*LENSES[lens]).lens_angle == np.pi / 2


@pytest.mark.parametrize("lens", LENSES)
def test_the_solid_angle_is_the_share_of_directions_in_view(lens):
    for one in (camera(*LENSES[lens]), camera(*LENSES[lens], focal=260.0, centre=(250.0, 300.0))):
        rng = np.random.default_rng(1)
        directions = rng.standard_normal((400_000, 3))
        shown, _ = in_view(one, directions, np.full(2, -0.5), one.size - 0.5)
        share = len(shown) / len(directions)
        sigma = 4 * np.pi * np.sqrt(share * (1 - share) / len(directions))
        assert abs(one.solid_angle - 4 * np.pi * share) < 5 * sigma


@pytest.mark.parametrize("lens", LENSES)
@examples(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), focal=st.floats(150.0, 700.0))
def test_what_is_in_view_is_what_its_pixel_shows(lens, seed, focal):
    one = camera(*LENSES[lens], focal=focal)
    directions = np.random.default_rng(seed).standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    shown, pixels = in_view(one, directions)
    assert (directions[shown, 2] >= np.cos(one.view_angle) - 1e-9).all()
    found, valid = undistort(one, pixels)
    rim = directions[shown, 2] < np.cos(one.lens_angle - 0.05)  # there a pixel hardly tells two directions apart
    assert valid[~rim].all()
    np.testing.assert_allclose(found[~rim], directions[shown][~rim], atol=1e-4)
    assert in_field(one, found[valid]).all()


def test_a_pixel_far_from_the_axis_of_a_prism_shows_its_direction():
    """OpenCV's own iteration does not converge there."""
    one = camera(*LENSES["prism"], focal=150.0)
    directions = np.random.default_rng(50899051).standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[directions[:, 2] > np.cos(np.radians(70.0))]
    shown, pixels = in_view(one, directions)
    found, valid = undistort(one, pixels)
    assert valid.all()
    np.testing.assert_allclose(found, directions[shown], atol=1e-4)


def test_a_pixel_shows_nothing_from_behind_the_fold():
    # r (1 - 0.5 r^2 + 0.1 r^4) rises up to r = 1, falls, and rises again from r = 1.41 on
    one = camera(*LENSES["folds twice"], width=2000, height=2000)
    again = at(np.arctan(np.array([1.2, 1.5, 1.8, 2.0])))
    assert len(in_view(one, again)[0]) == 0
    pixels = project(one, again)
    assert ((pixels > 0) & (pixels < 1999)).all()  # where the projection alone would put them
    directions, valid = undistort(one, pixels)
    assert (directions[valid, 2] > np.cos(one.lens_angle)).all()


@pytest.mark.parametrize("distortion", [(0.0,) * 4, (0.05, 0.01, 0.0, 0.0), (-0.02, 0.004, -0.002, 0.0003)])
def test_a_fisheye_sees_almost_sideways(distortion):
    one = fisheye(1200, distortion)
    directions = at(np.radians([0.0, 45.0, 80.0, 85.0, 89.9]), np.array([0.0, 1.0, 2.0, 3.0, 4.0]))
    shown, pixels = in_view(one, directions)
    assert len(shown) == 5
    found, valid = undistort(one, pixels)
    assert valid.all()
    np.testing.assert_allclose(found, directions, atol=1e-9)
    assert len(in_view(one, at(np.radians([90.1, 120.0, 180.0])))[0]) == 0


def test_points_near_the_edge_are_asked_for_by_the_pixel():
    one = camera()
    points = np.array([[0.0, 0.0, 2.0], [1.2, 0.0, 2.0], [1.4, 0.0, 2.0], [0.0, 0.0, -2.0]])  # u = 319.5, 619.5, 669.5
    assert in_view(one, points)[0].tolist() == [0, 1]
    assert in_view(one, points, np.full(2, 50.0), one.size - 51)[0].tolist() == [0]
    assert in_view(one, points, np.full(2, -50.0), one.size + 49)[0].tolist() == [0, 1, 2]
    border = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    assert in_view(one, points, border, one.size - 1 - border)[0].tolist() == [0]


def ask_live(one, directions):
    known = LandmarkTable()
    nothing = {name: np.zeros((len(directions), *shape)) for name, shape in {"information": (3, 3), "drift": (6, 6)}.items()}
    counts = {name: np.zeros(len(directions)) for name in ("first", "last", "seen", "expected", "squared", "rejected")}
    each = np.arange(len(directions))
    known.add(id=each, position=3 * directions, label=each, far=np.full(len(directions), 3.0), **nothing, **counts)
    return np.flatnonzero(landmarks_in_view(known, one, np.eye(4), margin=0.0))


def ask_the_viewer(one, directions):
    return points_in_frames(one, np.eye(4)[None], 3 * directions, np.full(len(directions), 4.0))[1]


def ask_the_simulation(one, directions):
    settings = DriveSettings(cameras=(one,), cut_off=True)
    return views(settings, one, np.eye(4)[None], 3 * directions, np.full((len(directions), 2), 0.1)).object


def ask_association(one, directions):
    view = CameraFrames(np.zeros(1), (one,), np.zeros(1, dtype=np.int64), np.eye(4)[None], -1.0, 0.0)
    count = len(directions)
    return _in_image(3 * directions, np.zeros((count, 2)), np.full(count, 4.0), one, np.zeros(1, dtype=np.int64), view)[0]


@pytest.mark.parametrize("ask", [ask_live, ask_the_viewer, ask_the_simulation, ask_association])
@pytest.mark.parametrize(
    "one",
    [
        camera(*LENSES["folds"]),  # 56 to 64 degrees off the axis would fall into its image
        camera(distortion=(-0.45, 0.0, 0.0, 0.0, 0.0)),
        camera(*LENSES["fisheye that grows"], focal=190.0),
        camera(*LENSES["fisheye that folds"], focal=190.0),
        camera(*LENSES["plumb_bob"]),
    ],
    ids=["folds", "folds early", "fisheye", "fisheye that folds", "plumb_bob"],
)
def test_all_see_the_same(ask, one):
    angle, around = np.meshgrid(np.radians(np.arange(0.25, 180.0, 0.5)), np.arange(0.0, 6.2, 0.3))
    directions = at(angle.ravel(), around.ravel())
    border = np.abs(project(one, directions) - one.size + 0.5) < 0.6  # the last pixel ends there, or its middle is there
    directions = directions[~border.any(axis=1)]
    assert sorted(ask(one, directions).tolist()) == in_view(one, directions)[0].tolist()

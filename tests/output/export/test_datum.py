"""Places on the earth: against points known by geometry, and back through the textbook formulas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from objslam.output.export.content import Datum

_A, _B = 6378137.0, 6356752.314245179  # m, WGS 84


def _cartesian(longitude, latitude, height):
    """The textbook formula, with both axes instead of the eccentricity."""
    lon, lat = np.radians(longitude), np.radians(latitude)
    normal = _A**2 / np.sqrt((_A * np.cos(lat)) ** 2 + (_B * np.sin(lat)) ** 2)
    return np.array(
        [
            (normal + height) * np.cos(lat) * np.cos(lon),
            (normal + height) * np.cos(lat) * np.sin(lon),
            (normal * (_B / _A) ** 2 + height) * np.sin(lat),
        ]
    )


def test_the_compass():
    """At heading 0 the map's x axis points north and its y axis west; at 90, east and north."""
    points = np.array([[100.0, 0, 0], [0, 100, 0]])
    (x_lon, x_lat), (y_lon, y_lat) = Datum(50.0, 10.0, 0.0).geodetic(points)
    assert x_lat > 50.0008
    assert x_lon == pytest.approx(10.0, abs=1e-9)
    assert y_lon < 9.999
    assert y_lat == pytest.approx(50.0, abs=1e-7)
    (x_lon, x_lat), (y_lon, y_lat) = Datum(50.0, 10.0, 90.0).geodetic(points)
    assert x_lon > 10.001
    assert y_lat > 50.0008


def test_a_degree_along_the_equator_and_along_a_meridian():
    one = np.radians(1.0)
    ((longitude, latitude),) = Datum(0.0, 0.0, 90.0).geodetic(np.array([[_A * np.tan(one), 0.0, 0.0]]))
    assert (longitude, latitude) == pytest.approx((1.0, 0.0), abs=1e-12)  # straight ahead, seen from the earth's centre
    ((longitude, latitude),) = Datum(0.0, 180.0, 90.0).geodetic(np.array([[10.0, 0.0, 0.0]]))
    assert -180 <= longitude < -179.99  # past the antimeridian


@given(
    st.floats(-90, 90),
    st.floats(-180, 180),
    st.floats(0, 360),
    st.tuples(*[st.floats(-5000, 5000)] * 2, st.floats(-100, 500)),
)
def test_every_point_lies_where_its_vector_ends(latitude, longitude, heading, point):
    ((lon, lat),) = Datum(latitude, longitude, heading).geodetic(np.array([point]))
    assert -180 <= lon <= 180
    assert -90 <= lat <= 90
    origin = _cartesian(longitude, latitude, 0.0)
    phi, lam, turn = np.radians([latitude, longitude, heading])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    north = np.cross(up, east)
    x, y, z = point
    true = (
        origin + x * (np.sin(turn) * east + np.cos(turn) * north) + y * (np.sin(turn) * north - np.cos(turn) * east) + z * up
    )
    # some height over the found place is the point itself
    ground = _cartesian(lon, lat, 0.0)
    normal = _cartesian(lon, lat, 1.0) - ground
    assert np.linalg.norm(np.cross(true - ground, normal)) < 1e-6

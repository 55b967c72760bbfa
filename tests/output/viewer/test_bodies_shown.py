"""The bodies of objects in a recording, each in its shape, against the bodies themselves."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from rrd import Recording
from scipy.spatial.transform import Rotation
from synthetic_result import clusters, synthetic_result

from objslam.core.bodies.body import Body
from objslam.core.object_map import ObjectMap
from objslam.errors import OutputError
from objslam.output.viewer import application
from objslam.output.viewer.objects import log_objects
from objslam.output.viewer.view_point import first_view_point

LONG = Body("cuboid", np.array([0.8, 0.3, 0.9]), 0.5, np.full(3, 0.01), 0.1)


def things(*bodies: Body) -> ObjectMap:
    """A map of objects with these bodies."""
    result, _ = synthetic_result(*clusters(), keyframes=2)
    objects = result.map.objects[: len(bodies)]
    return ObjectMap(tuple(dataclasses.replace(o, body=body) for o, body in zip(objects, bodies, strict=True)))


def recorded(file: Path, *maps: ObjectMap, blueprint: rrb.Blueprint | None = None) -> Recording:
    """A recording of maps, each at its own time if there are several."""
    with rr.RecordingStream("bodies") as recording:
        recording.save(file, default_blueprint=blueprint)
        recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        path = np.zeros((1, 3))
        for moment, objects in enumerate(maps):
            recording.set_time("stamp", duration=float(moment))
            log_objects(recording, objects, first_view_point(objects, path), path, static=len(maps) == 1)
    recording.flush()
    return Recording(file)


def test_each_body_is_drawn_in_its_shape(tmp_path: Path) -> None:
    bin_, unknown = dataclasses.replace(LONG, shape="cylinder"), dataclasses.replace(LONG, yaw_sigma=0.6)
    objects = things(LONG, bin_, dataclasses.replace(LONG, shape="ellipsoid"), unknown)
    r = recorded(tmp_path / "a.rrd", objects)
    places = objects.positions
    for name, archetype, which in (("cuboids", "Boxes3D", 0), ("ellipsoids", "Ellipsoids3D", 2)):
        np.testing.assert_allclose(r.get(f"/map/objects/{name}", f"{archetype}:half_sizes")[0], [LONG.size / 2], rtol=1e-6)
        np.testing.assert_allclose(r.get(f"/map/objects/{name}", f"{archetype}:centers")[0], [places[which]], rtol=1e-6)
    # A cylinder of length 1 and radius 1/2, scaled to length, width and height. A cuboid of unknown heading is one too.
    entity = "/map/objects/cylinders"
    assert r.get(entity, "Cylinders3D:lengths")[0] == [1.0, 1.0]
    assert r.get(entity, "Cylinders3D:radii")[0] == [0.5, 0.5]
    np.testing.assert_allclose(r.get(entity, "InstancePoses3D:scales")[0], [LONG.size] * 2, rtol=1e-6)
    np.testing.assert_allclose(r.get(entity, "InstancePoses3D:translations")[0], places[[1, 3]], rtol=1e-6)
    turn = Rotation.from_quat(r.get(entity, "InstancePoses3D:quaternions")[0]).as_matrix()
    np.testing.assert_allclose(turn[:, :, 0], [[np.cos(0.5), np.sin(0.5), 0.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(turn[:, :, 2], [[0.0, 0.0, 1.0]] * 2, atol=1e-6)


def test_a_body_that_is_gone_is_cleared(tmp_path: Path) -> None:
    """Also when the thing becomes a body of another shape."""
    r = recorded(tmp_path / "a.rrd", things(dataclasses.replace(LONG, shape="cylinder")), things(LONG))
    assert [len(row) for row in r.get("/map/objects/cylinders", "Cylinders3D:lengths")] == [1, 0]
    assert [len(row) for row in r.get("/map/objects/cylinders", "InstancePoses3D:scales")] == [1, 0]
    assert [len(row) for row in r.get("/map/objects/cuboids", "Boxes3D:half_sizes")] == [0, 1]


def test_the_viewer_shows_a_cylinder_as_long_and_as_wide_as_it_is(tmp_path: Path) -> None:
    """From above, a cylinder along y is an ellipse as high as its length and as wide as its width."""
    size = np.array([1.6, 0.4, 0.2])
    (thing,) = things(dataclasses.replace(LONG, shape="cylinder", size=size, yaw=np.pi / 2))
    thing = dataclasses.replace(thing, position=np.zeros(3), covariance=None, extent=None)
    eye = rrb.EyeControls3D(position=(0.0, 0.0, 4.0), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 1.0, 0.0))
    view = rrb.Spatial3DView(
        origin="map",
        contents="map/objects/cylinders",
        background=(255, 255, 255),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )
    recorded(
        tmp_path / "a.rrd", ObjectMap((thing,)), ObjectMap((thing,)), blueprint=rrb.Blueprint(view, collapse_panels=True)
    )
    try:
        application.screenshot([tmp_path / "a.rrd"], tmp_path / "a.png", (800, 800))
    except OutputError as error:
        if "Vulkan" in str(error):
            pytest.skip(str(error))
        raise
    pixels = cv2.imread(str(tmp_path / "a.png"))[100:740].astype(int)
    rows, columns = np.nonzero(np.ptp(pixels, axis=2) > 25)
    wide, high = np.ptp(columns), np.ptp(rows)
    assert wide > 50
    assert high / wide == pytest.approx(4.0, rel=0.05)
    assert len(rows) / (wide * high) == pytest.approx(np.pi / 4, abs=0.03)  # An ellipse in its rectangle, not the rectangle.

"""The rotation of a fiducial in the table, in the recording and in the picture."""

import csv
import dataclasses
import io
from types import SimpleNamespace

import numpy as np
import pytest
from output.viewer.rrd import Recording
from scipy.spatial.transform import Rotation
from synthetic_result import clusters, synthetic_result

from objslam.core.bodies.tag_pose import TagPose
from objslam.output.export.formats.csv_file import EXPORT
from objslam.output.plot.figure import Line
from objslam.output.plot.map_plot import map_figure
from objslam.output.viewer.recording import write_recording

TURN = Rotation.from_euler("ZYX", [0.4, 0.2, 1.3])
SIDE = 0.3


@pytest.fixture
def result():
    """A result whose first object is a fiducial."""
    result, _ = synthetic_result(*clusters(), keyframes=30, unresolved=(4,))
    first, *others = result.map.objects
    tag = TagPose(TURN.as_quat(), np.diag([1e-4, 4e-4, 1e-4]), SIDE, 0.002)
    objects = (dataclasses.replace(first, tag=tag), *others)
    return dataclasses.replace(result, map=dataclasses.replace(result.map, objects=objects))


def corners(result):
    """The four corners in map, by scipy."""
    half = SIDE / 2
    local = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    return result.map.objects[0].position + TURN.apply(local)


def test_a_table_has_the_quaternion_and_the_size(result):
    rows = list(csv.DictReader(io.StringIO(EXPORT.dump(SimpleNamespace(objects=result.map)).decode())))
    found = Rotation.from_quat([float(rows[0][f"tag_q{axis}"]) for axis in "xyzw"])
    assert (found.inv() * TURN).magnitude() < 1e-12
    assert (float(rows[0]["tag_size"]), float(rows[0]["tag_size_sigma"])) == (SIDE, 0.002)
    assert float(rows[0]["tag_sigma_deg"]) == pytest.approx(np.degrees(0.02))
    assert {rows[1][name] for name in rows[1] if name.startswith("tag_")} == {""}


def test_a_recording_has_the_outline_and_the_axes(result, tmp_path):
    write_recording(result, tmp_path / "a.rrd", None)
    recording = Recording(tmp_path / "a.rrd")
    (strip,) = recording.get("/map/objects/tags", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(strip, corners(result)[[0, 1, 2, 3, 0]], rtol=1e-5, atol=1e-6)
    axes = np.array(recording.get("/map/objects/tags/axes", "Arrows3D:vectors")[0])
    np.testing.assert_allclose(axes, SIDE * TURN.as_matrix().T, atol=1e-6)


def test_the_picture_has_the_outline_and_the_normal(result):
    lines = [shape.points for shape in map_figure(result).shapes if isinstance(shape, Line)]
    at = result.map.objects[0].position
    outline, normal = corners(result)[[0, 1, 2, 3, 0], :2], TURN.as_matrix()[:2, 2]
    assert any(line.shape == outline.shape and np.allclose(line, outline) for line in lines)
    (ray,) = (line[1] - line[0] for line in lines if len(line) == 2 and np.allclose(line[0], at[:2]))
    assert ray[0] * normal[1] == pytest.approx(ray[1] * normal[0])
    assert ray @ normal > 0

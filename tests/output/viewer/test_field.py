"""The proximity field of an object as a recording."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from rrd import Recording, rgb
from scipy.optimize import minimize
from synthetic_result import clusters, synthetic_result

from objslam.config import Settings
from objslam.core.result import RunResult
from objslam.errors import ConfigError, OutputError
from objslam.output.result_folder import write_result
from objslam.output.viewer.field import heat, write_field


def written(tmp_path: Path, *, recording: bool) -> tuple[RunResult, Path]:
    settings = Settings.model_validate({"output": {"picture": False, "recording": recording}})
    result, _ = synthetic_result(*clusters(), keyframes=30, settings=settings)
    weight = result.weight.copy()
    weight[np.flatnonzero(result.association.object == 3)[:4]] = 0.0
    result = dataclasses.replace(result, weight=weight)
    write_result(result, tmp_path / "out")
    return result, tmp_path / "out"


@pytest.mark.parametrize("recording", [True, False])
def test_the_field_of_an_object_is_a_recording(tmp_path: Path, recording: bool) -> None:
    result, out = written(tmp_path, recording=recording)
    f = write_field(out, result.map.objects[3].id, tmp_path / "field.rrd")
    r = Recording(tmp_path / "field.rrd")
    assert {"/map/objects", "/map/objects/uncertainty", "/map/field/horizontal", "/map/field/vertical"} <= r.paths()
    assert ("/map/rays/now" in r.paths()) == recording
    mine = result.association.object == 3
    pull, rejected = mine & (result.weight > 0), mine & (result.weight == 0)
    assert rejected.sum() == 4 < pull.sum()

    def cost(point: np.ndarray) -> float:
        return float(np.linalg.norm(np.cross(point - result.origins[pull], result.directions[pull]), axis=1).mean())

    best = minimize(cost, result.map.objects[3].position, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-12})
    np.testing.assert_allclose(r.get("/map/field/minimum", "Points3D:positions")[0][0], best.x, atol=1e-4)
    np.testing.assert_allclose(f.cost, best.fun, atol=1e-8)
    np.testing.assert_allclose(
        r.get("/map/field/estimate", "Points3D:positions")[0][0], result.map.objects[3].position, rtol=1e-5
    )
    for name in ("horizontal", "vertical"):
        points = np.array(r.get(f"/map/field/{name}", "Points3D:positions")[0])
        colours = np.array([rgb(c) for c in r.get(f"/map/field/{name}", "Points3D:colors")[0]], dtype=float)
        assert len(points) == len(colours) == 101 * 101
        costs, brightness = np.array([cost(p) for p in points[::97]]), colours[::97].sum(axis=1)
        assert np.corrcoef(np.argsort(np.argsort(costs)), np.argsort(np.argsort(brightness)))[0, 1] < -0.99
        np.testing.assert_allclose(points[colours.sum(axis=1).argmax()], best.x, atol=0.02)
    for name, mask, leads in (("rays", pull, 2), ("rejected", rejected, 0)):
        strips = np.array(r.get(f"/map/field/{name}", "LineStrips3D:strips")[0])
        np.testing.assert_allclose(strips[:, 0], result.origins[mask], rtol=1e-5, atol=1e-5)
        (colour,) = r.get(f"/map/field/{name}", "LineStrips3D:colors")[0]
        assert np.argmax(rgb(colour)) == leads
    assert "| rejected rays (red) | 4 |" in r.get("/field", "TextDocument:text")[0][0]


def test_bright_is_close() -> None:
    colours = heat(np.array([[0.1, 0.2], [0.5, 1.1]]), 0.1, 1.1).astype(int).sum(axis=-1)
    assert colours[0, 0] > colours[0, 1] > colours[1, 0] > colours[1, 1]
    assert heat(np.array([0.3]), 0.3, 0.3).shape == (1, 3)  # all alike


def test_what_has_no_field_is_one_line(tmp_path: Path) -> None:
    result, out = written(tmp_path, recording=True)
    with pytest.raises(ConfigError, match="there is no object 99"):
        write_field(out, 99, tmp_path / "field.rrd")
    (out / "recording.rrd").write_bytes(b"RRF2 but not really")
    with pytest.raises(OutputError, match=r"recording\.rrd"):
        write_field(out, result.map.objects[0].id, tmp_path / "field.rrd")
    (out / "rays.parquet").unlink()
    with pytest.raises(OutputError, match=r"rays\.parquet"):
        write_field(out, result.map.objects[0].id, tmp_path / "field.rrd")
    assert not (tmp_path / "field.rrd").exists()


def test_a_single_ray_has_no_field(tmp_path: Path) -> None:
    settings = Settings.model_validate({"output": {"picture": False, "recording": False}})
    result, _ = synthetic_result(np.ones((1, 3)), ["cup"], keyframes=2, settings=settings)
    object_ = np.array([0, -1])
    result = dataclasses.replace(
        result, association=dataclasses.replace(result.association, object=object_), weight=np.ones(2)
    )
    write_result(result, tmp_path / "out")
    with pytest.raises(OutputError, match="1 rays"):
        write_field(tmp_path / "out", result.map.objects[0].id, tmp_path / "field.rrd")

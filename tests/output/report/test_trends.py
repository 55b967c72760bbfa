"""The charts of the residuals: each point is a median, and the report shows them beside the shared errors."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam.config import Output, Settings
from objslam.core.calibration import Calibration
from objslam.core.types import Images
from objslam.io.rays_parquet import RaysTable
from objslam.io.results.read import load_rays
from objslam.output.report import write_report
from objslam.output.report.charts import HEIGHT, WIDTH
from objslam.output.report.crops import cut_crops
from objslam.output.report.trends import trends
from objslam.output.result_folder import write_result

QUICK = Settings(mode="joint", output=Output(recording=False, picture=False))


def some_rays(count: int = 240) -> RaysTable:
    """Rays whose residual is 0.02 s times the turn rate after, and ten times as much before."""
    rng = np.random.default_rng(0)
    turn = rng.permutation(np.linspace(-0.5, 0.5, count))
    after = 0.02 * np.abs(turn)
    return RaysTable(
        object=np.zeros(count, dtype=np.int64),
        stamp=np.arange(count, dtype=float),
        frame_stamp=np.arange(count, dtype=float),
        origin=np.zeros((count, 3)),
        direction=np.tile([1.0, 0, 0], (count, 1)),
        residual=after,
        weight=np.ones(count),
        score=np.ones(count),
        camera=np.full(count, "front", dtype=object),
        box=np.zeros((count, 4)),
        label=np.full(count, "cup", dtype=object),
        sigma=np.full(count, 0.004),
        residual_before=10 * after,
        image=rng.uniform(0, 1, (count, 2)),
        speed=np.full(count, 0.5),
        turn_rate=turn,
    )


def test_each_point_is_the_median_of_its_rays() -> None:
    rays = some_rays()
    charts = {(t.title.split(",")[0], t.unit): t for t in trends(rays)}
    assert not [title for title, _ in charts if title == "speed"]  # it does not vary
    chart = charts["turn rate", "°"]
    assert [name for name, _ in chart.curves] == ["before", "after"]
    top = float(chart.beside[-1][1]) / HEIGHT
    order = np.argsort(rays.turn_rate)
    for name, points in chart.curves:
        residual = np.degrees(rays.residual_before if name == "before" else rays.residual)[order]
        expected = np.median(residual.reshape(12, 20), axis=1)
        assert [p.y * top for p in points] == pytest.approx(expected)
        turn = np.median(np.degrees(rays.turn_rate[order]).reshape(12, 20), axis=1)
        assert [p.x for p in points] == pytest.approx(WIDTH * (turn - turn[0]) / (turn[-1] - turn[0]))
        low, high = turn[0], turn[-1]
    for at, text in chart.below:
        assert low + at / WIDTH * (high - low) == pytest.approx(float(text), abs=1e-3)
    whitened = charts["turn rate", "sigmas"]
    factor = float(whitened.beside[-1][1]) / HEIGHT
    assert whitened.level == pytest.approx(1.17741 / factor, rel=1e-4)
    np.testing.assert_allclose(
        [p.y * factor for p in whitened.curves[1][1]], np.radians([p.y * top for p in chart.curves[1][1]]) / 0.004
    )


def test_rejected_rays_and_unknown_residuals_make_no_curve() -> None:
    rays = some_rays()
    out = np.arange(len(rays)) % 2 == 0
    worse = dataclasses.replace(
        rays,
        residual=np.where(out, 3.0, rays.residual),
        weight=np.where(out, 0.0, 1.0),
        residual_before=np.full(len(rays), np.nan),
    )
    for chart in trends(worse):
        ((name, points),) = chart.curves
        assert name == "after"
        assert max(p.y for p in points) * float(chart.beside[-1][1]) / HEIGHT < (0.6 if chart.unit == "°" else 3)
    assert trends(dataclasses.replace(rays, weight=np.zeros(len(rays)))) == []


def calibrated(tmp_path: Path) -> Path:
    result, _ = synthetic_result(*clusters(), keyframes=30, settings=QUICK)
    covariance = np.array([[1e-4, 0.0, 9.5e-5], [0.0, 9e-6, 0.0], [9.5e-5, 0.0, 1e-4]])
    found = Calibration(
        ("odometry.scale", "<b>front.clock", "range_scale"), np.array([0.02, -0.19, 0.004]), covariance,
        np.array([0.03, 0.1, 0.01]),
    )  # fmt: skip
    summary = {**result.summary, "calibration": found.to_dict()}
    before = result.residual + 0.05
    write_result(dataclasses.replace(result, summary=summary, calibration=found, residual_before=before), tmp_path)
    np.testing.assert_array_equal(load_rays(tmp_path).residual_before, before)
    return write_report(tmp_path)


def test_the_report_shows_the_shared_errors_and_both_curves(tmp_path: Path) -> None:
    text = calibrated(tmp_path).read_text(encoding="utf-8")
    rows = [
        row.partition("</tr>")[0] for row in text.partition('id="shared-errors"')[2].partition("</table>")[0].split("<tr")
    ]
    clock = next(row for row in rows if "front.clock" in row)
    assert "&lt;b&gt;front.clock" in clock
    for value in ("-0.1900", "0.0030", "0.1000", ">s<", "observable"):
        assert value in clock
    assert "not observable" not in clock
    assert "not observable from this log" in next(row for row in rows if "range_scale" in row)
    assert "This log cannot tell apart: odometry.scale and range_scale." in text
    assert text.count('class="curve before"') == text.count('class="curve after"') >= 4


def test_without_shared_errors_the_report_has_one_curve_and_no_table(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=30, settings=QUICK)
    write_result(result, tmp_path)
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert "shared-errors" not in text
    assert 'class="curve after"' in text
    assert 'class="curve before"' not in text


def test_images_are_found_by_the_stamps_of_their_frames(tmp_path: Path) -> None:
    """Whatever clock the run corrected, and at an end of the path, where corrected stamps are squeezed."""
    rays = some_rays(2)
    own = np.array([10.0, 11.0])
    rays = RaysTable(**{**vars(rays), "frame_stamp": own, "box": np.tile([20.0, 20.0, 60.0, 60.0], (2, 1))})
    for name, shade in (("a.png", 0), ("b.png", 255)):
        cv2.imwrite(str(tmp_path / name), np.full((80, 80, 3), shade, dtype=np.uint8))
    images = {"front": Images(own, (tmp_path / "a.png", tmp_path / "b.png"))}
    crops = cut_crops(rays, {0: "best", 1: "best"}, images, lambda done, total: None)
    middle = [cv2.imdecode(np.frombuffer(crops[k].jpeg, np.uint8), 0)[20:-20, 20:-20].mean() for k in (0, 1)]
    assert middle[0] < 60 < 200 < middle[1]

"""rays.parquet: what is written is read back, and the format stands by itself."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from objslam.errors import OutputError
from objslam.io.rays_parquet import RaysTable, dump_rays, read_rays


def three_rays() -> RaysTable:
    """The second of them belongs to no object."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(3, 3))
    corner = rng.uniform(0, 100, (3, 2))
    return RaysTable(
        object=np.array([7, -1, 0]),
        stamp=np.array([1.0, 1.5, 2.0]),
        frame_stamp=np.array([1.1, 1.6, 2.1]),
        origin=rng.normal(size=(3, 3)),
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        residual=np.array([0.0, np.nan, 0.0]),
        weight=np.array([1.0, 0.0, 0.4]),
        score=np.array([0.9, 0.8, 0.7]),
        camera=np.array(["front", "left", "front"], dtype=object),
        box=np.hstack([corner, corner + rng.uniform(1, 100, (3, 2))]),
        label=np.array(["cup", "café", "cup"], dtype=object),
        sigma=rng.uniform(0, 1, 3),
        residual_before=np.array([0.1, np.nan, 0.2]),
        image=rng.uniform(0, 1, (3, 2)),
        speed=rng.uniform(0, 1, 3),
        turn_rate=rng.normal(size=3),
    )


def test_every_column_comes_back(tmp_path: Path) -> None:
    sent = three_rays()
    (tmp_path / "rays.parquet").write_bytes(dump_rays(sent))
    found = read_rays(tmp_path / "rays.parquet")
    for field in dataclasses.fields(RaysTable):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(sent, field.name), field.name)


@pytest.mark.parametrize(
    ("column", "wrong"),
    [
        ("stamp", np.inf),
        ("origin", 1e8),
        ("direction", 0.9),
        ("residual", -0.1),
        ("weight", np.nan),
        ("box", np.nan),
        ("sigma", 0.0),
        ("speed", np.nan),
    ],
)
def test_a_ray_that_no_run_writes_is_refused(tmp_path: Path, column: str, wrong: float) -> None:
    values = getattr(three_rays(), column).copy()
    values[1] = wrong
    (tmp_path / "rays.parquet").write_bytes(dump_rays(dataclasses.replace(three_rays(), **{column: values})))
    with pytest.raises(OutputError, match="not what a run writes"):
        read_rays(tmp_path / "rays.parquet")


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("stamp", ["a", "b", "c"]),
        ("origin", [1.0, 2.0, 3.0]),
        ("origin", [[1.0], [1.0, 2.0, 3.0, 4.0], [1.0] * 4]),
        ("object", [0.5, 1.5, 2.5]),
        ("object", [b"1", b"2", b"3"]),
        ("camera", [1, 2, 3]),
        ("box", [None, [1.0] * 4, [1.0] * 4]),
    ],
)
def test_a_column_of_another_type_is_refused(tmp_path: Path, column: str, values: list[object]) -> None:
    file = tmp_path / "rays.parquet"
    file.write_bytes(dump_rays(three_rays()))
    table = pq.read_table(file)
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), file)
    with pytest.raises(OutputError, match="is damaged"):
        read_rays(file)


@pytest.mark.parametrize("column", ["camera", "label"])
def test_a_name_that_is_no_text_is_named(column: str) -> None:
    names = np.array(["cup", "half\ud800", "cup"], dtype=object)
    with pytest.raises(OutputError, match="cannot be written"):
        dump_rays(dataclasses.replace(three_rays(), **{column: names}))


def test_the_format_brings_nothing_of_the_run_along() -> None:
    code = "import sys, objslam.io.rays_parquet; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"pydantic", "scipy", "pyarrow", "objslam.core.result", "objslam.config"} & set(modules)

"""rays.parquet: what is written is read back, and the format stands by itself."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from objslam.errors import OutputError
from objslam.io.rays_parquet import RaysTable, dump_rays, read_rays


def three_rays() -> RaysTable:
    """The second of them belongs to no object."""
    rng = np.random.default_rng(0)
    return RaysTable(
        object=np.array([7, -1, 0]),
        stamp=np.array([1.0, 1.5, 2.0]),
        origin=rng.normal(size=(3, 3)),
        direction=rng.normal(size=(3, 3)),
        residual=np.array([0.0, np.nan, 0.0]),
        weight=np.array([1.0, 0.0, 0.4]),
        score=np.array([0.9, 0.8, 0.7]),
        camera=np.array(["front", "left", "front"], dtype=object),
        box=rng.uniform(0, 100, (3, 4)),
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


@pytest.mark.parametrize("column", ["camera", "label"])
def test_a_name_that_is_no_text_is_named(column: str) -> None:
    names = np.array(["cup", "half\ud800", "cup"], dtype=object)
    with pytest.raises(OutputError, match="cannot be written"):
        dump_rays(dataclasses.replace(three_rays(), **{column: names}))


def test_the_format_brings_nothing_of_the_run_along() -> None:
    code = "import sys, objslam.io.rays_parquet; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"pydantic", "scipy", "pyarrow", "objslam.core.result", "objslam.config"} & set(modules)

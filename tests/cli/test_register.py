"""The command `register`: a map is found again in a turned copy, and an empty map is refused with exit code 1."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from objslam import MapObject, ObjectMap
from objslam.cli import main
from objslam.core.geometry import lift_se2


def some_map(rng, count=10):
    objects = (
        MapObject(k, "cup" if k % 2 else "chair", rng.uniform(0, 8, 3), np.eye(3) * 1e-4, "ok", 9, 9, 40.0, 0.3, 0.0, 1.0)
        for k in range(count)
    )
    return ObjectMap(tuple(objects))


def test_a_turned_copy_is_found_and_an_empty_map_refused(tmp_path, monkeypatch, capsys):
    one = some_map(np.random.default_rng(0))
    pose = lift_se2(np.array([3.0, -2.0, 1.0]))
    two = replace(one, objects=tuple(replace(o, position=pose[:3, :3] @ o.position + pose[:3, 3]) for o in one))
    for name, objects in (("a", one), ("b", two), ("empty", ObjectMap(()))):
        objects.save(tmp_path / f"{name}.json")
    for other, code, words in (("b", 0, "x 3.000 y -2.000 z 0.000 m, yaw 57.30 deg"), ("empty", 1, "too little evidence")):
        monkeypatch.setattr(sys, "argv", ["objslam", "register", str(tmp_path / "a.json"), str(tmp_path / f"{other}.json")])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == code
        assert words in capsys.readouterr().out

"""The commands that lay maps on each other: `register`, and `run --map`. Their exit codes say whether it worked."""

import json
from dataclasses import replace

import numpy as np
from quick import QUICK

from objslam import MapObject, ObjectMap
from objslam.core.geometry import lift_se2
from objslam.mapping.localization import moved_log
from objslam.simulation import preset, simulate
from objslam.sources.log_folder import write_log_folder


def some_map(rng, count=10):
    objects = (
        MapObject(k, "cup" if k % 2 else "chair", rng.uniform(0, 8, 3), np.eye(3) * 1e-4, "ok", 9, 9, 40.0, 0.3, 0.0, 1.0)
        for k in range(count)
    )
    return ObjectMap(tuple(objects))


def test_a_turned_copy_is_found_and_an_empty_map_refused(tmp_path, objslam):
    one = some_map(np.random.default_rng(0))
    pose = lift_se2(np.array([3.0, -2.0, 1.0]))
    two = replace(one, objects=tuple(replace(o, position=pose[:3, :3] @ o.position + pose[:3, 3]) for o in one))
    for name, objects in (("a", one), ("b", two), ("empty", ObjectMap(()))):
        objects.save(tmp_path / f"{name}.json")
    for other, code, words in (("b", 0, "x 3.000 y -2.000 z 0.000 m, yaw 57.30 deg"), ("empty", 1, "too little evidence")):
        ended = objslam("register", tmp_path / "a.json", tmp_path / f"{other}.json")
        assert ended.code == code
        assert words in ended.out


def test_no_shift_or_turn_is_said_as_minus_zero(tmp_path, objslam):
    one = some_map(np.random.default_rng(0))
    pose = lift_se2(np.array([-1e-4, -1e-4, -1e-5]))
    two = replace(one, objects=tuple(replace(o, position=pose[:3, :3] @ o.position + pose[:3, 3]) for o in one))
    files = [str(tmp_path / f"{name}.json") for name in "ab"]
    for pair in ((one, two), (two, one)):
        for objects, file in zip(pair, files, strict=True):
            objects.save(file)
        for command in (["register", *files], ["merge", *files, "-o", str(tmp_path / "site")]):
            ended = objslam(*command)
            assert ended.code == 0
            assert "x 0.000 y 0.000 z 0.000 m, yaw 0.00 deg" in ended.out
            assert "-0.0" not in ended.out


def test_an_empty_folder_is_one_line_and_code_1(tmp_path, objslam):
    (tmp_path / "nothing").mkdir()
    said = objslam("register", tmp_path / "nothing", tmp_path / "nothing")
    assert said.code == 1
    assert said.out == ""
    assert "no result here: objects.json is missing" in said.err
    assert said.err.count("\n") == 1


def test_a_run_says_by_its_exit_code_whether_it_was_found_in_a_map(tmp_path, objslam):
    first = simulate(preset("demo", frames=200), 2)
    objects = tuple((o.label, tuple(o.position)) for o in first.truth.objects)
    second = simulate(preset("demo", frames=200, objects=0, placed=objects, path=(3, 2)), 102)
    write_log_folder(replace(first, truth=None), tmp_path / "first")
    write_log_folder(moved_log(second, lift_se2(np.array([3.0, -2.0, 1.0]))), tmp_path / "second")
    write_log_folder(simulate(preset("demo", frames=200), 5), tmp_path / "elsewhere")  # Objects of the same labels.

    assert objslam("run", tmp_path / "first", "-o", tmp_path / "map", *QUICK)[0] == 0
    assert objslam("run", tmp_path / "elsewhere", "-o", tmp_path / "other", *QUICK)[0] == 0
    for known, code, words in ((tmp_path / "map", 0, "localised in"), (tmp_path / "other", 3, "not localised in")):
        before = (known / "objects.json").read_bytes()
        out = tmp_path / f"out{code}"
        ended, said, _ = objslam("run", tmp_path / "second", "-o", out, "--map", known, *QUICK)
        assert ended == code
        told = json.loads((out / "summary.json").read_text())["localisation"]
        assert told["localised"] == (code == 0)
        assert told["line"].startswith(words)
        assert told["line"] in said
        assert objslam("report", out)[0] == 0
        assert words in (out / "report.html").read_text().lower()
        assert (known / "objects.json").read_bytes() == before
    assert ObjectMap.load(tmp_path / "out0").by_id(0).label == ObjectMap.load(tmp_path / "map").by_id(0).label

"""Every export read back by a library that knows nothing of objslam."""

import csv
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import jsonschema
import numpy as np
import open3d as o3d
import pytest
from small_log import small_log

from objslam.cli import main
from objslam.config import Output, Settings
from objslam.core.diagnostics import Ledger
from objslam.errors import ConfigError, OutputError
from objslam.graph.factors.odometry import motions
from objslam.io.results.read import load_map, load_trajectory
from objslam.mapping import pipeline
from objslam.output.export import FORMATS, write_export
from objslam.output.export.content import Datum
from objslam.output.plot.style import body_outline
from objslam.output.result_folder import write_result

SCHEMA = json.loads((Path(__file__).parent / "rfc7946.json").read_text())


def test_csv_holds_every_number(result, tmp_path):
    file = write_export(result, "csv", tmp_path / "x.csv")
    with file.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    objects = load_map(result).objects
    assert len(rows) == len(objects)
    for row, o in zip(rows, objects, strict=True):
        assert (int(row["id"]), row["label"], row["status"]) == (o.id, o.label, o.status)
        assert [float(row[axis]) for axis in "xyz"] == o.position.tolist()
        if o.covariance is None:
            assert row["cov_xx"] == row["cov_yz"] == ""
        else:
            names = [["xx", "xy", "xz"], ["xy", "yy", "yz"], ["xz", "yz", "zz"]]
            assert [[float(row[f"cov_{name}"]) for name in line] for line in names] == o.covariance.tolist()
        assert (int(row["rays"]), float(row["parallax_deg"])) == (o.rays, o.parallax_deg)
        assert (float(row["first_seen"]), float(row["last_seen"])) == (o.first_seen, o.last_seen)
        assert row["width"] == ("" if o.extent is None else repr(o.extent[0]))


@pytest.mark.parametrize("datum", [None, Datum(52.4006, 16.9508, 70.0)])
def test_geojson_is_what_the_rfc_asks_for(result, tmp_path, datum):
    data = json.loads(write_export(result, "geojson", tmp_path / "x.geojson", datum).read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(data)
    kinds = ("object", "path", "footprint")
    found, (path,), prints = ([f for f in data["features"] if f["properties"]["kind"] == kind] for kind in kinds)
    objects, trajectory = load_map(result).objects, load_trajectory(result)
    assert [f["id"] for f in found] == [o.id for o in objects]
    assert [f["properties"]["label"] for f in found] == [o.label for o in objects]
    assert [f["geometry"] is None for f in found] == [o.status != "ok" for o in objects]
    assert [f["properties"]["object"] for f in prints] == [o.id for o in objects if o.body is not None and o.status == "ok"]
    outlines = [body_outline(o) for o in objects if o.body is not None and o.status == "ok"]
    assert [len(f["geometry"]["coordinates"][0]) for f in prints] == [len(outline) for outline in outlines]
    assert all(f["geometry"]["coordinates"][0][0] == f["geometry"]["coordinates"][0][-1] for f in prints)
    assert len(path["geometry"]["coordinates"]) == len(trajectory)
    if datum is None:
        assert data["coordinates_in"] == "metres in the frame map"
        for feature, o in zip(found, objects, strict=True):
            if feature["geometry"]:
                np.testing.assert_allclose(feature["geometry"]["coordinates"], o.position, atol=1e-6)
        return
    assert "coordinates_in" not in data
    places = np.array([f["geometry"]["coordinates"] for f in found if f["geometry"]])
    assert places.shape[1] == 2  # a map does not know its height above the ellipsoid
    assert [f["properties"]["z"] for f in found] == [o.position[2] for o in objects]
    # distances on the ground are those of the map
    positions = np.array([o.position[:2] for o in objects if o.status == "ok"])
    north = np.radians(1) * _meridian_radius(datum.latitude)
    east = np.radians(1) * _normal_radius(datum.latitude) * np.cos(np.radians(datum.latitude))
    metres = (places - [datum.longitude, datum.latitude]) * [east, north]
    apart = [np.linalg.norm(points[:, None] - points, axis=2) for points in (metres, positions)]
    np.testing.assert_allclose(apart[0], apart[1], atol=2e-3)


def _meridian_radius(latitude):
    e2 = 0.00669437999014
    return 6378137.0 * (1 - e2) / (1 - e2 * np.sin(np.radians(latitude)) ** 2) ** 1.5


def _normal_radius(latitude):
    return 6378137.0 / np.sqrt(1 - 0.00669437999014 * np.sin(np.radians(latitude)) ** 2)


def test_ply_opens_in_open3d(result, tmp_path):
    file = write_export(result, "ply", tmp_path / "x.ply")
    shown = load_map(result).resolved()
    legacy = o3d.io.read_point_cloud(str(file))
    np.testing.assert_array_equal(np.asarray(legacy.points), [o.position for o in shown])
    assert len(legacy.colors) == len(shown)
    cloud = o3d.t.io.read_point_cloud(str(file))
    assert cloud.point["id"].numpy().ravel().tolist() == [o.id for o in shown]
    sigma = [np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]) for o in shown]
    np.testing.assert_allclose(cloud.point["sigma"].numpy().ravel(), sigma)
    comments = [
        line for line in file.read_bytes().partition(b"end_header")[0].decode().splitlines() if "comment label" in line
    ]
    names = [line.removeprefix(f"comment label {i} ") for i, line in enumerate(comments)]
    label = cloud.point["label"].numpy().ravel()
    assert [names[i] for i in label] == [" ".join(o.label.split()) for o in shown]


def test_g2o_is_the_graph_that_gtsam_reads(mapped, result, tmp_path):
    file = write_export(result, "g2o", tmp_path / "x.g2o")
    graph, values = gtsam.readG2o(str(file), True)
    trajectory = load_trajectory(result)
    assert values.size() == len(trajectory)
    poses = np.array([values.atPose3(i).matrix() for i in range(values.size())])
    np.testing.assert_allclose(poses, trajectory.poses, atol=1e-9)
    motion, covariance = motions(_at_base(mapped.keyframes), Settings())
    edges = [graph.at(i) for i in range(graph.size()) if isinstance(graph.at(i), gtsam.BetweenFactorPose3)]
    assert len(edges) == len(trajectory) - 1
    for i, edge in enumerate(edges):
        assert list(edge.keys()) == [i, i + 1]
        np.testing.assert_allclose(edge.measured().matrix(), motion[i], atol=1e-9)
        np.testing.assert_allclose(edge.noiseModel().covariance(), covariance[i], rtol=1e-6, atol=1e-12)
    # with nothing but these edges an optimiser finds the odometry
    graph.push_back(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    odometry = mapped.keyframes.odom_T_base[np.unique(mapped.keyframes.stamps, return_index=True)[1]]
    expected = poses[0] @ np.linalg.inv(odometry[0]) @ odometry[-1]
    np.testing.assert_allclose(solved.atPose3(len(poses) - 1).matrix(), expected, atol=1e-5)


def test_g2o_of_odometry_with_a_gap_fixes_both_stretches(mapped, tmp_path):
    stretch = (np.arange(len(mapped.keyframes)) >= 10).astype(np.int64)
    keyframes = replace(mapped.keyframes, localized_every=1.0, stretch=stretch)
    write_result(replace(mapped, keyframes=keyframes), tmp_path / "out")
    lines = write_export(tmp_path / "out", "g2o", tmp_path / "x.g2o").read_text().splitlines()
    fixed = [int(line.split()[1]) for line in lines if line.startswith("FIX")]
    edges = [tuple(map(int, line.split()[1:3])) for line in lines if line.startswith("EDGE")]
    poses = len(load_trajectory(tmp_path / "out"))
    assert fixed == [0, 10]
    assert edges == [(i, i + 1) for i in range(poses - 1) if i != 9]


def _at_base(keyframes):
    first = np.unique(keyframes.stamps, return_index=True)[1]
    taken = keyframes.take(first)
    return replace(taken, base_T_camera=np.tile(np.eye(4), (len(first), 1, 1)))


def test_g2o_needs_odometry_of_the_same_run(result, tmp_path):
    copy = Path(shutil.copytree(result, tmp_path / "out"))
    (copy / "motions.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(OutputError, match=r"motions\.parquet: not what a run writes"):
        write_export(copy, "g2o")
    (copy / "motions.parquet").unlink()
    with pytest.raises(OutputError, match="only a joint run with odometry writes"):
        write_export(copy, "g2o")
    shutil.copy(result / "motions.parquet", copy)
    lines = (copy / "trajectory.txt").read_text().splitlines()
    (copy / "trajectory.txt").write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(OutputError, match="from different runs"):
        write_export(copy, "g2o")


def test_a_fixed_run_says_why_it_has_no_edges(tmp_path):
    poses = Settings().poses.model_copy(update={"use": "odometry"})
    plain = Output(recording=False, picture=False)
    log = small_log(frames=30)
    for mode, edges in (("fixed", False), ("joint", True)):
        settings = Settings(mode=mode, poses=poses, output=plain)
        write_result(pipeline.run(log, settings, Ledger()), tmp_path / mode)
        assert (tmp_path / mode / "motions.parquet").exists() == edges
    assert write_export(tmp_path / "joint", "g2o").exists()
    with pytest.raises(OutputError, match="only a joint run with odometry writes"):
        write_export(tmp_path / "fixed", "g2o")


def test_a_file_goes_into_the_result_and_leaves_with_it(mapped, result, tmp_path):
    copy = Path(shutil.copytree(result, tmp_path / "out"))
    written = {write_export(copy, to).name for to in FORMATS}
    write_result(mapped, copy)  # An export of an older run would be taken for one of this run.
    assert not written & {file.name for file in copy.iterdir()}


@pytest.mark.parametrize("text", ["", "52,16", "52,16,90,1", "91,0,0", "0,181,0", "0,0,361", "a,b,c", "nan,0,0", "inf,0,0"])
def test_a_datum_that_is_none(text):
    with pytest.raises(ConfigError, match="--datum"):
        Datum.parse(text)


def test_what_cannot_be_exported(result, tmp_path):
    with pytest.raises(ConfigError, match=r"no meaning for csv.*--to geojson"):
        write_export(result, "csv", datum=Datum(0, 0, 0))
    with pytest.raises(ConfigError, match=r"no export format 'xls'.*csv, g2o, geojson"):
        write_export(result, "xls")
    with pytest.raises(OutputError, match="no such result folder"):
        write_export(tmp_path / "nowhere", "csv")
    with pytest.raises(OutputError, match="a folder has its name"):
        write_export(result, "csv", tmp_path)
    with pytest.raises(OutputError):
        write_export(result, "csv", tmp_path / "nowhere" / "x.csv")


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (("--to", "geojson", "--datum", "52.4,16.9,90"), 0, "wrote"),
        (("--to", "csv"), 0, "wrote"),
        (("--to", "g2o", "--datum", "1,2,3"), 2, "no meaning for g2o"),
        (("--to", "xls"), 2, "there is no export format 'xls'"),
        ((), 2, "--to"),
    ],
)
def test_the_command(result, tmp_path, capsys, monkeypatch, arguments, code, word):
    monkeypatch.setattr(sys, "argv", ["objslam", "export", str(result), "-o", str(tmp_path / "file"), *arguments])
    with pytest.raises(SystemExit) as exit_:
        main()
    said = capsys.readouterr()
    assert exit_.value.code == code
    assert word in said.out + said.err
    assert (tmp_path / "file").exists() == (code == 0)


def test_a_file_called_minus_is_stdout(result, tmp_path, capfdbinary, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["objslam", "export", str(result), "-o", "-", "--to", "ply"])
    monkeypatch.setattr(sys, "stdout", open(1, "w", closefd=False))  # noqa: SIM115 - the real one, as in a shell
    with pytest.raises(SystemExit) as exit_:
        main()
    sys.stdout.flush()
    assert exit_.value.code == 0
    assert capfdbinary.readouterr().out == write_export(result, "ply", tmp_path / "file").read_bytes()
    assert [file.name for file in tmp_path.iterdir()] == ["file"]

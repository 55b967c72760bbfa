"""The commands `merge` and `diff` on the results of two days, between which one object was taken, moved and added."""

import csv
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from objslam import ObjectMap, Result, diff, merge
from objslam.config import Settings
from objslam.config.settings import change_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.mapping.localization import moved_log
from objslam.mapping.pipeline import run
from objslam.output.plot.changes_plot import changes_figure
from objslam.output.report.scene import hexadecimal
from objslam.output.result_folder import write_result
from objslam.simulation import preset, simulate

UNKNOWN = lift_se2(np.array([3.0, -7.0, 2.0]))
TAKEN, MOVED = 0, 4
TO, ADDED = (0.44, 0.18, 0.7), (2.0, -2.0, 0.6)


@pytest.fixture(scope="module")
def days(tmp_path_factory):
    """The folders of both days, and the true objects of the first."""
    out = tmp_path_factory.mktemp("days")
    settings = change_settings(Settings(), {"output": {"recording": False, "picture": False}})
    first = simulate(preset("demo", objects=14), 2)
    objects = [(o.label, tuple(o.position)) for o in first.truth.objects]
    later = [o for k, o in enumerate(objects) if k not in (TAKEN, MOVED)] + [(objects[MOVED][0], TO), ("plant", ADDED)]
    second = simulate(preset("demo", objects=0, placed=tuple(later), path=(3, 2)), 102)
    for name, log in (("a", first), ("b", moved_log(second, UNKNOWN))):
        write_result(run(log, settings, Ledger()), out / name)
    return out, objects


def test_diff_tells_what_changed_and_draws_it(days, tmp_path, objslam):
    out, objects = days
    picture = tmp_path / "diff.png"
    code, said, _ = objslam("diff", out / "a", out / "b", "-o", picture)
    assert code == 0
    assert "12 confirmed, 1 moved, 1 gone, 1 new, 0 unconfirmed" in said
    assert len(re.findall("│ confirmed +│", said)) == 12
    assert picture.read_bytes()[:4] == b"\x89PNG"
    code, said, _ = objslam("diff", out / "a", out / "b", "--json")
    told = json.loads(said)
    by = {one["outcome"]: one for one in told["changes"]}
    np.testing.assert_allclose(by["gone"]["position"], objects[TAKEN][1], atol=0.05)
    np.testing.assert_allclose(by["moved"]["position"], TO, atol=0.05)
    np.testing.assert_allclose(by["moved"]["moved_from"], objects[MOVED][1], atol=0.05)
    np.testing.assert_allclose(by["new"]["position"], ADDED, atol=0.05)
    np.testing.assert_allclose(np.array(told["a_T_b"]) @ UNKNOWN, np.eye(4), atol=0.05)
    maps = [ObjectMap.load(out / name) for name in ("a", "b")]
    for one in told["changes"]:  # Each id is one of the map that it is said to be of.
        labels = [
            next((o.label for o in m if o.id == one[key]), None) for m, key in zip(maps, ("id_a", "id_b"), strict=True)
        ]
        assert {one["label"]} == set(labels) - {None}
    assert [by["gone"]["id_b"], by["new"]["id_a"]] == [None, None]
    assert told["warnings"] == []


def test_diff_says_what_a_live_result_cannot_tell_and_what_to_do(days, tmp_path, objslam):
    out, _ = days
    live = tmp_path / "live"
    shutil.copytree(out / "b", live)
    (live / "views.parquet").unlink()
    (live / "journal.objslam").write_bytes(b"")
    code, said, warned = objslam("diff", out / "a", live)
    assert code == 0
    assert "12 confirmed, 0 moved, 0 gone, 2 new, 2 unconfirmed" in said
    assert "nothing can be called gone or moved" in warned
    assert f"objslam run {live} -o {live}_again, then objslam diff {out / 'a'} {live}_again" in warned
    code, said, warned = objslam("diff", live, out / "b", "--json")
    (line,) = json.loads(said)["warnings"]
    assert f"warning: {line}\n" == warned
    assert f"objects that only {out / 'b'} has count as new" in line


def test_merge_writes_a_site_that_the_next_session_joins(days, tmp_path, objslam):
    out, _ = days
    code, said, _ = objslam("merge", out / "a", out / "b", "-o", tmp_path / "site")
    assert code == 0
    assert "14 objects (1 gone) from 2 sessions: 12 confirmed, 1 moved, 1 new, 0 unconfirmed" in said
    site = ObjectMap.load(tmp_path / "site")
    assert [len(site), len(site.gone)] == [14, 1]
    assert {o.life.state for o in site} == {"confirmed", "moved", "new"}
    assert (tmp_path / "site" / "map.png").is_file()
    code, _, error = objslam("view", tmp_path / "site")
    assert code == 1
    assert "this is the map of a site, which has no recording.rrd (look at map.png" in error
    reported(objslam, tmp_path / "site", site)
    exported(objslam, tmp_path / "site", site)
    again = merge([tmp_path / "site", out / "b"])
    assert len(again) == 1
    assert {o.id for o in again[0].objects} == {o.id for o in site}
    assert all(o.life.sessions_seen >= 2 for o in again[0].objects)
    found = diff(Result.load(out / "a"), tmp_path / "site")
    assert found.registration.accepted


def reported(objslam, folder, site):
    """The page has a line for each object and each session. A summary of a wrong shape is one clear line."""
    assert objslam("report", folder)[0] == 0
    page = (folder / "report.html").read_text()
    lines = [re.sub(r"<[^>]+>", " ", line).split() for line in page.splitlines() if line.startswith("<tr")]
    states = {o.id: o.life.state for o in (*site, *site.gone)}
    assert {int(line[0]): line[3] for line in lines if line[0].isdigit()} == states
    assert sum(str(folder.parent) in line[0] or "days" in line[0] for line in lines) == 2
    scene = json.loads(re.search(r'id="scene-data">(.*?)</script>', page, re.DOTALL)[1])
    figure = changes_figure([(o.life.state, o) for o in (*site, *site.gone)], "")
    of_picture = {one.name.split(" (")[0]: hexadecimal(one.colour) for one in figure.shapes if getattr(one, "name", "")}
    assert {o["id"]: o["colour"] for o in scene["objects"]} == {o.id: of_picture[states[o.id]] for o in site}
    assert all(f'background:{colour}"></span>{state}</span>' in page for state, colour in of_picture.items())
    assert page.index("<details>") < page.index('<figure class="map') < page.index("</details>")
    summary = folder / "summary.json"
    text = summary.read_text()
    summary.write_text(re.sub(r'"yaw_deg": [^,\n]+', '"yaw_deg": "east"', text))
    code, _, error = objslam("report", folder)
    assert code == 1
    assert "not what objslam writes" in error
    summary.write_text(text)


def exported(objslam, folder, site):
    """The files of other tools say what became of each object. There is no path to export."""
    for to in ("csv", "geojson", "mcap", "ply"):
        assert objslam("export", folder, "--to", to)[0] == 0
    states = {o.id: o.life.state for o in (*site, *site.gone)}
    rows = list(csv.DictReader((folder / "objects.csv").read_text().splitlines()))
    assert {int(row["id"]): row["state"] for row in rows} == states
    (moved,) = (o for o in site if o.life.state == "moved")
    (row,) = (row for row in rows if row["state"] == "moved")
    assert [float(row[f"moved_from_{axis}"]) for axis in "xyz"] == moved.life.moved_from.tolist()
    features = json.loads((folder / "objects.geojson").read_text())["features"]
    told = {one["id"]: one["properties"]["state"] for one in features if one["properties"]["kind"] == "object"}
    assert told == states
    assert not any(one["properties"]["kind"] == "path" for one in features)
    with AnyReader([folder / "map.mcap"]) as reader:
        (markers,) = [c for c in reader.connections if c.topic == "/objslam/markers"]
        ((_, _, data),) = reader.messages([markers])
        texts = [m.text for m in reader.deserialize(data, markers.msgtype).markers if m.text]
    assert sorted(text.rpartition(", ")[2] for text in texts) == sorted(states[o.id] for o in site if o.status == "ok")
    code, _, error = objslam("export", folder, "--to", "g2o")
    assert code == 1
    assert "which has no path" in error


def test_maps_of_two_places_stay_apart_and_are_said(days, tmp_path, objslam):
    out, _ = days
    (tmp_path / "empty.json").write_text('{"format": "objslam.objects/2", "frame": "map", "objects": []}')
    code, said, _ = objslam("diff", out / "a", tmp_path / "empty.json")
    assert code == 1
    assert said == f"not registered: too little evidence, because {tmp_path / 'empty.json'} has no resolved object\n"
    code, _, warned = objslam("merge", out / "a", tmp_path / "empty.json", "-o", tmp_path / "site")
    assert code == 0
    assert "2 islands without objects in common" in warned
    assert (tmp_path / "site" / "island_2" / "objects.json").is_file()
    code, _, warned = objslam("merge", out / "a", "-o", tmp_path / "site")
    assert code == 0
    assert f"{tmp_path / 'site' / 'island_2'} remains from an earlier merge" in warned
    with pytest.raises(ValueError, match="at least one"):
        merge([])


def test_a_map_that_lies_on_its_side_is_named(days, tmp_path, objslam):
    """The second day as visual SLAM gives it, in the frame of the first camera."""
    a, lying = days[0] / "a", tmp_path / "lying"
    shutil.copytree(days[0] / "b", lying)
    y_down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    objects = ObjectMap.load(lying)
    turned = (
        o if o.status != "ok" else replace(o, position=y_down @ o.position, covariance=y_down @ o.covariance @ y_down.T)
        for o in objects
    )
    replace(objects, objects=tuple(turned), shared_covariance=None).save(lying / "objects.json")
    summary = json.loads((lying / "summary.json").read_text())
    (lying / "summary.json").write_text(json.dumps({**summary, "up": "-y"}))
    why = f"{lying} lies on its side (up is -y); maps are matched only with z up"
    for command in (["register", lying, a], ["diff", a, lying]):
        code, said, _ = objslam(*command)
        assert code == 1
        assert f"not registered: {why}" in said
    code, said, _ = objslam("register", a, lying / "objects.json")
    assert f"not registered: {lying / 'objects.json'} lies on its side" in said
    code, _, warned = objslam("merge", a, lying, "-o", tmp_path / "site")
    assert why in warned

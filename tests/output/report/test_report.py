"""The report, read back as a browser would: what it shows, that no text of a result runs as code, that it loads nothing."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam import config
from objslam.cli import main
from objslam.config import Settings
from objslam.core.bodies.body import UNKNOWN_YAW, Body
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.result import DOUBT_KINDS, Doubt
from objslam.errors import LogError, OutputError
from objslam.evaluation.evaluate import evaluate
from objslam.evaluation.evaluate_folder import evaluate_folder, write_evaluation
from objslam.io.results.files import dump_doubts
from objslam.io.results.read import load_map, load_rays, load_trajectory, load_truth
from objslam.mapping import pipeline
from objslam.output.report import write_report
from objslam.output.report.charts import HEIGHT, axis_end, histogram
from objslam.output.report.crops import best_rays
from objslam.output.result_folder import write_result
from objslam.simulation import make_camera
from objslam.sources import SourceOptions, read

EVIL = [
    "<script>alert(1)</script>",
    "\"><img src=x onerror='alert(2)'>",
    "{{ 7 * 7 }}</style></title>&amp;",
    "Bücher & Töpfe",
]
QUICK = Settings(mode="joint", output=config.Output(recording=False, picture=False))
VOID = {"meta", "img", "line", "rect", "br", "input"}


class Page(HTMLParser):
    """Checks that every tag closes, and keeps elements, the text of each kind and the table of the objects."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, list[str]] = {}
        self.rows: list[list[str]] = []
        self._sortable = False
        self.feed(file.read_text(encoding="utf-8"))
        assert not self.stack

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._sortable |= tag == "table" and dict(attrs).get("class") == "sortable"
        if tag not in VOID:
            self.stack.append(tag)
        if self._sortable and tag == "tr":
            self.rows.append([])
        if self._sortable and tag == "td":
            self.rows[-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag
        self._sortable &= tag != "table"

    def handle_data(self, data: str) -> None:
        self.text.setdefault(self.stack[-1] if self.stack else "", []).append(data)
        if self._sortable and "td" in self.stack:
            self.rows[-1][-1] += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def all_text(self) -> str:
        return " ".join(part for tag, parts in self.text.items() if tag not in ("script", "style") for part in parts)


def evil_result(tmp_path: Path) -> Path:
    positions = np.array([[2.0, 3.0, 0.5], [8.0, 4.0, 1.0], [5.0, 12.0, 0.2], [1.0, 9.0, 0.4]])
    result, truth = synthetic_result(positions, EVIL, keyframes=30, unresolved=(2,), settings=QUICK)
    evil = "<b onmouseover=alert(3)>late</b>"
    summary = {**result.summary, "warnings": [evil], "dropped": {evil: 3}, "dropped_examples": {evil: [evil]}, "log": evil}
    write_result(dataclasses.replace(result, summary=summary), tmp_path / "out", truth)
    return write_report(tmp_path / "out")


def test_the_page_has_words_for_each_kind_of_doubt(tmp_path):
    result, truth = synthetic_result(*clusters(), keyframes=40)
    pair, nothing = tuple(o.id for o in result.map.objects[:2]), np.zeros(0, dtype=np.int64)
    doubts = tuple(Doubt(kind, "why", "cup", f"the {kind} doubt", pair, None, nothing, {}) for kind in DOUBT_KINDS)
    write_result(replace(result, doubts=doubts), tmp_path / "out", truth)
    page = write_report(tmp_path / "out").read_text()
    assert all(f"the {kind} doubt" in page for kind in DOUBT_KINDS)


def test_text_of_others_is_text(tmp_path: Path) -> None:
    page = Page(evil_result(tmp_path))
    data, program = page.text["script"]
    assert [script.get("type") for script in page.of("script")] == ["application/json", None]
    assert "alert" not in program
    assert "<" not in data
    assert {o["name"] for o in json.loads(data)["objects"]} == set(EVIL)
    assert {row[1] for row in page.rows if row} == set(EVIL)
    assert page.all_text.count("<b onmouseover=alert(3)>late</b>") == 4
    for _, attributes in page.elements:
        assert not [name for name in attributes if name.startswith("on")]


def test_it_asks_for_nothing_outside(tmp_path: Path) -> None:
    page = Page(evil_result(tmp_path))
    for tag, attributes in page.elements:
        for name in ("src", "href", "action", "data", "srcset", "xlink:href"):
            if name in attributes:
                assert re.match(r"data:image/(png|jpeg);base64,|#object-\d+$|#map$", attributes[name] or ""), (tag, name)
    (policy,) = [m["content"] for m in page.of("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert (policy or "").startswith("default-src 'none'; img-src data:;")
    assert not re.search(r"url\(|@import", page.text["style"][0])


def test_the_table_is_the_map(tmp_path: Path) -> None:
    result, truth = synthetic_result(*clusters(), keyframes=40, unresolved=(4,))
    write_result(result, tmp_path, truth)
    page = Page(write_report(tmp_path))
    rows = [row for row in page.rows if row]
    assert len(rows) == 15
    for row, o in zip(rows, result.map.objects, strict=True):
        assert row[:2] == [str(o.id), o.label]
        assert row[3:6] == [f"{x:.3f}" for x in o.position]
        sigma = "" if o.covariance is None else f"{np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]):.3f}"
        assert row[6:8] == [sigma, str(o.rays)]
        assert row[2] == o.status
    links = {a["href"] for a in page.of("a")} - {"#map"}
    cards = {f"#{c['id']}" for c in page.of("article")}
    assert links == cards == {f"#object-{o.id}" for o in result.map.objects}
    png = next(image["src"] for image in page.of("img"))
    assert base64.b64decode((png or "").partition(",")[2]) == (tmp_path / "map.png").read_bytes()
    assert "the clock of the camera runs 0.04 s late" in page.all_text
    assert '"joint"' in page.text["td"]  # a setting that was changed
    assert any(text.startswith("mode: joint") for text in page.text["pre"])


def test_bodies_have_a_size_and_an_unknown_heading_is_no_number(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=40)
    body = Body("ellipsoid", np.array([0.6, 0.4, 0.9]), np.pi / 6, np.full(3, 0.012), np.radians(5))
    first, second, *others = result.map.objects
    bodies = (replace(first, body=body), replace(second, body=replace(body, yaw_sigma=UNKNOWN_YAW)), *others)
    write_result(replace(result, map=ObjectMap(bodies)), tmp_path)
    page = Page(write_report(tmp_path))
    rows = [row for row in page.rows if row]
    assert [row[7] for row in rows[:3]] == ["0.60 × 0.40 × 0.90", "0.60 × 0.40 × 0.90", ""]
    assert page.all_text.count("0.60 × 0.40 × 0.90 m (length, width, height)") == 2
    assert page.all_text.count("30°, sigma 5°") == 1
    assert len(re.findall(r"\bunknown\b", page.all_text)) == 1


@pytest.mark.parametrize("evaluated", [True, False])
def test_errors_come_from_the_evaluation_or_the_truth(tmp_path: Path, evaluated: bool) -> None:
    result, truth = synthetic_result(*clusters(), keyframes=40, settings=QUICK)
    write_result(result, tmp_path, truth)
    evaluation = evaluate(load_map(tmp_path), load_truth(tmp_path), load_trajectory(tmp_path))
    if evaluated:
        write_evaluation(evaluation, tmp_path)
    page = Page(write_report(tmp_path))
    assert evaluation.objects is not None
    errors = {str(m.object.id): f"{m.error:.3f}" for m in evaluation.objects.matches}
    assert {row[0]: row[10] for row in page.rows if row} == errors
    assert f"{evaluation.to_dict()['position_rmse']:.3f} m" in page.text["td"]


def test_a_comparison_of_two_maps_is_not_called_the_truth(tmp_path: Path) -> None:
    result, truth = synthetic_result(*clusters(), keyframes=10, settings=QUICK)
    write_result(result, tmp_path / "mine", truth)
    write_result(result, tmp_path / EVIL[0].replace("/", "") / "other")
    other = tmp_path / EVIL[0].replace("/", "") / "other" / "objects.json"
    told = {}
    for given in (None, other):
        write_evaluation(evaluate_folder(tmp_path / "mine", given), tmp_path / "mine")
        told[given] = Page(write_report(tmp_path / "mine"))
    assert "Against the ground truth, without alignment" in told[None].all_text
    assert "ground truth" not in told[other].all_text
    assert "truth id" not in told[other].all_text
    assert f"Against {other}, without alignment" in told[other].all_text
    assert "objects' RMSE, against other/objects.json" in told[other].text["span"]
    assert len(told[other].of("script")) == 2


def test_an_error_names_the_id_of_its_truth(tmp_path: Path) -> None:
    result, truth = synthetic_result(*clusters(), keyframes=40, settings=QUICK)
    write_result(result, tmp_path, truth)
    page = Page(write_report(tmp_path))
    assert "(truth id 3)" in page.all_text


def test_labels_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    positions, labels = clusters()
    result, _ = synthetic_result(positions, labels[::-1], keyframes=20, settings=QUICK)
    write_result(result, tmp_path)
    page = Page(write_report(tmp_path))
    assert [row[1] for row in page.rows if row] == [f"landmark_{i}" for i in range(6, 21)]


def test_existence_has_a_column_where_it_was_judged(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20, settings=QUICK)
    objects = tuple(dataclasses.replace(o, existence=0.75 if o.id == 1 else None) for o in result.map.objects)
    write_result(dataclasses.replace(result, map=ObjectMap(objects)), tmp_path)
    page = Page(write_report(tmp_path))
    rows = [row for row in page.rows if row]
    assert [row[10] for row in rows] == ["0.750"] + [""] * 14


def test_without_a_truth_there_is_no_error(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20, settings=QUICK)
    write_result(result, tmp_path)
    page = Page(write_report(tmp_path))
    assert len(next(row for row in page.rows if row)) == 10
    assert "Evaluation" not in page.text["h2"]


@pytest.mark.parametrize(("level", "said"), [("good", "Good."), ("check", "Look closer."), ("bad", "Do not use this map.")])
def test_the_verdict_stands_at_the_top(tmp_path: Path, level: str, said: str) -> None:
    result, _ = synthetic_result(np.array([[2.0, 3.0, 0.5]]), ["cup"], keyframes=10, settings=QUICK)
    judged = {"level": level, "reasons": [EVIL[0], "Drive around things."]}
    write_result(dataclasses.replace(result, summary={**result.summary, "assessment": judged}), tmp_path)
    page = write_report(tmp_path).read_text("utf-8")
    Page(tmp_path / "report.html")
    top = page[page.index("<header>") : page.index('<ul class="tiles">')]
    assert f"<b>{said}</b> &lt;script&gt;alert(1)&lt;/script&gt; Drive around things." in top


def test_an_empty_map(tmp_path: Path) -> None:
    result, _ = synthetic_result(np.zeros((0, 3)), [], keyframes=10, settings=QUICK)
    write_result(dataclasses.replace(result, map=ObjectMap(())), tmp_path)
    page = Page(write_report(tmp_path))
    assert "No object was found." in page.text["p"]


def test_the_histograms_of_the_page_are_in_degrees(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=40, settings=QUICK)
    write_result(result, tmp_path)
    page = Page(write_report(tmp_path))
    bars = [text for text in page.text["title"] if " deg: " in text]
    chart = histogram(np.degrees(result.residual), result.weight, 32)
    assert chart is not None
    expected = [bar.text for bar in chart.bars if bar.used or bar.rejected]
    assert bars[: len(expected)] == expected


def test_the_histogram_counts_every_ray() -> None:
    rng = np.random.default_rng(0)
    residual = np.concatenate([rng.rayleigh(0.4, 500), np.full(7, 30.0), np.full(20, np.nan)])
    weight = np.where(np.arange(527) % 5 == 0, 0.0, 1.0)
    chart = histogram(residual, weight, 20)
    assert chart is not None
    used, rejected = (sum(getattr(bar, kind) for bar in chart.bars) for kind in ("used", "rejected"))
    known = np.isfinite(residual)
    unit = HEIGHT / chart.highest
    assert round(used / unit) == (known & (weight > 0)).sum()
    assert round(rejected / unit) == (known & (weight == 0)).sum()
    assert max(bar.used + bar.rejected for bar in chart.bars) == pytest.approx(HEIGHT)
    assert chart.counts[0] == (0.0, "0")
    for height, text in chart.counts:
        assert height == pytest.approx(int(text) * unit)
    assert 2 <= int(chart.highest / int(chart.counts[1][1])) <= 5
    few = histogram(np.array([0.1]), np.ones(1), 5)
    assert few is not None
    assert [text for _, text in few.counts] == ["0", "1"]
    assert chart.beyond == (residual[known] > 2.0).sum()
    assert histogram(np.array([np.nan]), np.ones(1), 5) is None
    assert [axis_end(np.full(9, x)) for x in (0.013, 0.1, 0.3, 2.0, 7.0)] == pytest.approx([0.02, 0.1, 0.5, 2.0, 10.0])


@pytest.fixture(scope="module")
def mapped_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with images in which each thing is a patch of a colour of its own, and the folder of its result."""
    tmp_path = tmp_path_factory.mktemp("mapped") / "here"
    tmp_path.mkdir()
    from small_log import small_log

    from objslam.core.types import Images
    from objslam.sources.log_folder import write_log_folder

    log = small_log(
        cameras=(make_camera("left", width=320, height=240, focal=190.0, position=(0.0, 0.0, 0.3), yaw=np.pi / 2),)
    )
    camera_log = log.cameras[0]
    boxes = camera_log.detections
    assert boxes is not None
    files = []
    (tmp_path / "images").mkdir()
    for i in range(len(boxes.frame_stamps)):
        image = np.full((240, 320, 3), 90, np.uint8)
        for j in np.flatnonzero(boxes.frame == i):
            x1, y1, x2, y2 = np.rint(boxes.boxes[j]).astype(int).tolist()
            cv2.rectangle(image, (x1, y1), (x2, y2), COLOURS[boxes.label_names[boxes.label[j]]], -1)
        files.append(tmp_path / "images" / f"{i:03d}.png")
        cv2.imwrite(str(files[-1]), image)
    with_images = dataclasses.replace(camera_log, rgb=Images(boxes.frame_stamps, tuple(files)))
    write_log_folder(dataclasses.replace(log, cameras=(with_images,)), tmp_path / "log")
    result = pipeline.run(read(tmp_path / "log", Ledger(), SourceOptions()), Settings(output=QUICK.output), Ledger())
    write_result(result, tmp_path / "out")
    return tmp_path


@pytest.fixture
def mapped(mapped_once: Path) -> Iterator[Path]:
    """What a test may change of `mapped_once`. It stays in its place, because the result names the folder of its log."""
    kept = mapped_once.with_name("kept")
    mapped_once.rename(kept)
    shutil.copytree(kept, mapped_once, symlinks=True)
    yield mapped_once
    shutil.rmtree(mapped_once)
    kept.rename(mapped_once)


COLOURS = {"cup": (220, 30, 30), "tall chair": (30, 200, 30), "Bücherregal": (20, 20, 210), "plant": (200, 30, 200)}


def pictures(page: Page) -> list[tuple[str, Any]]:
    """What each picture of a box is of, and its pixels."""
    found = []
    for image in page.of("img"):
        kind, _, data = (image["src"] or "").partition(",")
        if kind == "data:image/jpeg;base64":
            pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
            found.append(((image["alt"] or "").removeprefix("box of "), pixels))
    return found


def test_doubts_are_said_with_pictures_of_their_boxes(mapped: Path) -> None:
    rays = load_rays(mapped / "out")
    plants = np.flatnonzero(rays.label == "plant")
    text = "2 plant boxes near (1.00, 2.00, 3.00): <b>their rays</b> miss a common point by 6 cm, and 3 sigma are 2 cm."
    doubt = Doubt("boxes", "apart", "plant", text, (0, 99), np.array([1.0, 2.0, 3.0]), plants[:2], {})
    beyond = dataclasses.replace(doubt, kind="pair", rays=np.array([len(rays) + 5]))  # A ray that is not in the file.
    before = Page(write_report(mapped / "out", crops=3))
    out = mapped / "doubtful"
    shutil.copytree(mapped / "out", out)
    (out / "doubts.json").write_text(dump_doubts([doubt, beyond]))
    page = Page(write_report(out, log=mapped / "log", crops=3))
    assert page.all_text.count(text) == 2
    assert {"href": "#object-0"} in page.of("a")
    assert {"href": "#object-99"} not in page.of("a")
    more = Counter(label for label, _ in pictures(page)) - Counter(label for label, _ in pictures(before))
    assert more == {"plant": 2}
    assert "Doubts" not in before.all_text


def test_the_pictures_show_the_objects(mapped: Path) -> None:
    page = Page(write_report(mapped / "out", crops=3))
    found = pictures(page)
    per_object = Counter(label for label, _ in found)
    assert all(per_object[label] > 3 for label in COLOURS)  # three of the best, and some of the worst
    for label, pixels in found:
        middle = pixels[pixels.shape[0] // 2 - 3 :, pixels.shape[1] // 2 - 3 :][:6, :6].reshape(-1, 3)
        assert np.abs(np.median(middle, axis=0) - COLOURS[label]).max() < 30
        assert max(pixels.shape) <= 160
    assert not pictures(Page(write_report(mapped / "out", crops=0)))


def test_a_log_that_is_gone_or_elsewhere(mapped: Path) -> None:
    (mapped / "log").rename(mapped / "moved")
    page = Page(write_report(mapped / "out"))
    assert not pictures(page)
    assert f"No pictures. The log is not at {mapped / 'log'} any more" in page.all_text
    before = (mapped / "out" / "report.html").read_bytes()
    with pytest.raises(LogError, match="The log is not at /nowhere"):  # A page with pictures is not replaced by one without.
        write_report(mapped / "out", log=Path("/nowhere"), images_needed=True)
    assert (mapped / "out" / "report.html").read_bytes() == before
    # A fleet names the log of each map, also of logs without images.
    assert not pictures(Page(write_report(mapped / "out", log=Path("/nowhere"))))
    assert len(pictures(Page(write_report(mapped / "out", log=mapped / "moved")))) > 16


def test_another_log_in_the_place_of_the_runs_is_noticed(mapped: Path) -> None:
    listed = (mapped / "log" / "rgb.txt").read_text()
    later = re.sub(r"^(\d+)", lambda stamp: str(int(stamp[0]) + 5000), listed, flags=re.MULTILINE)
    (mapped / "log" / "rgb.txt").write_text(later)
    page = Page(write_report(mapped / "out"))
    assert not pictures(page)
    assert "is it the log of this run?" in page.all_text
    (mapped / "log" / "rgb.txt").unlink()
    images = json.loads((mapped / "out" / "summary.json").read_text())["counts"]["images"]
    assert f"has no images, but the log of the run had {images}" in Page(write_report(mapped / "out")).all_text


def test_no_file_outside_the_log_is_shown(mapped: Path) -> None:
    listed = (mapped / "log" / "rgb.txt").read_text()
    (mapped / "log" / "rgb.txt").write_text(re.sub(r"rgb/", "../images/", listed))
    page = Page(write_report(mapped / "out"))
    assert not pictures(page)
    for link in (mapped / "log" / "rgb").iterdir():
        link.unlink()
        link.symlink_to(mapped / "images" / link.name)
    (mapped / "log" / "rgb.txt").write_text(listed)
    assert not pictures(Page(write_report(mapped / "out")))


def test_the_best_boxes_are_spread_over_time(mapped: Path) -> None:
    rays = load_rays(mapped / "out")
    mine = np.flatnonzero(rays.object == 0)
    score, weight = np.full(len(rays), 0.5), np.ones(len(rays))
    score[mine[[3, 20]]] = 0.9
    weight[mine[1]], score[mine[1]] = 0.0, 1.0  # rejected
    rays = dataclasses.replace(rays, score=score, weight=weight)
    chosen = best_rays(rays, mine, 4)
    assert len(chosen) == 4
    assert {mine[3], mine[20]} <= set(chosen)
    assert mine[1] not in chosen
    assert (np.diff(rays.stamp[chosen]) > 0).all()
    assert best_rays(rays, mine[:2], 4).tolist() == mine[:1].tolist()


@pytest.mark.parametrize("name", ["rays.parquet", "summary.json", "config.yaml", "objects.json", "doubts.json"])
def test_what_is_damaged_is_named(tmp_path: Path, name: str) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20, settings=QUICK)
    write_result(result, tmp_path)
    (tmp_path / name).write_bytes(b"\x00 not this {")
    with pytest.raises(OutputError, match=re.escape(name)) as caught:
        write_report(tmp_path)
    assert "\n" not in str(caught.value)
    (tmp_path / name).unlink()
    if name == "doubts.json":  # Older results have none.
        return
    with pytest.raises(OutputError):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20, settings=QUICK)
    write_result(result, tmp_path / "out")
    for folder, code in (("out", 0), ("nowhere", 1)):
        monkeypatch.setattr("sys.argv", ["objslam", "report", str(tmp_path / folder)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == code
    told = capsys.readouterr()
    assert told.out == f"wrote {tmp_path / 'out' / 'report.html'}\n"
    assert told.err == f"objslam: {tmp_path / 'nowhere'}: there is no such result folder\n"


def test_a_new_result_takes_the_old_report_away(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20, settings=QUICK)
    write_result(result, tmp_path)
    write_report(tmp_path)
    write_result(result, tmp_path)
    assert not (tmp_path / "report.html").exists()
    assert json.loads((tmp_path / "summary.json").read_text())

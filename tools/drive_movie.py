"""Make an animated picture of a drive that a session maps: the image of the camera, and the map at that moment.

    objslam demo
    python tools/drive_movie.py demo_out/log demo_out/joint -o docs/drive.webp

At each moment, the session has only the odometry and the boxes up to this moment. The room behind the map is the
reconstruction of the finished run, for orientation. The last picture shows the map after the last solve.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib import get_data_path
from mesh_view import Picture, View, read_mesh
from one_line import end_with
from PIL import Image, ImageDraw, ImageFont

from objslam.config import Settings, load_settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.result import Surface
from objslam.core.snapshot import CameraFrame
from objslam.core.trajectory import Trajectory, correct_path
from objslam.core.types import Log
from objslam.errors import OutputError
from objslam.io.detections_jsonl import read_detections
from objslam.io.results.files import CONFIG, DETECTIONS, SURFACE
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session
from objslam.output.plot.label_layout import place_labels
from objslam.output.plot.style import colours_of, ellipsoid
from objslam.sources import SourceOptions, read

Colours = dict[str, tuple[float, float, float]]
SIZE = (640, 480)  # px of the room
SIDE = 300  # px, the width of the camera's image beside it
INK, FAINT, BLUE, GREY = (33, 38, 46), (110, 118, 130), (38, 110, 205), (150, 150, 155)
FONTS = f"{get_data_path()}/fonts/ttf/DejaVuSans"
BOLD, PLAIN, NAMES = (
    ImageFont.truetype(f"{FONTS}{kind}.ttf", size) for kind, size in (("-Bold", 14), ("", 12), ("-Bold", 13))
)
LIFT = np.array([0.0, 0.0, 0.04])  # m, so that the rough floor of the reconstruction does not hide the paths
PALE = 0.45  # share of white that is mixed into the room
SECOND = 60.0  # s that a frame of the live session may take before the tool gives up


@dataclass(frozen=True)
class Moment:
    """What is known at one moment. odometry, path: (N, 3) m in map, until now. frame: the newest keyframe of the camera."""

    stamp: float
    objects: ObjectMap
    odometry: Floats
    path: Floats
    frame: CameraFrame | None
    done: bool = False


def moments(log: Log, settings: Settings, every: int) -> Iterator[Moment]:
    """Map a log with a session, and yield what is known after each `every` frames. The last moment is after the last
    solve."""
    assert log.odometry is not None
    session = Session(settings, patient=True).start()
    session.push_camera(log.cameras[0].camera)
    count = 0
    for stamp, is_frame, push in events(log, settings):
        push(session)
        if not is_frame:
            continue
        session.wait(SECOND)
        count += 1
        if count % every == 0:
            snapshot = session.snapshot()
            driven = log.odometry.stamps <= stamp
            until = Trajectory(log.odometry.stamps[driven], log.odometry.poses[driven])
            seen = [frame for frame in snapshot.frames if abs(frame.stamp - stamp) < 0.3]
            path = corrected(until, snapshot.path)
            yield Moment(stamp, snapshot.map, until.poses[:, :3, 3], path, seen[0] if seen else None)
    result = session.stop()
    path = result.path_after.poses[:, :3, 3]
    yield Moment(stamp, result.map, log.odometry.poses[:, :3, 3], path, None, done=True)


def corrected(odometry: Trajectory, keyframes: Trajectory) -> Floats:
    """The positions (N, 3) of the odometry, moved as the session moved its keyframes."""
    if not len(keyframes):
        return odometry.poses[:, :3, 3]
    at = keyframes.stamps.clip(odometry.stamps[0], odometry.stamps[-1])
    before, _ = interpolate(odometry.stamps, odometry.poses, at, np.inf)
    return correct_path(odometry, at, before, keyframes.poses).poses[:, :3, 3]


def overview(surface: Surface) -> View:
    """The room from above one of its corners."""
    low, high = np.quantile(surface.vertices, [0.01, 0.99], axis=0).astype(float)
    middle, span = (low + high) / 2, float(np.hypot(*(high - low)[:2]))
    away = np.array([-0.35, -0.94])
    eye = np.array([*(middle[:2] + 0.72 * span * away), low[2] + 0.66 * span])
    return View(eye, np.array([*(middle[:2] + 0.05 * span * away), low[2] + 0.04 * span]), 58.0, *SIZE)


def outline(view: View, o: MapObject) -> Floats:
    """The outline (P, 2), px as drawn, of an object's 2-sigma ellipsoid."""
    found = ellipsoid(o)
    assert found is not None
    step = 1e-3
    at = view.project(o.position[None])[0][0]
    moved = view.project(o.position + step * found[1].T)[0]
    spread = ((moved - at) / step).T * found[0]
    values, axes = np.linalg.eigh(spread @ spread.T)
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return at + (axes @ (np.sqrt(np.maximum(values, 0))[:, None] * np.stack([np.cos(turn), np.sin(turn)]))).T


def frustum(camera: Camera, map_T_camera: Floats, depth: float) -> list[Floats]:
    """The edges of a camera's view up to a depth, m, as lines in map."""
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], dtype=float)
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(camera.matrix).T
    ends = depth * rays @ map_T_camera[:3, :3].T + map_T_camera[:3, 3]
    return [np.stack([map_T_camera[:3, 3], end]) for end in ends] + [np.concatenate([ends, ends[:1]])]


def draw_room(base: Picture, moment: Moment, colours: Colours) -> np.ndarray:
    """The room with the map of a moment over it, (H, W, 3) uint8 RGB."""
    picture = object.__new__(Picture)
    picture.view, picture.image, picture.depth = base.view, base.image.copy(), base.depth
    if len(moment.odometry) > 1:
        picture.lines([moment.odometry[::12] + LIFT], GREY, 1.4, 0.9)
    if len(moment.path) > 1:
        picture.lines([moment.path[::12] + LIFT], INK, 2.2)
    if moment.frame is not None:
        by_id = {o.id: o for o in moment.objects}
        eye = moment.frame.map_T_camera
        picture.lines(frustum(moment.frame.camera, eye, 0.35), BLUE, 1.6)
        ends = [by_id[j].position for j in moment.frame.objects.tolist() if j in by_id]
        picture.lines([np.stack([eye[:3, 3], end]) for end in ends], BLUE, 1.6, 0.9)
    for o in moment.objects.resolved():
        colour = tuple(255 * c for c in colours[o.label])
        points = np.rint(16 * outline(base.view, o)).astype(np.int32)
        mask = np.zeros(picture.depth.shape, np.uint8)
        cv2.fillPoly(mask, [points], 255, cv2.LINE_AA, 4)
        picture._blend(mask, colour, 0.3)
        mask[:] = 0
        cv2.polylines(mask, [points], True, 255, 3, cv2.LINE_AA, 4)
        picture._blend(mask, colour, 1.0)
    return picture.done()


def name_places(view: View, moment: Moment) -> dict[int, Floats]:
    """Return by id where the name of each object goes, px from its dot, so that no name covers another."""
    objects = moment.objects.resolved()
    scale = SIZE[0] / (2 * view.matrix[0, 2])
    dots = scale * view.project(moment.objects.positions)[0][[o.status == "ok" for o in moment.objects]]
    rims = np.concatenate([np.zeros((0, 2)), *(scale * outline(view, o) for o in objects)])
    sizes = np.array([NAMES.getbbox(o.label)[2:] for o in objects], dtype=float).reshape(-1, 2) + 6.0
    corners, _ = place_labels(dots, sizes, np.array([[0.0, 0.0], SIZE]), rims)
    return {o.id: corner + 3.0 - dot for o, corner, dot in zip(objects, corners, dots, strict=True)}


def draw_names(image: Image.Image, view: View, moment: Moment, places: dict[int, Floats], colours: Colours) -> None:
    """Write the names of the objects beside their dots. places: of `name_places`. A name without a place goes above its
    dot."""
    pen, scale = ImageDraw.Draw(image), SIZE[0] / (2 * view.matrix[0, 2])
    for o in moment.objects.resolved():
        dot = scale * view.project(o.position[None])[0][0]
        x, y = dot.tolist()
        colour = tuple(round(255 * c) for c in colours[o.label])
        pen.ellipse([x - 3, y - 3, x + 3, y + 3], fill=colour, outline="white")
        at = dot + places.get(o.id, np.array([8.0, -20.0]))
        pen.text(tuple(at.tolist()), o.label, colour, NAMES, stroke_width=3, stroke_fill="white")


def draw_side(moment: Moment, begin: float, image: np.ndarray, colours: Colours) -> Image.Image:
    """The camera's image with its boxes, and the sigma of each object as a bar."""
    side = Image.new("RGB", (SIDE, SIZE[1]), "white")
    pen = ImageDraw.Draw(side)
    scale = SIDE / image.shape[1]
    height = round(image.shape[0] * scale)
    shown = cv2.resize(image, (SIDE, height), interpolation=cv2.INTER_AREA)
    labels = {o.id: o.label for o in moment.objects}
    if moment.frame is not None:
        for box, j in zip(moment.frame.boxes * scale, moment.frame.objects.tolist(), strict=True):
            colour = tuple(255 * c for c in colours[labels[j]]) if j in labels else (160, 160, 160)
            low, high = np.rint(box.reshape(2, 2)).astype(int).tolist()
            cv2.rectangle(shown, low, high, (255, 255, 255), 4, cv2.LINE_AA)
            cv2.rectangle(shown, low, high, colour, 2, cv2.LINE_AA)
    side.paste(Image.fromarray(shown))
    text = "after the last solve" if moment.done else f"{moment.stamp - begin:4.1f} s of the drive"
    pen.text((2, height + 12), f"{len(moment.objects.resolved())} objects, {text}", INK, BOLD)
    pen.text((2, height + 34), "from images and drifting odometry alone", FAINT, PLAIN)
    pen.text((2, height + 58), "2 sigma of each place", FAINT, PLAIN)
    for row, o in enumerate(sorted(moment.objects.resolved(), key=lambda o: o.first_seen)[:8]):
        y, colour = height + 84 + 20 * row, tuple(round(255 * c) for c in colours[o.label])
        two = 2 * (o.sigma or 0.0)
        pen.text((2, y), o.label, colour, PLAIN, anchor="lm")
        pen.rectangle([132, y - 5, 132 + min(two, 1.0) * 110, y + 4], fill=colour)
        pen.text((SIDE - 2, y), f"{two:.2f} m", INK, PLAIN, anchor="rm")
    for x, colour, what in ((2, GREY, "path by odometry"), (152, INK, "path in the map")):
        pen.line([x, SIZE[1] - 12, x + 18, SIZE[1] - 12], colour, 3)
        pen.text((x + 24, SIZE[1] - 12), what, FAINT, PLAIN, anchor="lm")
    return side


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", type=Path, help="a log with images and odometry")
    parser.add_argument("result", type=Path, help="the result of its run from odometry, with boxes and a reconstruction")
    parser.add_argument("-o", "--out", type=Path, default=Path("drive.webp"))
    parser.add_argument("--every", type=int, default=2, help="the number of frames per picture")
    parser.add_argument("--quality", type=int, default=60, help="the quality of the pictures, up to 100")
    args = parser.parse_args()
    for name in (DETECTIONS, SURFACE):
        if not (args.result / name).is_file():
            hint = "`objslam demo` without --boxes makes one"
            raise OutputError(f"there is no {name}", where=str(args.result), hint=hint)
    log, settings = read(args.log, Ledger(), SourceOptions()), load_settings(args.result / CONFIG)
    camera = replace(log.cameras[0], detections=read_detections(args.result / DETECTIONS, Ledger()))
    log = replace(log, cameras=(camera,), localization=None)
    if camera.rgb is None or log.odometry is None:
        raise OutputError("the log has no images or no odometry", where=str(args.log))
    surface = read_mesh(args.result / SURFACE)
    base = Picture(surface, overview(surface))
    base.image = base.image * (1 - PALE) + 255 * PALE
    told = list(moments(log, settings, args.every))
    colours = colours_of([o.label for moment in told for o in moment.objects])
    places, pictures = name_places(base.view, told[-1]), []
    for moment in told:
        image = Image.fromarray(draw_room(base, moment, colours))
        draw_names(image, base.view, moment, places, colours)
        near = int(np.abs(camera.rgb.stamps - moment.stamp).argmin())
        side = draw_side(moment, float(camera.rgb.stamps[0]), cv2.imread(str(camera.rgb.paths[near]))[..., ::-1], colours)
        whole = Image.new("RGB", (SIZE[0] + 20 + SIDE, SIZE[1]), "white")
        whole.paste(image)
        whole.paste(side, (SIZE[0] + 20, 0))
        pictures.append(whole)
    times = [130] * (len(pictures) - 1) + [3000]
    pictures[0].save(
        args.out, save_all=True, append_images=pictures[1:], duration=times, loop=0, quality=args.quality, method=6
    )
    print(f"wrote {args.out}: {len(pictures)} pictures, {args.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    end_with(main)

"""Draw the paper's Fig. 2 from a result: the reconstruction, objects as black rings, blue rays, and the cost of Eq. 1.

    objslam demo
    python tools/fig2.py demo_out/fixed --object 0 -o docs/fig2.png

The left picture shows the room, and the right picture the chosen object. The heat map is the mean distance of the object's
rays from each point of two slices through the minimum of Eq. 1 (a cross). It is hot where the rays agree. A result has a
reconstruction if its log has depth images.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mesh_view import Picture, View, read_mesh, save
from one_line import end_with

from objslam.core.arrays import Floats
from objslam.core.object_map import MapObject
from objslam.core.result import Surface
from objslam.errors import OutputError
from objslam.io.rays_parquet import RaysTable
from objslam.io.results.files import SURFACE
from objslam.io.results.read import load_map, load_rays
from objslam.triangulation.proximity_field import FieldSlice, ProximityField, proximity_field, supporting_rays

BLUE, BLACK, INK = (38, 110, 205), (12, 12, 14), "#282c34"
HEAT = colormaps["turbo_r"]
SIZE = (620, 520)  # px of each picture
SMALL = 0.07  # m, the least radius of a ring


def overview(surface: Surface, o: MapObject) -> View:
    """The room from above the side that is opposite to an object."""
    low, high = np.quantile(surface.vertices, [0.01, 0.99], axis=0).astype(float)
    middle, span = (low + high) / 2, float(np.hypot(*(high - low)[:2]))
    away = middle[:2] - o.position[:2]
    away /= max(float(np.linalg.norm(away)), 1e-9)
    eye = np.array([*(middle[:2] + 0.72 * span * away), low[2] + 0.62 * span])
    return View(eye, np.array([*(middle[:2] + 0.04 * span * away), low[2] + 0.03 * span]), 55.0, *SIZE)


def close(o: MapObject, f: ProximityField, origins: Floats, reach: float) -> View:
    """An object from the side from which its rays come, a little from above."""
    towards = origins.mean(axis=0)[:2] - o.position[:2]
    towards /= max(float(np.linalg.norm(towards)), 1e-9)
    aside = np.array([-towards[1], towards[0]])
    eye = f.minimum + reach * np.array([*(2.3 * towards + 0.9 * aside), 1.5])
    return View(eye, f.minimum, 48.0, *SIZE)


def radius(o: MapObject) -> float:
    """Of an object's ring, m."""
    return max(SMALL, 0.6 * max(o.extent)) if o.extent else SMALL


def draw_slice(picture: Picture, s: FieldSlice, norm: Normalize) -> None:
    """A slice of the field, fading where the cost is high."""
    value = np.clip(norm(s.cost), 0, 1)
    cells = (value[:-1, :-1] + value[1:, 1:]) / 2
    picture.slice(s.points, HEAT(0.04 + 0.9 * cells)[..., :3], 0.85 * (1 - cells) ** 0.7)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("result", type=Path, help="a result folder with reconstruction.ply")
    parser.add_argument("--object", type=int, help="the id of the object, by default the object with the most rays")
    parser.add_argument("-o", "--out", type=Path, default=Path("fig2.png"))
    args = parser.parse_args()
    objects, rays = load_map(args.result).resolved(), load_rays(args.result)
    if not (args.result / SURFACE).is_file():
        hint = "a run writes it where the log has depth images: `objslam demo` without --boxes makes one"
        raise OutputError("there is no reconstruction", where=str(args.result / SURFACE), hint=hint)
    if not objects:
        raise OutputError("no object of this map is resolved", where=str(args.result))
    surface = read_mesh(args.result / SURFACE)
    named = {o.id: o for o in objects}
    if args.object is not None and args.object not in named:
        parser.error(f"there is no resolved object {args.object}")
    chosen = named[args.object] if args.object is not None else max(objects, key=lambda o: o.rays)
    figure(surface, objects, rays, chosen, args.out)


def figure(surface: Surface, objects: tuple[MapObject, ...], rays: RaysTable, chosen: MapObject, out: Path) -> None:
    """Draw both pictures into one PNG."""
    used = rays.weight >= 0.5
    mine = supporting_rays(rays.weight, rays.object == chosen.id)
    reach = 2.0 * radius(chosen)
    f = proximity_field(rays.origin[mine], rays.direction[mine], 81, reach)
    norm = Normalize(f.cost, float(np.quantile(f.horizontal.cost, 0.8)))

    room = Picture(surface, overview(surface, chosen))
    for o in objects:
        own = np.flatnonzero(used & (rays.object == o.id))[::2]
        room.lines([np.stack([rays.origin[i], o.position]) for i in own], BLUE, 0.7, 0.55)
    draw_slice(room, f.horizontal, norm)
    near = Picture(surface, close(chosen, f, rays.origin[mine], reach))
    draw_slice(near, f.horizontal, norm)
    draw_slice(near, f.vertical, norm)
    near.lines([through(rays, i, chosen, 1.6 * reach) for i in np.flatnonzero(mine)], BLUE, 1.0, 0.6)
    for axis in 0.12 * reach * np.eye(3):
        near.lines([np.stack([f.minimum - axis, f.minimum + axis])], BLACK, 2.0)
    for o in objects:
        for picture in (room, near):
            if picture.view.project(o.position)[1] > 0.2:
                picture.ring(o.position, radius(o), BLACK, 2.0)

    whole = Figure(figsize=(12.6, 5.2), dpi=100)
    canvas = FigureCanvasAgg(whole)
    for i, (picture, title) in enumerate(
        ((room, "the objects and their rays"), (near, f"Eq. 1's cost around {chosen.label!r}"))
    ):
        axes = whole.add_axes((0.005 + 0.4655 * i, 0.01, 0.4575, 0.93))
        axes.imshow(picture.done(), interpolation="none")
        axes.set_axis_off()
        axes.set_title(title, loc="left", fontsize=11, color=INK)
    scale = whole.colorbar(ScalarMappable(norm, HEAT), cax=whole.add_axes((0.937, 0.14, 0.012, 0.7)), extend="max")
    scale.set_label("mean distance of the rays (m)", fontsize=8.5, color=INK)
    scale.ax.tick_params(labelsize=8)
    canvas.draw()
    save(np.asarray(canvas.buffer_rgba())[..., :3], out)


def through(rays: RaysTable, i: int, o: MapObject, beyond: float) -> Floats:
    """A ray from its camera to as far beyond the object (2, 3)."""
    length = float((o.position - rays.origin[i]) @ rays.direction[i]) + beyond
    return np.stack([rays.origin[i], rays.origin[i] + length * rays.direction[i]])


if __name__ == "__main__":
    end_with(main)

"""Measure the merge of many sessions of one place, and spatial queries in a large map.

    python tools/bench_sites.py [--sessions 5 10 20 30 40] [--halls 3] [--parts growth orders wrong days query]
    python tools/bench_sites.py --folders A B ...

`growth`: simulated sessions of a hall of 40 objects, in frames of their own. The rows are means over `--halls` halls. The
map of each session is shifted and turned as a whole, has a size of its own, and each object has an error of its own. Robots
overlook objects and report phantoms. The times are CPU times. The exponent says how they grow with the number of sessions.
`add` is the time of the last session alone, which joins the site of all others. RMSE and the share of objects inside their
95 % ellipsoids are after alignment in shift and yaw. `alone` is the median RMSE of the sessions. `known` is the RMSE of one
least-squares problem with the true matches, without robust losses, so it is what the errors themselves allow.
`orders`: how far the objects are apart if the same sessions come in another order.
`wrong`: sessions of other places among those of the hall: how many join it, and how far they move its objects. Then one
session that has eight objects arranged as in the hall.
`days`: 30 days of merges in each hall, where a tenth of the objects moves, comes or goes each week: the share of objects and
empty places that are told correctly two visits later, phantoms that lived longer, and the RMSE in the first and last week.
`query`: the time of the nearest object, of a radius and of a box in a map of a million objects.
With --folders, the tool merges these result folders instead, and compares with their ground truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from mapping.site_days import SIGMA, Day, Place, month, session

from objslam.core.arrays import Floats
from objslam.core.geometry import align, inverse
from objslam.core.maps.shared_covariance import jacobian
from objslam.core.object_map import MapObject, ObjectMap
from objslam.io.results.read import load_truth
from objslam.mapping.sites.merge import Island, merge_sessions
from objslam.mapping.sites.session import Session

SHARED = np.diag([0.1, 0.1, 0.02, 0.003, 0.003, 0.02, 0.01]) ** 2
"""The covariance of the error that all objects of a session share: shift (m), turn (rad) and size. Larger values make the
sessions worse as a whole."""
INSIDE = 7.815
"""The squared Mahalanobis distance that 95 % of normal errors in three dimensions stay below."""


@dataclass(frozen=True)
class Drive:
    """The session of one day. own: (4, 4) its true frame in the place. before: (N, 3) m, its objects without the error that
    all of them share."""

    day: Day
    own: Floats
    before: Floats


def drive(place: Place, day: int) -> Drive:
    """Return the session of one day, with an error that all its objects share."""
    seen, own = session(place, day)
    error = np.linalg.cholesky(SHARED) @ place.rng.normal(size=7)
    moves = jacobian(seen.objects.positions)
    at = seen.objects.positions + moves @ error
    spread = seen.objects.covariances + jacobian(at) @ SHARED @ np.swapaxes(jacobian(at), 1, 2)
    objects = zip(seen.objects, at, spread, strict=True)
    found = tuple(replace(o, position=p, covariance=c) for o, p, c in objects)
    objects_of_day = replace(seen.objects, objects=found, shared_covariance=SHARED)
    return Drive(Day(seen.name, objects_of_day), own, seen.objects.positions)


def truth_of(place: Place) -> Floats:
    """Return the true positions (N, 3), m."""
    return np.array([at for _, at in place.truth.values()])


def score(positions: Floats, covariances: Floats, truth: Floats) -> tuple[float, float]:
    """Return the RMSE (m) and the share inside 95 % of objects whose true positions are known, after alignment."""
    pose = align(positions, truth, "se2")[0]
    off = positions @ pose[:3, :3].T + pose[:3, 3] - truth
    spread = pose[:3, :3] @ covariances @ pose[:3, :3].T
    squared = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])
    return float(np.sqrt((off**2).sum(axis=1).mean())), float((squared < INSIDE).mean())


def compare(objects: ObjectMap, truth: Floats, start: Floats) -> tuple[float, float, int]:
    """Return RMSE (m), the share inside 95 %, and how many true objects the map has. start: (4, 4) place_T_map, about."""
    pose = start
    for _ in range(3):  # The first session gives the frame, with its errors. So the start is not exact.
        at = objects.positions @ pose[:3, :3].T + pose[:3, 3]
        apart = np.linalg.norm(at[:, None] - truth, axis=2)
        index, there = apart.argmin(axis=0), apart.min(axis=0) < 0.7
        pose = align(objects.positions[index[there]], truth[there], "se2")[0]
    kept = index[there]
    return *score(objects.positions[kept], objects.covariances[kept], truth[there]), int(there.sum())


def rmse_of_known_matches(days: list[Drive], truth: Floats) -> float:
    """Return the RMSE of the least-squares estimate from the true matches and the true covariances, at the truth."""
    width, count = 11, len(truth)
    rows, right = [], []
    for s, one in enumerate(days):
        back = inverse(one.own)
        local = truth @ back[:3, :3].T + back[:3, 3]
        apart = np.linalg.norm(one.before[:, None] - local, axis=2)
        for k in np.flatnonzero(apart.min(axis=0) < 0.3).tolist():
            item = one.day.objects[int(apart[:, k].argmin())]
            lever = jacobian(local[k])
            row = np.zeros((3, 3 * count + width * len(days)))
            row[:, 3 * k : 3 * k + 3] = back[:3, :3]
            at = 3 * count + width * s
            row[:, at : at + 3], row[:, at + 3] = np.eye(3), lever[:, 5]
            row[:, at + 4 : at + width] = lever @ np.linalg.cholesky(SHARED)
            rows.append(row / SIGMA)
            right.append((item.position - local[k]) / SIGMA)
    prior = np.zeros((7 * len(days), 3 * count + width * len(days)))
    for s in range(len(days)):
        at = 3 * count + width * s + 4
        prior[7 * s : 7 * s + 7, at : at + 7] = np.eye(7)
    whole = np.linalg.lstsq(np.concatenate([*rows, prior]), np.concatenate([*right, np.zeros(7 * len(days))]), rcond=None)[0]
    found = truth + whole[: 3 * count].reshape(-1, 3)
    pose = align(found, truth, "se2")[0]
    return float(np.sqrt(((found @ pose[:3, :3].T + pose[:3, 3] - truth) ** 2).sum(axis=1).mean()))


def timed(sessions: list[Session]) -> tuple[tuple[Island, ...], float]:
    """Return the islands of a merge, and its CPU time (s)."""
    begin = time.process_time()
    islands = merge_sessions(sessions)
    return islands, time.process_time() - begin


def growth(counts: list[int], halls: int) -> None:
    """Merge more and more sessions. Each row is the mean over some halls, that of squares for the RMSE."""
    print("sessions  islands  objects  RMSE m  inside 95 %  alone m  known m  seconds  add s")
    seconds = []
    for count in counts:
        rows = []
        for number in range(halls):
            place = Place(np.random.default_rng(100 * number + count), count=40)
            days, truth = [drive(place, day) for day in range(count)], truth_of(place)
            islands, took = timed([one.day for one in days])
            island = islands[0]
            rmse, inside, there = compare(island.objects, truth, days[island.sessions[0]].own)
            alone = float(np.median([compare(one.day.objects, truth, one.own)[0] for one in days]))
            site = Day("site", merge_sessions([one.day for one in days[:-1]])[0].objects)
            _, add = timed([site, days[-1].day])
            rows.append((len(islands), there, rmse**2, inside, alone, rmse_of_known_matches(days, truth) ** 2, took, add))
        islands_, there_, squared, inside, alone, known, took, add = np.mean(rows, axis=0)
        seconds.append(took)
        print(
            f"{count:8d}  {islands_:7.2f}  {there_:7.2f}  {np.sqrt(squared):6.4f}  {inside:11.2f}  {alone:7.4f}"
            f"  {np.sqrt(known):7.4f}  {took:7.2f}  {add:5.2f}",
            flush=True,
        )
    if len(counts) > 1:
        print(f"exponent {np.polyfit(np.log(counts), np.log(seconds), 1)[0]:.2f}")


def orders(counts: list[int], halls: int) -> None:
    """Merge the same sessions in other orders."""
    place, count = Place(np.random.default_rng(1), count=40), min(10, max(counts))
    days = [drive(place, day).day for day in range(count)]
    first, worst = merge_sessions(days)[0], 0.0
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(count).tolist()
        other = merge_sessions([days[k] for k in order])[0]
        pose = first.site_T_session[order[0]]
        again = other.objects.positions @ pose[:3, :3].T + pose[:3, 3]
        here = np.array([o.position for o in first.objects if (o.life and o.life.sessions_seen > 1)])
        worst = max(worst, float(np.linalg.norm(again[:, None] - here, axis=2).min(axis=0).max()))
    print(f"{count} sessions in 3 other orders: objects at most {worst * 1000:.6f} mm apart")


def wrong(counts: list[int], halls: int) -> None:
    """Merge sessions of other places with those of one place, and a session of a place that looks alike."""
    rng, count = np.random.default_rng(2), min(10, max(counts))
    place = Place(rng, count=40)
    days = [drive(place, day) for day in range(count)]
    truth, own, ours = truth_of(place), days[0].own, [one.day for one in days]
    right = compare(merge_sessions(ours)[0].objects, truth, own)
    strangers = [drive(Place(np.random.default_rng(100 + k), count=40), count + k).day for k in range(20)]
    islands = merge_sessions([*ours, *strangers])
    home = next(one for one in islands if 0 in one.sessions)
    joined = sum(s >= count for s in home.sessions)
    now = compare(home.objects, truth, own)
    print(
        f"{len(strangers)} sessions of other places: {joined} join, RMSE {right[0]:.4f} m alone and {now[0]:.4f} m with them"
    )
    other = Place(np.random.default_rng(3), count=30, size=40.0)
    for number, (label, at) in enumerate(list(place.truth.values())[:8]):
        other.truth[1000 + number] = label, at + rng.normal(0, 0.03, 3)
    island = next(one for one in merge_sessions([*ours, drive(other, count).day]) if 0 in one.sessions)
    now = compare(island.objects, truth, own)
    print(
        f"a session with eight objects arranged as in the hall: joins {count in island.sessions}, "
        f"RMSE {now[0]:.4f} m, inside 95 % {now[1]:.2f}"
    )


def days(counts: list[int], halls: int) -> None:
    """Merge one session a day while the place changes."""
    print("hall  right  phantoms  first week m  last week m  confirmed")
    for seed in range(halls):
        found = month(seed)
        first, last = (np.sqrt(np.square(errors).mean()) for errors in (found.first_week, found.last_week))
        print(
            f"{seed:4d}  {found.right.mean():.3f}  {found.phantoms:8d}  {first:12.4f}  {last:11.4f}"
            f"  {found.confirmed.mean():9.2f}",
            flush=True,
        )


def query(counts: list[int], halls: int, count: int = 1_000_000, asked: int = 200) -> None:
    """Ask a map of a million objects, one on each square metre of a square."""
    rng = np.random.default_rng(4)
    points, spread = np.column_stack([rng.uniform(0, np.sqrt(count), (count, 2)), rng.uniform(0, 2, count)]), np.eye(3)
    objects = ObjectMap(
        tuple(MapObject(k, "cup", p, spread, "ok", 9, 9, 30.0, 0.3, 0.0, 1.0) for k, p in enumerate(points))  # type: ignore[arg-type]
    )
    begin = time.process_time()
    objects.nearest(points[0])
    print(f"index of {count} objects: {time.process_time() - begin:.1f} s, once")
    places = rng.uniform(0, np.sqrt(count), (asked, 2))
    questions = {
        "nearest": lambda at: objects.nearest([*at, 1.0]),
        "within 3 m": lambda at: objects.in_radius([*at, 1.0], 3.0),
        "box of 10 x 10 m": lambda at: objects.in_box(at, at + 10),
    }
    for name, ask in questions.items():
        ask(places[0])
        took = []
        for at in places:
            begin = time.process_time()
            ask(at)
            took.append(time.process_time() - begin)
        print(f"{name}: median {np.median(took) * 1e3:.3f} ms, longest {max(took) * 1e3:.3f} ms")


def folders(paths: list[Path]) -> None:
    """Merge results of recordings, and compare with their ground truth by label."""
    sessions, truth = [Session.load(path) for path in paths], load_truth(paths[0])
    assert truth is not None
    known = {o.label: o.position for o in truth.objects}
    islands, took = timed(sessions)
    for name, objects in [*((s.name, s.objects) for s in sessions), *(("site", one.objects) for one in islands)]:
        some = ObjectMap(tuple(o for o in objects if o.label in known and o.covariance is not None))
        at = np.array([known[o.label] for o in some])
        rmse, inside = score(some.positions, some.covariances, at)
        size = 1 / align(some.positions, at, "sim2")[1]
        print(f"{name}: {len(some)} of {len(known)} objects, RMSE {rmse:.4f} m, inside 95 % {inside:.2f}, size {size:.4f}")
    print(f"{len(islands)} islands in {took:.2f} s")


PARTS = {"growth": growth, "orders": orders, "wrong": wrong, "days": days, "query": query}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, nargs="+", default=[5, 10, 20, 30, 40])
    parser.add_argument("--halls", type=int, default=3)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--folders", type=Path, nargs="+", default=[])
    given = parser.parse_args()
    if given.folders:
        folders(given.folders)
    else:
        for part in given.parts:
            PARTS[part](given.sessions, given.halls)

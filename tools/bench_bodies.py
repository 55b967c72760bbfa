"""Points against bodies on simulated boxes of ellipsoids: errors of centres, sizes and yaws, honesty, and time.

    python tools/bench_bodies.py [--objects 200] [--boxes 30] [--noise 2] [--seeds 3]
    python tools/bench_bodies.py --drives 10 [--short 0.05]
    python tools/bench_bodies.py --live 8

The second line runs whole drives in joint mode instead, with bodies and without. With --short, the detector also draws boxes
that the image's edge cuts off. The third line feeds drives of two laps to live sessions. It takes the map before the end of
the session, and the pose of each keyframe when the session had just mapped it.

The nearest peer, gtsam-quadrics, has wheels for Python 3.10 and numpy below 1.24 only. With --peer PYTHON, the interpreter
of an environment that has it solves the same boxes from the same points. Without it, a line says that the peer is absent.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from mapping.body_drives import drive, scores
from outlines import from_axes, looking_at, outline_box

from objslam.config import load_settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera, undistort
from objslam.core.geometry import inverse
from objslam.core.snapshot import Snapshot
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session
from objslam.triangulation.bodies.edges import BoxEdges, tangent_planes
from objslam.triangulation.bodies.ellipsoid import half_axes, heading
from objslam.triangulation.bodies.solve import Bodies, solve_bodies
from objslam.triangulation.triangulate import triangulate

CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
CHI2_95 = 7.815  # chi-squared, 3 degrees of freedom
LARGE = 0.2  # The ratio of size and distance above which an object counts as large.


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=200)
    parser.add_argument("--boxes", type=int, default=30, help="boxes of each object")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation of each edge, px")
    parser.add_argument("--arc", type=float, nargs=2, default=(60.0, 180.0), help="range of azimuths of the views, degrees")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--drives", type=int, default=0, help="drives between large objects, in place of single bodies")
    parser.add_argument("--short", type=float, help="draw cut off boxes, up to this share of their size short")
    parser.add_argument("--live", type=int, default=0, help="drives of two laps between large objects, in live sessions")
    parser.add_argument("--peer", help="the Python of an environment with gtsam-quadrics 0.3.0 and numpy below 1.24")
    options = parser.parse_args()
    if options.live:
        live(options.live)
        return
    if options.drives:
        drives(options.drives, options.short)
        return
    for seed in range(options.seeds):
        rng = np.random.default_rng(seed)
        true, boxes, poses, distance = scene(options.objects, options.boxes, options.arc, rng)
        boxes = boxes + rng.normal(0.0, options.noise, boxes.shape)
        points = triangulated(boxes, poses, len(true))
        start = time.process_time()
        bodies = solved(boxes, poses, points)
        report(seed, true, points, bodies, distance, time.process_time() - start)
        if options.peer:
            peer(options.peer, true, boxes, poses, points, options.noise, distance)
    if not options.peer:
        print(
            "gtsam-quadrics: absent (it needs Python 3.10 and numpy < 1.24; name the Python of its environment with --peer)"
        )


def peer(python: str, true: Floats, boxes: Floats, poses: Floats, points: Floats, noise: float, distance: Floats) -> None:
    """Solve the same boxes with gtsam-quadrics in another Python, and print its errors and CPU time."""
    half = start_sizes(boxes, poses, points).mean(axis=1)
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder, "in.npz"), Path(folder, "out.npz")
        body = owners(boxes, len(true))
        np.savez(given, boxes=boxes, poses=poses, body=body, points=points, half=half, matrix=CAMERA.matrix, noise=noise)
        script = Path(__file__).resolve().parent / "peers" / "quadrics.py"
        done = subprocess.run([python, str(script), str(given), str(found)], capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"  gtsam-quadrics: absent or failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
            return
        with np.load(found) as solution:
            centres, axes, seconds = solution["centres"], solution["axes"], float(solution["seconds"])
    off = np.linalg.norm(centres - true[:, :3], axis=1)
    large = 2 * half_axes(true).max(axis=1) / distance > LARGE
    rms = [float(np.sqrt(np.nanmean(off[which] ** 2))) for which in (large, ~large)]
    sides = np.nanmedian(np.abs(axes / np.sort(half_axes(true), axis=1) - 1))
    print(
        f"  gtsam-quadrics: {np.isfinite(off).sum()} solved, RMSE large {rms[0]:.4f} m, other {rms[1]:.4f} m, "
        f"half axes off by {100 * sides:.1f} % (median), {seconds:.2f} s of CPU"
    )


def drives(number: int, short: float | None) -> None:
    """Run drives with bodies and without, and print the medians of their scores and the CPU time of one drive."""
    logs = [drive(seed, short=short) for seed in range(number)]
    for name, change in (("points", "bodies.use=false"), ("bodies", "bodies.use=true")):
        begin = time.process_time()
        found = [scores(log, change)[1] for log in logs]
        seconds = (time.process_time() - begin) / number
        middle = {key: float(np.median([one[key] for one in found])) for key in ("position_rmse", "ate")}
        print(
            f"{name}: objects {sum(one['matched'] for one in found)} of {sum(len(log.truth.objects) for log in logs)}, "
            f"RMSE {middle['position_rmse']:.3f} m, ATE {middle['ate']:.3f} m (medians of {number} drives), "
            f"inside 95 %: {np.mean([one['inside_95_3d'] for one in found]):.1%}, {seconds:.2f} s of CPU for a drive"
        )
    sizes, overlaps = ([one[key] for one in found] for key in ("size_error_median", "iou_median"))
    print(f"  sizes off by {np.median(sizes):.1%}, 3D overlap {np.median(overlaps):.2f} (medians)")


def live(number: int) -> None:
    """Feed drives to sessions with bodies and without, and print medians over the drives."""
    logs = [drive(seed, frames=400, laps=2) for seed in range(number)]
    for name, change in (("points", "bodies.use=false"), ("bodies", "bodies.use=true")):
        begin, found = time.process_time(), []
        for log in logs:
            path, snapshot = session_scores(log, change)
            found.append((path, evaluate(snapshot.map, log.truth, snapshot.path, align="se2", radius=1.0).to_dict()))
        seconds = (time.process_time() - begin) / number
        middle = {key: float(np.median([one[key] for _, one in found])) for key in ("position_rmse", "ate")}
        print(
            f"{name}: objects {sum(one['matched'] for _, one in found)} of {sum(len(log.truth.objects) for log in logs)}, "
            f"RMSE {middle['position_rmse']:.3f} m, ATE {middle['ate']:.3f} m, poses of the second lap when mapped "
            f"{np.median([path for path, _ in found]):.3f} m (medians of {number} drives), inside 95 %: "
            f"{np.mean([one['inside_95_3d'] for _, one in found]):.1%}, {seconds:.2f} s of CPU for a drive",
            flush=True,
        )


def session_scores(log: Log, change: str) -> tuple[float, Snapshot]:
    """Return the RMSE, m, of the poses of the second lap when they were mapped, and the last snapshot of a session."""
    settings = load_settings(None, ("calibration.use=false", "output.recording=false", change))
    session = Session(settings, patient=True).start()
    session.push_camera(log.cameras[0].camera)
    off: list[float] = []
    frames, truth = log.cameras[0].detections.frame_stamps, log.truth.trajectory
    m = session._mapper.state
    for _, frame, push in events(log):
        push(session)
        if frame and session.wait() and len(m.keyframes) and m.keyframes.stamp[-1] > frames[len(frames) // 2]:
            pose = m.graph.pose(int(m.keyframes.id[-1])) @ inverse(m.keyframes.base_T_camera[-1])
            true = truth.poses[np.searchsorted(truth.stamps, m.keyframes.stamp[-1] - 1e-6)]
            off.append(float(((pose[:2, 3] - true[:2, 3]) ** 2).sum()))
    snapshot = session.snapshot()
    session.abort()
    return float(np.sqrt(np.mean(off))), snapshot


def scene(count: int, per: int, arc: tuple[float, float], rng: np.random.Generator) -> tuple[Floats, Floats, Floats, Floats]:
    """Return ellipsoids (N, 7) of 0.1 to 1.5 m, exact boxes, poses, and the distance (N,) of each, 1 to 5 m."""
    true: list[Floats] = []
    boxes: list[Floats] = []
    poses: list[Floats] = []
    distances = []
    while len(true) < count:
        half = np.clip(np.exp(rng.uniform(np.log(0.05), np.log(0.75)) + rng.normal(0, 0.4, 3)), 0.05, 0.75)
        body = from_axes(rng.uniform(-5, 5, (1, 3)) * [1, 1, 0.1], half[None], rng.uniform(-1.5, 1.5, 1))[0]
        away, first, wide, high = (
            rng.uniform(1, 5),
            rng.uniform(0, 6.3),
            np.radians(rng.uniform(*arc)),
            rng.uniform(-0.3, 0.8),
        )
        seen: list[tuple[Floats, Floats]] = []
        for _ in range(4 * per):
            angle, far = first + wide * rng.uniform(-0.5, 0.5), away * rng.uniform(0.8, 1.2)
            place = body[:3] + np.array([far * np.cos(angle), far * np.sin(angle), high])
            pose = looking_at(place, body[:3] + rng.normal(0, 0.15 * far, 3))
            box = outline_box(CAMERA, body, pose)
            if box is not None and (box[:2] >= 1).all() and (box[2:] <= CAMERA.size - 2).all():
                seen.append((box, pose))
            if len(seen) == per:
                break
        if len(seen) == per:
            true.append(body)
            boxes += [box for box, _ in seen]
            poses += [pose for _, pose in seen]
            distances.append(away)
    return np.array(true), np.array(boxes), np.array(poses), np.array(distances)


def owners(boxes: Floats, count: int) -> Ints:
    return np.repeat(np.arange(count), len(boxes) // count)


def triangulated(boxes: Floats, poses: Floats, count: int) -> Floats:
    """Return the points (N, 3) at which the rays through the centres of boxes meet."""
    rays, _ = undistort(CAMERA, (boxes[:, :2] + boxes[:, 2:]) / 2)
    rays = np.einsum("bij,bj->bi", poses[:, :3, :3], rays)
    sigma, settings = np.full(len(boxes), 3 / CAMERA.focal), load_settings().triangulation
    return triangulate(poses[:, :3, 3], rays, owners(boxes, count), count, sigma, settings).positions


def start_sizes(boxes: Floats, poses: Floats, points: Floats) -> Floats:
    """Return half the width and the height (N, 2), m, that the boxes of objects have at points (N, 3)."""
    away = np.linalg.norm(points[owners(boxes, len(points))] - poses[:, :3, 3], axis=1)
    size = (boxes[:, 2:] - boxes[:, :2]) * away[:, None] / CAMERA.focal
    return np.asarray(np.median(size.reshape(len(points), -1, 2), axis=1) / 2)


def solved(boxes: Floats, poses: Floats, points: Floats) -> Bodies:
    """Return the bodies of objects at points (N, 3), with the default noise of the settings."""
    count, number = len(points), len(boxes)
    body, size = owners(boxes, count), boxes[:, 2:] - boxes[:, :2]
    half = start_sizes(boxes, poses, points)
    direction, _ = undistort(CAMERA, (boxes[:, :2] + boxes[:, 2:]) / 2)

    def measure(_: Floats | None) -> BoxEdges:
        normal, turn, _ = tangent_planes(CAMERA, boxes, poses)
        none, flat = np.zeros((number, 4), dtype=bool), np.zeros(number)
        towards = np.einsum("bij,bj->bi", poses[:, :3, :3], direction)
        edge = np.full(number, np.sqrt(2) * load_settings().rays.pixel_sigma)
        ranges = np.full(number, np.nan), flat + 1, flat
        return BoxEdges(body, poses[:, :3, 3], normal, turn, edge, flat, none, np.sqrt(size.prod(axis=1)), towards, *ranges)

    side = np.full(number, np.sqrt(CAMERA.size.prod()) / 2)
    return solve_bodies(measure, points, half, ("thing",) * count, side=side, share=0.1, bent=False)


def report(seed: int, true: Floats, points: Floats, bodies: Bodies, distance: Floats, seconds: float) -> None:
    large = 2 * half_axes(true).max(axis=1) / distance > LARGE
    point, body = (np.linalg.norm(at - true[:, :3], axis=1) for at in (points, bodies.values[:, :3]))
    print(
        f"seed {seed}: {len(true)} objects, shapes {np.bincount(bodies.shape, minlength=4).tolist()}, {seconds:.2f} s of CPU"
    )
    for name, which in (("large", large), ("other", ~large)):
        for what, measure in (("median", np.median), ("RMSE", lambda e: np.sqrt((e**2).mean()))):
            a, b = measure(point[which]), measure(body[which])
            print(f"  {name} {which.sum():4d} {what:>6}: point {a:.4f} m, body {b:.4f} m, ratio {b / a:.2f}")
    sides = np.abs(bodies.axes[:, 3:6] / half_axes(true) - 1)
    yaw = np.degrees(np.abs((bodies.axes[:, 6] - heading(true) + np.pi / 2) % np.pi - np.pi / 2))
    off = bodies.values[:, :3] - true[:, :3]
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(bodies.centre_covariance), off)
    print(f"  half axes off by {100 * np.median(sides):.1f} % (median), yaw by {np.median(yaw):.1f} deg (median)")
    print(f"  centres inside the 95 % ellipsoid: {100 * (squared <= CHI2_95).mean():.1f} %")


if __name__ == "__main__":
    main()

"""Solve ellipsoids from boxes at known poses with gtsam-quadrics. Python 3.10 runs it, apart from objslam.

    python3.10 quadrics.py IN.npz OUT.npz

IN has `boxes` (B, 4) px, `poses` (B, 4, 4) map_T_camera, `body` (B,), `points` (N, 3) m, `half` (N,) m, `matrix` (3, 3) and
`noise`, px. OUT has `centres` (N, 3) m, `axes` (N, 3) m, sorted, and `seconds` of CPU. A body that failed is NaN.
"""

import sys
import time

import gtsam
import gtsam_quadrics
import numpy as np


def main() -> None:
    given = np.load(sys.argv[1])
    boxes, poses, body, points, half, matrix = (given[k] for k in ("boxes", "poses", "body", "points", "half", "matrix"))
    lens = gtsam.Cal3_S2(matrix[0, 0], matrix[1, 1], 0.0, matrix[0, 2], matrix[1, 2])
    edges = gtsam.noiseModel.Isotropic.Sigma(4, float(given["noise"]))
    still = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    centres, axes = np.full((len(points), 3), np.nan), np.full((len(points), 3), np.nan)
    begin = time.process_time()
    for j in range(len(points)):
        graph, values, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.symbol("q", j)
        start = gtsam_quadrics.ConstrainedDualQuadric(gtsam.Rot3(), points[j], np.full(3, half[j]))
        start.addToValues(values, key)
        for i in np.flatnonzero(body == j):
            pose = gtsam.Pose3(poses[i])
            graph.addPriorPose3(gtsam.symbol("x", i), pose, still)
            values.insert(gtsam.symbol("x", i), pose)
            box = gtsam_quadrics.AlignedBox2(*boxes[i])
            graph.add(gtsam_quadrics.BoundingBoxFactor(box, lens, gtsam.symbol("x", i), key, edges))
        try:
            result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        except RuntimeError as error:
            print(f"body {j}: {error}", file=sys.stderr)
            continue
        found = gtsam_quadrics.ConstrainedDualQuadric.getFromValues(result, key)
        centres[j], axes[j] = found.centroid(), np.sort(np.abs(found.radii()))
    np.savez(sys.argv[2], centres=centres, axes=axes, seconds=time.process_time() - begin)


if __name__ == "__main__":
    main()

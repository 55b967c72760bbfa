"""Map arrays that a program has in memory. No file is read: python examples/from_arrays.py."""

import numpy as np

import objslam

# The optical axis (z) looks ahead, 0.1 m before and 0.3 m above the robot's base.
BASE_T_CAMERA = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


def main() -> objslam.Result:
    """A robot drives 1 m ahead, past a cup at (2.5, 0.5, 0.4) m."""
    matrix = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    camera = objslam.Camera("front", 640, 480, matrix, base_T_camera=BASE_T_CAMERA)
    boxes = [[205, 207, 226, 232], [192, 203, 215, 231], [175, 198, 202, 229], [153, 192, 184, 228], [124, 183, 159, 226]]
    detections = objslam.Detections.from_frames(
        stamps=[10.0, 10.5, 11.0, 11.5, 12.0],
        boxes=[[box] for box in boxes],  # one list for each frame
        labels=[["cup"]] * len(boxes),
    )
    path = ([10.0, 11.0, 12.0], [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0]])  # stamps, and x, y, yaw
    log = objslam.Log.from_arrays(camera, detections, localization=path)
    result = objslam.run(log)
    print(result.objects)
    print(result.objects.covariances)
    return result


if __name__ == "__main__":
    main()

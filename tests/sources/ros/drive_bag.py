"""A simulated drive as the rows of a bag: what a robot with that log would have recorded."""

import numpy as np

from objslam.core.geometry import make_pose
from objslam.simulation import preset, simulate


def simulated(**changes):
    """A small drive with objects, odometry and localisation."""
    settings = {"objects": 5, "classes": 3, "frames": 120, "min_view_share": 0.1, **changes}
    return simulate(preset("demo", **settings), 1)


def nanoseconds(stamps):
    """Stamps (N,) s in ns, as whole numbers of Python."""
    return np.round(np.asarray(stamps) * 1e9).astype(np.int64).tolist()


def rows_of(log, maker):
    """Rows in the order of time: odometry, poses in map, boxes, calibration and /tf_static."""
    start = nanoseconds(log.odometry.stamps[:1])[0]
    rows = []
    transforms = [("base_footprint", "base_link", np.eye(4))]
    for camera_log in log.cameras:
        camera, detections = camera_log.camera, camera_log.detections
        link, optical = f"{camera.name}_link", f"{camera.name}_optical_frame"
        mast = make_pose(np.eye(3), np.array([0.1, 0.0, 0.2]))
        transforms += [("base_link", link, mast), (link, optical, np.linalg.inv(mast) @ camera.base_T_camera)]
        rows.append((f"/{camera.name}/camera_info", start, maker.camera_info(start, camera, optical)))
        bounds = np.searchsorted(detections.frame, np.arange(len(detections.frame_stamps) + 1))
        for frame, stamp in enumerate(nanoseconds(detections.frame_stamps)):
            mine = range(bounds[frame], bounds[frame + 1])
            names = [detections.label if maker.ros1 else np.array(detections.label_names)[detections.label]][0]
            boxes = [(*detections.boxes[i], names[i], detections.scores[i]) for i in mine]
            rows.append((f"/{camera.name}/detections", stamp, maker.detections(stamp, boxes, optical)))
    rows.append(("/tf_static", start, maker.tf(start, *transforms)))
    for stamp, pose in zip(nanoseconds(log.odometry.stamps), log.odometry.poses, strict=True):
        rows.append(("/odom", stamp, maker.odometry(stamp, pose, child="base_footprint")))
    if log.localization is not None:
        for stamp, pose in zip(nanoseconds(log.localization.stamps), log.localization.poses, strict=True):
            rows.append(("/amcl_pose", stamp, maker.pose_stamped(stamp, pose)))
    rows.sort(key=lambda row: row[1])
    late = 3_000_000  # ns from a header's stamp to its recording: times must be the header's
    return [(topic, stamp + late, message) for topic, stamp, message in rows]

"""Push data while a robot drives. A recorded log takes the robot's place: python examples/live_session.py LOG."""

import sys

import objslam


def main(source: str) -> objslam.Result:
    """Push poses and boxes in the order of time, look at the map now and then, and solve it once more at the end."""
    log = objslam.read(source)
    (camera,) = log.cameras
    path, boxes = log.odometry, camera.detections
    if path is None or boxes is None:
        raise SystemExit(f"{source}: this example needs a log with odometry and boxes")
    with objslam.Session(patient=True) as session:  # patient: the log comes faster than it was recorded
        session.push_camera(camera.camera)
        pose = 0
        for frame, stamp in enumerate(boxes.frame_stamps):
            while pose < len(path) and path.stamps[pose] <= stamp:
                session.push_odometry(path.stamps[pose], path.poses[pose])
                pose += 1
            mine = boxes.frame == frame
            labels = [boxes.label_names[i] for i in boxes.label[mine]]
            session.push_detections(stamp, camera.camera.name, boxes.boxes[mine], labels, boxes.scores[mine])
            if frame % 40 == 39:
                session.wait()
                now = session.snapshot()
                print(f"{now.keyframes} keyframes, {len(now.map)} objects, dropped {now.dropped}")
        result = session.result()
    print(result.objects)
    return result


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    try:
        main(*sys.argv[1:])
    except objslam.ObjslamError as error:  # One line: what, where, what to do.
        raise SystemExit(str(error)) from None

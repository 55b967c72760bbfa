"""Map with the boxes of a detector of your own: python examples/own_detector.py LOG. The log has images (rgb.txt)."""

import sys

import cv2
import numpy as np

import objslam


def detect(image: np.ndarray) -> list[list[float]]:
    """Put your detector here. This one draws boxes around red things: x1, y1, x2, y2 in px."""
    blue, green, red = (image[:, :, i].astype(int) for i in range(3))
    mask = ((red > 150) & (red > 2 * np.maximum(blue, green))).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
    return [[float(x), float(y), float(x + w), float(y + h)] for x, y, w, h, area in stats[1:] if area > 20]


def main(source: str) -> objslam.Result:
    """Run the detector on every image of the only camera, and map its boxes."""
    log = objslam.read(source)
    images = log.cameras[0].rgb
    if images is None:
        raise SystemExit(f"{source}: the log has no images (rgb.txt)")
    boxes = []
    for path in images.paths:
        image = cv2.imread(str(path))
        assert image is not None
        boxes.append(detect(image))
    labels = [["red thing"] * len(found) for found in boxes]
    log = log.with_detections(objslam.Detections.from_frames(images.stamps, boxes, labels))
    result = objslam.run(log)
    print(result.objects)
    return result


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    try:
        main(*sys.argv[1:])
    except objslam.ObjslamError as error:  # One line: what, where, what to do.
        raise SystemExit(str(error)) from None

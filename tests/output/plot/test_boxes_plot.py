"""The labels of boxes on a photo stay readable."""

import cv2
import numpy as np

from objslam.output.plot.boxes_plot import draw_boxes, free_plate


def test_a_plate_moves_into_the_image_and_below_the_plates_that_are_there() -> None:
    assert free_plate((10, 20, 60, 40), [], 100, 100) == (10, 20, 60, 40)
    assert free_plate((-5, -12, 45, 8), [], 100, 100) == (0, 0, 50, 20)
    assert free_plate((80, 95, 130, 115), [], 100, 100) == (50, 80, 100, 100)
    assert free_plate((10, 20, 60, 40), [(0, 30, 30, 50)], 100, 100) == (10, 50, 60, 70)
    assert free_plate((10, 20, 60, 40), [(0, 30, 30, 50), (40, 55, 90, 75)], 100, 100) == (10, 75, 60, 95)
    assert free_plate((10, 20, 60, 40), [(0, 10, 100, 90)], 100, 100) == (10, 20, 60, 40)  # nowhere is free


def test_two_labels_of_one_thing_stand_below_each_other() -> None:
    photo = np.zeros((300, 300, 3), dtype=np.uint8)
    box = np.array([[50.0, 100, 200, 250]])
    one = cv2.imdecode(np.frombuffer(draw_boxes(photo, box, ["dog"], np.array([0.9])), np.uint8), cv2.IMREAD_COLOR)
    both = draw_boxes(photo, np.repeat(box, 2, axis=0), ["dog", "cat"], np.array([0.9, 0.3]))
    two = cv2.imdecode(np.frombuffer(both, np.uint8), cv2.IMREAD_COLOR)
    assert one is not None
    assert two is not None
    above = np.flatnonzero(one[:99].any(axis=(1, 2)))
    text = one[above[0] : above[-1] + 1] == 255
    assert text.all(axis=2).any()  # the label is white on its plate
    assert ((two[above[0] : above[-1] + 1] == 255).all(axis=2) == text.all(axis=2)).all()  # the second did not touch it

"""Check the size of ROS messages. The checks read the serialised bytes, because decoding a huge message takes minutes."""

from objslam.core.types import MAX_BOXES
from objslam.ros.messages.decode import DecodeError, read_head, read_length
from objslam.ros.messages.topic_types import IMAGES, TRANSFORMS, is_boxes
from objslam.ros.tf.frames import MAX_TRANSFORMS

_MAX_SMALL = 64 << 20  # The largest size of a message that is not an image, bytes. A larger limit costs time and memory.


def check_size(type_: str, data: bytes, encoding: str) -> None:
    """Raise DecodeError if a serialised message is too large, or has too many detections or transforms.

    type_: the ROS type in ROS 2 form, such as sensor_msgs/msg/Image. encoding: "ros1" or "cdr".
    """
    if is_boxes(type_) and read_head(data, encoding)[2] > MAX_BOXES:
        raise DecodeError(f"more than {MAX_BOXES} detections in one message")
    if type_ in TRANSFORMS and read_length(data, encoding) > MAX_TRANSFORMS:
        raise DecodeError(f"more than {MAX_TRANSFORMS} transforms in one message")
    if type_ not in IMAGES and len(data) > _MAX_SMALL:
        raise DecodeError(f"message larger than {_MAX_SMALL >> 20} MiB")

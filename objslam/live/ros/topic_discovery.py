"""Which topics of a running robot are listened to: by type, or as a user chose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from objslam.live.ros.message_handler import RosMessages
from objslam.ros.messages.topic_types import CAMERA_INFO, COMPRESSED, IMAGES, ODOMETRY, POSES, TRANSFORMS, is_boxes
from objslam.ros.topics import NONE, TF, Choices, closeness, warn_of_choice

_NO_COLOUR = ("depth", "infra", "theora", "disparity")
"""Words in the names of image topics that have no colour image, or none that can be read."""

LOOK_EVERY = 0.2  # Time between an adapter's looks at what is published, s; larger: a new topic is heard later.
HEAD_START = 1.0  # Time for all publishers to be found before one of several is chosen, s; larger: a session begins later.
STOP_WAIT = 0.05  # How soon an adapter sees a stop, s; smaller: it wakes more often for nothing.
QUEUE = 1000  # The most messages of a topic that wait to be taken, but for images; chosen for 5 s of odometry at 200 Hz.


@dataclass
class TopicChoice:
    """Picks topics. chosen: by role, as a user asks. images: whether images are wanted, in place of detections."""

    chosen: Choices = field(default_factory=Choices)
    images: bool = False

    def wanted(self, offered: Mapping[str, str], messages: RosMessages, settled: bool) -> set[str]:
        """The topics to listen to of those offered (name: type).

        Of several that could give the odometry, or a camera's images, one is taken, with a warning, the shortest name
        first; settled: whether all are likely to be known by now.
        """
        names = sorted(offered, key=lambda name: (len(name), name))
        picked = {name for name in names if self._plain(name, offered[name])}
        if settled and not self.chosen.of("odometry"):
            localization = messages.serves("localization")
            odometry = [name for name in names if offered[name] == ODOMETRY and name != localization]
            picked |= set(self._one("odometry", odometry, messages))
            picked |= {name for name in names if name == localization}
        if settled and self.images and not self.chosen.of("image"):
            picked |= set(self._one("image", self._colour(names, offered), messages))
        return picked

    def _plain(self, name: str, type_: str) -> bool:
        """Whether a topic is wanted whatever else there is."""
        if type_ in TRANSFORMS:
            last = name.rpartition("/")[2]
            return last in ("tf", "tf_static") and self._allows(last, name, default=True)
        if is_boxes(type_):
            return self._allows("detections", name, default=not self.images)
        if type_ == CAMERA_INFO:
            return self._allows("camera_info", name, default=True)
        if type_ in IMAGES:
            image = self.images and self._allows("image", name, default=False)
            return image or self._allows("depth", name, default=False)
        if type_ == ODOMETRY and self._allows("odometry", name, default=False):
            return True
        return type_ in (ODOMETRY, *POSES) and self._allows("localization", name, default=False)

    def _allows(self, role: str, name: str, default: bool) -> bool:
        names = self.chosen.of(role)
        return name in names if names else default

    def _one(self, role: str, fitting: list[str], messages: RosMessages) -> list[str]:
        taken = messages.serves(role)
        first = taken if taken in fitting else next(iter(fitting), None)
        if first is None or taken in (TF, NONE):
            return []
        if len(fitting) > 1:
            warn_of_choice(messages.ledger, role, first, (name for name in fitting if name != first))
        return [first]

    def _colour(self, names: list[str], offered: Mapping[str, str]) -> list[str]:
        """Topics of colour images, those first that have a CameraInfo beside them and are not compressed."""
        infos = [name for name in names if offered[name] == CAMERA_INFO]
        images = [n for n in names if offered[n] in IMAGES and not any(word in n.lower() for word in _NO_COLOUR)]
        near = {name: max((closeness(info, name) for info in infos), default=0) for name in images}
        return sorted(images, key=lambda name: (-min(near[name], 1), offered[name] == COMPRESSED, len(name), name))

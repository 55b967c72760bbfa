"""Which topics of a running robot are listened to: by type, or as a user chose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from objslam.live.ros_messages import Choices, RosMessages
from objslam.sources.ros.cameras import closeness
from objslam.sources.ros.roles import NONE, TF, warn_of_choice
from objslam.sources.ros.survey import CAMERA_INFO, COMPRESSED, DETECTIONS, IMAGE, ODOMETRY, POSES, is_tags
from objslam.sources.ros.survey import TF as TF_TYPES

_NO_COLOUR = ("depth", "infra", "theora", "disparity")
_NAMED = (TF, NONE)


@dataclass
class TopicChoice:
    """Picks topics. chosen: by role, as a user asks. images: whether images are wanted, in place of detections."""

    chosen: Choices = field(default_factory=dict)
    images: bool = False

    def wanted(self, offered: Mapping[str, str], messages: RosMessages, settled: bool) -> set[str]:
        """The topics to listen to of those offered (name: type).

        Of several that could give the odometry, or a camera's images, one is taken, with a warning, the shortest name
        first; settled: whether all are likely to be known by now.
        """
        names = sorted(offered, key=lambda name: (len(name), name))
        picked = {name for name in names if self._plain(name, offered[name])}
        if settled and not self.chosen.get("odometry"):
            odometry = [n for n in names if offered[n] == ODOMETRY and not self._serves_as(messages, "localization", n)]
            picked |= set(self._one("odometry", odometry, messages))
            picked |= {n for n in names if self._serves_as(messages, "localization", n)}
        if settled and self.images and not self.chosen.get("image"):
            picked |= set(self._one("image", self._colour(names, offered), messages))
        return picked

    def _plain(self, name: str, type_: str) -> bool:
        """Whether a topic is wanted whatever else there is."""
        if type_ in TF_TYPES:
            last = name.rpartition("/")[2]
            return last in ("tf", "tf_static") and self._allows(last, name, default=True)
        if type_ == DETECTIONS or is_tags(type_):
            return self._allows("detections", name, default=not self.images)
        if type_ == CAMERA_INFO:
            return self._allows("camera_info", name, default=True)
        if type_ in (IMAGE, COMPRESSED):
            image = self.images and self._allows("image", name, default=False)
            return image or self._allows("depth", name, default=False)
        if type_ == ODOMETRY and self._allows("odometry", name, default=False):
            return True
        return type_ in (ODOMETRY, *POSES) and self._allows("localization", name, default=False)

    def _allows(self, role: str, name: str, default: bool) -> bool:
        names = self.chosen.get(role)
        return name in names if names else default

    def _serves_as(self, messages: RosMessages, role: str, name: str) -> bool:
        return messages.serves(role) == name

    def _one(self, role: str, fitting: list[str], messages: RosMessages) -> list[str]:
        taken = messages.serves(role)
        first = taken if taken in fitting else next(iter(fitting), None)
        if first is None or taken in _NAMED:
            return []
        if len(fitting) > 1:
            warn_of_choice(messages.ledger, role, first, (name for name in fitting if name != first))
        return [first]

    def _colour(self, names: list[str], offered: Mapping[str, str]) -> list[str]:
        """Topics of colour images, those first that have a CameraInfo beside them and are not compressed."""
        infos = [name for name in names if offered[name] == CAMERA_INFO]
        images = [
            n for n in names if offered[n] in (IMAGE, COMPRESSED) and not any(word in n.lower() for word in _NO_COLOUR)
        ]
        near = {name: max((closeness(info, name) for info in infos), default=0) for name in images}
        return sorted(images, key=lambda name: (-min(near[name], 1), offered[name] == COMPRESSED, len(name), name))

"""The choice of topics of a running robot, by message type or by the user's options."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from objslam.core.diagnostics import Ledger
from objslam.live.ros.message_handler import RosMessages
from objslam.ros.messages.topic_types import CAMERA_INFO, COMPRESSED, IMAGES, ODOMETRY, POSES, TRANSFORMS, is_boxes
from objslam.ros.topics import LISTED, NONE, TF, TF_ROLES, Choices, closeness, namespace, warn_of_choice

_NO_COLOUR = ("depth", "infra", "theora", "disparity")  # Words in names of image topics whose images are not used.
LOOK_EVERY = 0.2  # The time between two searches of an adapter for topics, s. A larger value finds a new topic later.
HEAD_START = 1.0  # The time to find publishers before one of several is chosen, s. A larger value starts sessions later.
STOP_WAIT = 0.05  # The time until an adapter notices a stop, s. A smaller value wakes it more often without need.
LONELY = 5.0  # The time without a publisher of a topic, s, after which the user is warned. A larger value warns later.
QUEUE = 1000  # The most waiting messages of a topic, except images: 5 s of odometry at 200 Hz. A larger number costs memory.


@dataclass
class TopicChoice:
    """Chooses topics. chosen: the user's choices by role. images: whether images are used instead of detections."""

    chosen: Choices = field(default_factory=Choices)
    images: bool = False
    _absent: set[str] = field(default_factory=set)
    _robot: str = ""

    def wanted(self, offered: Mapping[str, str], messages: RosMessages, settled: bool) -> set[str]:
        """Return the wanted topics. offered: the types of all topics, by name.

        settled: whether probably all topics are known. Before that, no topic is chosen for the user. After that, the
        odometry topic with the shortest name and one image topic (`_colour`) are chosen, unless the user chose. A warning
        names the other topics that fit. Topics of other robots are left out.
        """
        offered = self._of_one_robot(offered, messages.ledger, settled)
        names = sorted(offered, key=lambda name: (len(name), name))
        picked = {name for name in names if self._plain(name, offered[name])}
        if settled and not self.chosen.of("odometry"):
            localization = messages.sources.get("localization")
            odometry = [name for name in names if offered[name] == ODOMETRY and name != localization]
            picked |= self._one("odometry", odometry, messages)
            picked |= {name for name in names if name == localization}
        if settled and self.images and not self.chosen.of("image"):
            picked |= self._one("image", _colour(names, offered), messages)
        return picked

    def _of_one_robot(self, offered: Mapping[str, str], ledger: Ledger, settled: bool) -> Mapping[str, str]:
        """Return the topics without the topics of other robots.

        If each tf topic is in a namespace, each such namespace is a robot. Two robots may have frames of the same names, so
        their topics must not be mixed. The namespaces of the tf topics that the user chose are used. Without such a choice,
        the first namespace with a topic that the user chose is used, else the namespace with the shortest name. Until
        `settled` is True, no robot is chosen for the user.
        """
        chosen = [name for role in TF_ROLES for name in self.chosen.of(role)]
        spaces = {namespace(name) for name, type_ in offered.items() if type_ in TRANSFORMS and _leaf(name) in TF_ROLES}
        robots = sorted(spaces, key=lambda space: (len(space), space))
        if "" in robots or not robots or (chosen and NONE in chosen):
            return offered
        mine = {namespace(name) for name in chosen}
        if not mine and settled:
            named = [name for names in self.chosen.names.values() for name in names]
            holds = [space for space in robots if any(name.startswith(f"{space}/") for name in named)]
            self._robot = self._robot or next(iter(holds or robots))
            mine = {self._robot}
            if len(robots) > 1:
                others = (f"{space}/tf" for space in robots if space not in mine)
                warn_of_choice(ledger, TF, f"{self._robot}/tf", others)
        left = [space for space in robots if space not in mine]
        return {name: type_ for name, type_ in offered.items() if not any(name.startswith(f"{space}/") for space in left)}

    def warn_of_absent(self, offered: Mapping[str, str], ledger: Ledger) -> None:
        """Warn once of each chosen topic that nobody publishes. The warning names the topics that fit its role."""
        for (_, role), names in self.chosen.names.items():
            for name in set(names) - {NONE, TF} - offered.keys() - self._absent:
                self._absent.add(name)
                fitting = sorted(topic for topic, type_ in offered.items() if _fits(role, type_))
                listed = ", ".join(fitting[:LISTED]) or "none"
                ledger.warn(f"--topic {role}={name}: nobody publishes {name} (topics that fit {role}: {listed})")

    def _plain(self, name: str, type_: str) -> bool:
        """Return whether a topic is wanted, whatever the other topics are."""
        if type_ in TRANSFORMS:
            last = _leaf(name)
            return last in ("tf", "tf_static") and self._allows(last, name, default=True)
        if is_boxes(type_):
            return self._allows("detections", name, default=not self.images)
        if type_ == CAMERA_INFO:
            return self._allows("camera_info", name, default=True)
        if type_ in IMAGES:
            return (self.images and self._allows("image", name)) or self._allows("depth", name)
        odometry = type_ == ODOMETRY and self._allows("odometry", name)
        return odometry or (type_ in (ODOMETRY, *POSES) and self._allows("localization", name))

    def _allows(self, role: str, name: str, default: bool = False) -> bool:
        names = self.chosen.of(role)
        return name in names if names else default

    def _one(self, role: str, fitting: list[str], messages: RosMessages) -> set[str]:
        taken = messages.sources.get(role)
        first = taken if taken in fitting else next(iter(fitting), None)
        if first is None or taken in (TF, NONE):
            return set()
        if len(fitting) > 1:
            warn_of_choice(messages.ledger, role, first, (name for name in fitting if name != first))
        return {first}


def _leaf(name: str) -> str:
    return name.rpartition("/")[2]


def _fits(role: str, type_: str) -> bool:
    if role in TF_ROLES:
        return type_ in TRANSFORMS
    if role == "detections":
        return is_boxes(type_)
    types = {"odometry": (ODOMETRY,), "localization": (ODOMETRY, *POSES), "camera_info": (CAMERA_INFO,)}
    return type_ in types.get(role, IMAGES)


def _colour(names: list[str], offered: Mapping[str, str]) -> list[str]:
    """Return the topics of colour images. Topics with a CameraInfo beside them come first, and then uncompressed topics."""
    infos = [name for name in names if offered[name] == CAMERA_INFO]
    images = [n for n in names if offered[n] in IMAGES and not any(word in n.lower() for word in _NO_COLOUR)]
    near = {name: max((closeness(info, name) for info in infos), default=0) for name in images}
    return sorted(images, key=lambda name: (-min(near[name], 1), offered[name] == COMPRESSED, len(name), name))

"""Choose the topic for each role in a run, by the type and the content of the topics."""

from collections.abc import Sequence
from dataclasses import dataclass

from objslam.core.diagnostics import Ledger
from objslam.errors import ConfigError
from objslam.ros.messages.topic_types import CAMERA_INFO, COMPRESSED, IMAGES, ODOMETRY, POSES, TRANSFORMS, is_boxes
from objslam.ros.topics import FROM_TF, LISTED, NONE, TF, TF_ROLES, Choices, warn_of_choice
from objslam.sources.ros_bag.survey import Survey, Topic

_DEPTH_ENCODINGS = ("16uc1", "32fc1")  # The encodings that only depth images have. Depth and grey images can have mono16.


def check_choices(choices: Choices, survey: Survey) -> None:
    """Raise ConfigError if a topic that the user chose is not in the recording, or does not fit its role."""
    for (camera, role), names in choices.names.items():
        for name in names:
            if name == NONE or (name == TF and role in FROM_TF):
                continue
            fitting = candidates(survey, role)
            if name not in survey.topics or survey.topics[name] not in fitting:
                text = f"{camera}.{role}={name}" if camera else f"{role}={name}"
                what = "is not in the bag" if name not in survey.topics else f"has the type {survey.topics[name].type}"
                listed = ", ".join(topic.name for topic in fitting[:LISTED]) or "none"
                raise ConfigError(f"--topic {text}: {name} {what}", hint=f"topics that fit {role}: {listed}")


@dataclass(frozen=True)
class TopicPool:
    """The topics of a recording, and the user's choices (`--topic`)."""

    survey: Survey
    choices: Choices
    ledger: Ledger

    def fitting(self, role: str) -> list[Topic]:
        """Return the topics that fit a role. If the user chose topics for the role, all other topics are left out."""
        names = self.choices.of(role)
        return [topic for topic in candidates(self.survey, role) if not names or topic.name in names]

    def choose(self, role: str, fitting: Sequence[Topic], camera: str = "") -> Topic | None:
        """Return the topic that the user chose for a role of a camera. Without a choice, return the first of `fitting`.

        Warn if the user made no choice and several topics fit. Return None if no topic fits, or if the user chose `none` or
        `tf`.
        """
        names = self.choices.names.get((camera, role))
        if names:
            return None if names[0] in (NONE, TF) else self.survey.topics[names[0]]
        if len(fitting) > 1:
            full = f"{camera}.{role}" if camera else role
            warn_of_choice(self.ledger, full, fitting[0].name, (topic.name for topic in fitting[1:]))
        return fitting[0] if fitting else None


def candidates(survey: Survey, role: str) -> list[Topic]:
    """Return the topics with usable messages of a type that fits the role. The topic with the shortest name is first."""
    topics = sorted(survey.topics.values(), key=lambda topic: (len(topic.name), topic.name))
    return [topic for topic in topics if _fits(topic, role)]


def _is_depth(topic: Topic) -> bool:
    if topic.type == COMPRESSED:
        return "compresseddepth" in topic.image.format.replace(" ", "").lower()
    encoding = topic.image.encoding.lower()
    return encoding in _DEPTH_ENCODINGS or (encoding == "mono16" and "depth" in topic.name.lower())


def _fits(topic: Topic, role: str) -> bool:
    if role == "odometry":
        return topic.type == ODOMETRY and bool(topic.poses)
    if role == "localization":
        return (topic.type == ODOMETRY or topic.type in POSES) and bool(topic.poses)
    if role == "detections":
        return is_boxes(topic.type) and bool(topic.boxes.stamps)
    if role in TF_ROLES:
        return topic.type in TRANSFORMS
    if role == "camera_info":
        return topic.type == CAMERA_INFO and bool(topic.infos)
    return topic.type in IMAGES and topic.image is not None and _is_depth(topic) == (role == "depth")

"""Which topic plays which role, by type; what a user chose, and what was taken where several fit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from objslam.errors import ConfigError
from objslam.ledger import Ledger
from objslam.sources.ros.survey import CAMERA_INFO, COMPRESSED, DETECTIONS, IMAGE, ODOMETRY, POSES, Survey, Topic, is_tags

ROLES = ("odometry", "localization", "detections", "image", "depth", "camera_info")
TF, NONE = "tf", "none"
"""What may stand for a topic: the transforms (of odometry and localization), and that there be none."""

_DEPTH_ENCODINGS = ("16uc1", "32fc1", "mono16")
_LISTED = 8


@dataclass(frozen=True)
class Choices:
    """What a user chose: names by (camera, role), the camera "" where the choice is for any."""

    names: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    def of(self, role: str, camera: str = "") -> list[str]:
        """The names chosen for a role, those for the camera itself first."""
        return self.names.get((camera, role)) or self.names.get(("", role)) or []


def parse_choices(texts: Sequence[str], survey: Survey) -> Choices:
    """Choices from "role=/topic" or "camera.role=/topic"; ConfigError where a role or topic does not exist or fit."""
    choices = Choices()
    for text in texts:
        left, sign, name = (part.strip() for part in text.partition("="))
        camera, _, role = left.rpartition(".")
        if not sign or role not in ROLES:
            raise ConfigError(f"--topic {text!r} is not role=/name", hint=f"roles: {', '.join(ROLES)}")
        if name != NONE and not (name == TF and role in ("odometry", "localization")):
            fitting = candidates(survey, role)
            if name not in survey.topics or survey.topics[name] not in fitting:
                what = "is not in the bag" if name not in survey.topics else f"has the type {survey.topics[name].type}"
                listed = ", ".join(topic.name for topic in fitting[:_LISTED]) or "none"
                raise ConfigError(f"--topic {text}: {name} {what}", hint=f"topics that fit {role}: {listed}")
        choices.names.setdefault((camera, role), []).append(name)
    return choices


def candidates(survey: Survey, role: str) -> list[Topic]:
    """The topics that may play a role, those with short names first: they have messages of a fitting type to show."""
    topics = sorted(survey.topics.values(), key=lambda topic: (len(topic.name), topic.name))
    return [topic for topic in topics if _fits(topic, role)]


def choose(
    role: str, fitting: Sequence[Topic], choices: Choices, survey: Survey, ledger: Ledger, camera: str = ""
) -> Topic | None:
    """The topic of a role: the one chosen, else the first of those that fit, with a warning where there are several."""
    names = choices.of(role, camera)
    if names:
        return None if names[0] in (NONE, TF) else survey.topics[names[0]]
    if len(fitting) > 1:
        warn_of_choice(ledger, f"{camera}.{role}" if camera else role, fitting[0].name, (t.name for t in fitting[1:]))
    return fitting[0] if fitting else None


def warn_of_choice(ledger: Ledger, role: str, taken: str, others: Iterable[str]) -> None:
    """Say what was taken where several fit, and how to take another."""
    names = list(others)
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    ledger.warn(f"several fit {role}: {taken} is taken, not {', '.join(names[:_LISTED])}{more} (--topic {role}=... chooses)")


def is_depth(topic: Topic) -> bool:
    """Whether an image topic carries depth."""
    if topic.image is None:
        return "depth" in topic.name.lower()
    if topic.type == COMPRESSED:
        return "compresseddepth" in topic.image.format.replace(" ", "").lower()
    encoding = topic.image.encoding.lower()
    return encoding in _DEPTH_ENCODINGS[:2] or (encoding == "mono16" and "depth" in topic.name.lower())


def is_rectified(name: str) -> bool:
    """Whether a topic's name says that its image is rectified (image_rect, image_rect_color; image_rectified)."""
    return any(word.startswith("rect") for part in name.lower().split("/") for word in part.split("_"))


def _fits(topic: Topic, role: str) -> bool:
    if role == "odometry":
        return topic.type == ODOMETRY and bool(topic.poses)
    if role == "localization":
        return (topic.type == ODOMETRY or topic.type in POSES) and bool(topic.poses)
    if role == "detections":
        return (topic.type == DETECTIONS or is_tags(topic.type)) and bool(topic.boxes.stamps)
    if role == "camera_info":
        return topic.type == CAMERA_INFO and bool(topic.infos)
    return topic.type in (IMAGE, COMPRESSED) and topic.image is not None and is_depth(topic) == (role == "depth")

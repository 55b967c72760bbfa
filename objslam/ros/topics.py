"""Topic roles: which there are, what a user chose for them, and what a topic's name tells."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from objslam.core.diagnostics import Ledger
from objslam.errors import ConfigError

ROLES = ("odometry", "localization", "detections", "image", "depth", "camera_info")
"""The roles that a topic of a bag may play."""

LIVE_ROLES = (*ROLES, "tf", "tf_static")  # The roles that a topic of a running robot may play.
TF, NONE = "tf", "none"  # What may stand for a topic: the transforms, or that there be none.
FROM_TF = ("odometry", "localization")  # The roles that the transforms may play.
LISTED = 8  # The most topics that a message lists; chosen for a line that can be read.


@dataclass(frozen=True)
class Choices:
    """The topics that a user chose.

    names: the names of topics by (camera, role). The camera "" means any camera.
    """

    names: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    def of(self, role: str, camera: str = "") -> list[str]:
        """The names chosen for a role, those for the camera itself first."""
        return self.names.get((camera, role)) or self.names.get(("", role)) or []


def parse_topics(texts: Sequence[str], *, live: bool = False) -> Choices:
    """The choices that --topic makes.

    Args:
        texts: "role=/topic" each; in bags also "camera.role=/topic".
        live: whether the topics are those of a running robot, whose names begin with "/", be it said or not.
    Raises:
        ConfigError: when a text is not of that form or there is no such role.
    """
    choices, roles = Choices(), LIVE_ROLES if live else ROLES
    for text in texts:
        left, _, name = (part.strip() for part in text.partition("="))
        camera, _, role = ("", "", left) if live else left.rpartition(".")
        if not name or role not in roles:
            raise ConfigError(f"--topic {text!r} is not role=/name", hint=f"roles: {', '.join(roles)}")
        if live and name == TF and role not in FROM_TF:
            raise ConfigError(f"--topic {text}: tf gives odometry and localization only")
        rooted = not live or name in (TF, NONE) or name.startswith("/")
        choices.names.setdefault((camera, role), []).append(name if rooted else f"/{name}")
    return choices


def warn_of_choice(ledger: Ledger, role: str, taken: str, others: Iterable[str]) -> None:
    """Say what was taken where several fit, and how to take another."""
    names = list(others)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    ledger.warn(f"several fit {role}: {taken} is taken, not {', '.join(names[:LISTED])}{more} (--topic {role}=... chooses)")


def is_rectified(name: str) -> bool:
    """Whether a topic's name says that its image is rectified (image_rect, image_rect_color; image_rectified)."""
    return any(word.startswith("rect") for part in name.lower().split("/") for word in part.split("_"))


def closeness(a: str, b: str) -> int:
    """How many leading parts two topic names share."""
    shared = 0
    for one, other in zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False):
        if one != other:
            break
        shared += 1
    return shared


def is_named(camera: str, frame: str, topic: str) -> bool:
    """Whether a camera's name is a frame, or a part of the frame or of a topic's name."""
    return camera in (frame, *frame.split("/"), *topic.split("/"))

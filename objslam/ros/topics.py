"""Name the roles of topics, parse the topics that the user chose, and find hints in topic names."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from objslam.core.diagnostics import Ledger
from objslam.errors import ConfigError
from objslam.io.camera_yaml import Mount

ROLES = ("odometry", "localization", "detections", "image", "depth", "camera_info")  # The roles of topics in a bag.
TF, NONE = "tf", "none"
"""The words that --topic accepts in place of a topic. TF: transforms supply the role. NONE: nothing supplies the role."""
TF_ROLES = ("tf", "tf_static")  # The roles of the topics that carry transforms.
FROM_TF = ("odometry", "localization")  # The roles that transforms can supply.
LISTED = 8  # The largest number of topics that a warning lists. The limit keeps the warning readable.


@dataclass(frozen=True)
class Choices:
    """The topics that the user chose. names: topic names by (camera, role). The camera "" stands for any camera."""

    names: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    def of(self, role: str, camera: str = "") -> list[str]:
        """Return the topics chosen for a role of `camera`. If none were chosen, return those chosen for any camera."""
        return self.names.get((camera, role)) or self.names.get(("", role)) or []


def parse_topics(texts: Sequence[str], *, live: bool = False) -> Choices:
    """Parse the values of --topic. Raises ConfigError for a wrong value.

    A value is "role=/topic", or for a bag also "camera.role=/topic". If `live` is True, a value must not name a camera, and
    a topic may lack its leading "/".
    """
    choices, roles = Choices(), (*ROLES, *TF_ROLES)
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
    """Warn that several topics fit a role. The warning names the chosen topic and the option that chooses another."""
    names = list(others)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    ledger.warn(f"several fit {role}: {taken} is taken, not {', '.join(names[:LISTED])}{more} (--topic {role}=... chooses)")


def namespace(topic: str) -> str:
    """Return the name of a topic up to its last slash: "/robot1" of /robot1/tf, and "" of /tf."""
    return topic.rpartition("/")[0]


def is_rectified(name: str) -> bool:
    """Return whether a topic name indicates a rectified image, such as image_rect, image_rect_color or image_rectified."""
    return any(word.startswith("rect") for part in name.lower().split("/") for word in part.split("_"))


def closeness(a: str, b: str) -> int:
    """Return the number of leading name parts that two topics share."""
    pairs = zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def mount_of(mounts: Sequence[Mount], frame: str, topic: str) -> Mount | None:
    """Return the mount of the camera that has this coordinate frame and topic, or None if no mount fits.

    A single mount without a name fits every camera.
    """
    named = (mount for mount in mounts if mount.name and is_named(mount.name, frame, topic))
    return next(named, mounts[0] if len(mounts) == 1 and not mounts[0].name else None)


def is_named(camera: str, frame: str, topic: str) -> bool:
    """Return whether a camera name equals a frame name, or a part between slashes of the frame name or of a topic name."""
    return camera in (frame, *frame.split("/"), *topic.split("/"))

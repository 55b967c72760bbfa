"""Mutations of bytes and of JSON data, and the rule that a parser keeps: our own error, or data that are valid."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import random
import resource
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from objslam.core.trajectory import Trajectory
from objslam.errors import ObjslamError

ROUNDS = int(os.environ.get("OBJSLAM_FUZZ_ROUNDS", "1"))
"""How many times the inputs of the suite a target gets. tools/fuzz.sh sets a larger number."""
LEAST = int(os.environ.get("OBJSLAM_FUZZ_LEAST", "0"))
"""The least number of inputs of a target. Without it, a slow target gets few in a round."""
SEED = int(os.environ.get("OBJSLAM_FUZZ_SEED", "0"))
"""The first seed of the byte mutations. tools/fuzz.sh counts it up, so that each of its rounds has other inputs."""
CORPUS = Path(__file__).parent / "corpus"
"""The inputs that once broke a target, in a folder for each. Every run gives them to the target again."""
MEMORY = 2 << 30
"""How much one input may raise the most memory of the process, bytes. More means that a parser trusts a size in it."""
SECONDS = float(os.environ.get("OBJSLAM_FUZZ_SECONDS", "inf"))
"""How long one input may take, CPU seconds. tools/fuzz.sh sets it. The suite has no such limit: no test depends on time."""
COUNTED = {"inputs": 0, "slowest": 0.0}
"""How many inputs the targets got so far, and the CPU seconds of the slowest one since this was last set to 0."""
NUMBERS = [b"nan", b"inf", b"-1", b"1e300", b"1e400", b"99999999999999999999", b"0", b"null", b"true", b"[]", b"{}", b'""']
ODD = [
    None,
    True,
    -1,
    0,
    2**31,
    2**63,
    10**400,
    1e8,
    1e300,
    1e-300,
    float("nan"),
    float("inf"),
    "",
    "\ud800",
    "x",
    [],
    {},
    [[]],
]

odd = st.sampled_from(ODD) | st.floats() | st.integers() | st.text(max_size=3) | st.lists(st.integers(), max_size=3)


def examples(count: int, inputs: int = 1) -> int:
    """How many examples a target gets: `count` a round, or as LEAST needs. inputs: how many inputs an example makes."""
    return max(count * ROUNDS, -(-LEAST // inputs))


def mutated(data: bytes, count: int, inputs: int = 1) -> Iterator[bytes]:
    """Yield mutations of bytes, as many as `examples` says: flips, cuts, doublings, other numbers, and pieces moved."""
    for number in range(examples(count, inputs)):
        chance = random.Random(f"{SEED} {number}")
        made = bytearray(data)
        for _ in range(chance.choice([1, 1, 2, 4, 16])):
            at = chance.randrange(len(made) + 1)
            length = chance.choice([1, 2, 4, 8, 64])
            kind = chance.randrange(6)
            if kind == 0 and at < len(made):
                made[at] ^= 1 << chance.randrange(8)
            elif kind == 1 and at < len(made):
                made[at : at + length] = chance.randbytes(length)
            elif kind == 2:
                del made[at : at + length]
            elif kind == 3:
                made[at:at] = made[at : at + length]
            elif kind == 4:
                made[at : at + length] = chance.choice(NUMBERS)
            elif number % 7 == 0:
                del made[at:]
        yield bytes(made)


@st.composite
def altered(draw: st.DrawFn, data: Any) -> Any:
    """JSON data in which one to three values are replaced by odd ones, removed, or doubled."""
    made = copy.deepcopy(data)
    for _ in range(draw(st.integers(1, 3))):
        inner = made
        while True:
            keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            if isinstance(inner[key], dict | list) and inner[key] and draw(st.integers(0, 3)):
                inner = inner[key]
                continue
            action = draw(st.integers(0, 4))
            if action == 0:
                del inner[key]
            elif action == 1 and isinstance(inner, list):
                inner.append(copy.deepcopy(inner[key]))
            else:
                inner[key] = copy.deepcopy(draw(odd))
            break
    return made


def as_json(data: Any) -> bytes:
    """JSON text; a whole number with too many digits stays one."""
    return json.dumps(data).encode("utf-8", "surrogatepass")


def known(target: str) -> Iterator[bytes]:
    """Yield the inputs in the folder `corpus` that once broke a target."""
    folder = CORPUS / target
    for file in sorted(folder.iterdir()) if folder.is_dir() else ():
        yield file.read_bytes()


def survives(parse: Callable[[], Any], target: str = "", data: bytes = b"") -> bool:
    """Whether a parser takes its input. What it takes must be valid, and what it refuses must end in our own error.

    target, data: an input that breaks the parser is written into the folder `corpus` under the name of the target.
    """
    COUNTED["inputs"] += 1
    before, begin = taken(), spent()
    try:
        valid = _ends_well(parse)
        seconds = spent() - begin
        COUNTED["slowest"] = max(COUNTED["slowest"], seconds)
        assert taken() - before < MEMORY, f"{(taken() - before) >> 20} MiB for one input"
        assert seconds < SECONDS, f"{seconds:.1f} CPU seconds for one input"
    except BaseException:
        if target:
            file = CORPUS / target / hashlib.sha256(data).hexdigest()[:16]
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
        raise
    return valid


def taken() -> int:
    """The most memory that this process has taken so far, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def spent() -> float:
    """The CPU seconds that this process has used so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _ends_well(parse: Callable[[], Any]) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # A user would see it in the middle of what a command says.
        try:
            check(parse())
        except ObjslamError:
            return False
    return True


def check(found: Any) -> None:
    """Every trajectory, pose and covariance in what a parser returned is finite, and every rotation is one."""
    if isinstance(found, Trajectory):
        poses(found.poses)
    elif isinstance(found, list | tuple):
        for part in found:
            check(part)
    elif is_dataclass(found):
        for field in fields(found):
            value = getattr(found, field.name)
            if isinstance(value, np.ndarray) and field.name in ("pose", "base_T_camera", "odometry", "motion"):
                poses(value.reshape(-1, 4, 4))
            elif isinstance(value, np.ndarray) and field.name in (
                "covariance",
                "boxes",
                "stamps",
                "scores",
                "matrix",
                "stamp",
            ):
                assert np.isfinite(value).all(), field.name
            else:
                check(value)


def poses(found: Any) -> None:
    """Poses (N, 4, 4) are rigid and in reach."""
    turn = found[:, :3, :3]
    assert np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3)).max(initial=0.0) < 1e-9
    assert (np.linalg.det(turn) > 0).all()
    assert np.abs(found[:, :3, 3]).max(initial=0.0) < 1e7

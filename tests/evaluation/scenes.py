"""Maps, truths and paths for the tests of the evaluation."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from rich.console import Console

from objslam.core.arrays import Floats
from objslam.core.geometry import lift_se2
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.core.types import Truth, TruthObject
from objslam.evaluation.evaluate import Evaluation
from objslam.evaluation.table import evaluation_table

CLASSES = st.sampled_from([1, 3, 12])


def an_object(number: int, label: str, position: Floats, status: str = "ok") -> MapObject:
    return MapObject(number, label, np.asarray(position, float), None, status, 9, 9, 20.0, 0.2, 0.0, 1.0)  # type: ignore[arg-type]


def a_map(positions: Floats, labels: list[str]) -> ObjectMap:
    return ObjectMap(tuple(an_object(10 + i, label, p) for i, (label, p) in enumerate(zip(labels, positions, strict=True))))


def a_truth(positions: Floats, labels: list[str], path: Trajectory | None = None) -> Truth:
    objects = tuple(
        TruthObject(i, label, np.asarray(p, float)) for i, (label, p) in enumerate(zip(labels, positions, strict=True))
    )
    return Truth(objects, path)


def a_path(seed: int = 0, count: int = 60) -> Trajectory:
    t = np.linspace(0, 4, count)
    wobble = np.random.default_rng(seed).uniform(1, 2, 3)
    return Trajectory(10 + t, lift_se2(np.column_stack([t * wobble[0], np.sin(t * wobble[1]) * 3, t])))


def scene(seed: int, classes: int) -> tuple[Floats, list[str], Floats, list[str]]:
    """12 true objects; a map that misses two of them, has two false ones, and is 2 cm off."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack([rng.uniform(0, 10, 12), rng.uniform(0, 8, 12), rng.uniform(0, 1, 12)])
    labels = [f"class {i % classes}" for i in range(12)]
    found = np.concatenate([truth[2:] + rng.normal(scale=0.02, size=(10, 3)), [[30, 30, 0], [-25, 7, 1]]])
    return truth, labels, found, [*labels[2:], labels[0], labels[1]]


def numbers(evaluation: Evaluation) -> dict[str, float]:
    data = evaluation.to_dict()
    return {k: v for k, v in data.items() if isinstance(v, int | float) and not isinstance(v, bool)}


def show(evaluation: Evaluation) -> str:
    console = Console(width=100, markup=False, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    console.print(evaluation_table(evaluation))
    return console.export_text()

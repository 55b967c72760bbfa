"""The decisions of a run in words: when an object was seen, why it is unresolved, what each round made of the last."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from objslam.scene import captions, ray_kinds
from objslam.trace import Round
from objslam.types import Floats, Ints, MapObject, ObjectMap

if TYPE_CHECKING:
    from objslam.results import RunResult

Level = Literal["INFO", "WARN"]
_MOST = 40  # lines about objects in one round
_MERGED = 0.5  # m; an object that goes has become its neighbour of the same label
_WHY = {
    "fixed": "association at the poses as they are",
    "labels": "every label taken for one object",
    "association": "association at the poses so far",
    "merge": "objects that the poses brought together are one",
}


@dataclass(frozen=True)
class Line:
    """One line of the log, at a stamp, s, or at an iteration."""

    at: float
    level: Level
    text: str


def drive_lines(result: RunResult) -> list[Line]:
    """What a drive's log says, in the order of time: the whole first, then objects as they are seen."""
    start = float(result.keyframes.stamps[0])
    resolved = len(result.map.resolved())
    objects = f"{resolved} objects, {len(result.map) - resolved} unresolved"
    lines = [Line(start, "INFO", f"{objects}, {len(result.rays)} rays, {len(result.keyframes)} keyframes")]
    lines += [Line(start, "WARN", str(text)) for text in result.summary.get("warnings", [])]
    for reason, count in result.summary.get("dropped", {}).items():
        lines.append(Line(start, "WARN", f"dropped {count}: {reason}"))
    enough = _enough_parallax(result)
    rejected = np.bincount(result.association.object[ray_kinds(result)["rejected"]], minlength=max(len(result.map), 1))
    later = []
    for j, (o, name) in enumerate(zip(result.map.objects, captions(result.map), strict=True)):
        later.append(Line(o.first_seen, "INFO", f"{_clock(o.first_seen - start)} {name}: first seen"))
        if o.status != "ok":
            text = f"{_clock(o.last_seen - start)} {name}: unresolved, {why_unresolved(o, result)}"
            later.append(Line(o.last_seen, "WARN", text))
            continue
        if np.isfinite(enough[j]):
            limit = result.settings.triangulation.min_parallax_deg
            text = f"{_clock(enough[j] - start)} {name}: its rays now span {limit:g} deg, enough for a place"
            later.append(Line(float(enough[j]), "INFO", text))
        out = f", {rejected[j]} rejected" if rejected[j] else ""
        sigma = "" if o.covariance is None else f", sigma {100 * np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]):.1f} cm"
        text = f"{name}: {o.rays} rays{out}, parallax {o.parallax_deg:.0f} deg, rms {o.rms_deg:.2f} deg{sigma}"
        later.append(Line(o.last_seen, "INFO", f"{_clock(o.last_seen - start)} {text}"))
    return lines + sorted(later, key=lambda line: line.at)


def why_unresolved(o: MapObject, result: RunResult) -> str:
    """Why an object has no place to rely on, by the limits of the settings."""
    limits = result.settings.triangulation
    if o.rays < 2:
        return "a single ray says where to look, not how far"
    if o.parallax_deg < limits.min_parallax_deg:
        return (
            f"its {o.rays} rays span {o.parallax_deg:.1f} deg (triangulation.min_parallax_deg {limits.min_parallax_deg:g})"
        )
    return (
        f"its {o.rays} rays leave it less certain than {limits.max_rel_sigma:g} of its distance "
        "(triangulation.max_rel_sigma), or do not agree"
    )


def _enough_parallax(result: RunResult) -> Floats:
    """(N,) s, when each object's used rays first spanned the parallax it takes, seen from the first of them; NaN never."""
    stamps = np.full(len(result.map), np.nan)
    used = np.flatnonzero(ray_kinds(result)["used"])
    order = used[np.lexsort((result.rays.keyframe[used], result.association.object[used]))]
    index = result.association.object[order]
    if len(order) == 0:
        return stamps
    first = np.flatnonzero(np.append(True, index[1:] != index[:-1]))
    leader = np.repeat(first, np.diff(np.append(first, len(index))))
    n = result.directions[order]
    turned = np.degrees(np.arccos(np.clip(np.einsum("ri,ri->r", n, n[leader]), -1.0, 1.0)))
    enough = np.flatnonzero(turned >= result.settings.triangulation.min_parallax_deg)
    found, at = np.unique(index[enough], return_index=True)
    stamps[found] = result.keyframes.stamps[result.rays.keyframe[order[enough[at]]]]
    return stamps


def round_lines(trace: tuple[Round, ...], label_names: tuple[str, ...]) -> list[Line]:
    """What each round decided, at its first iteration: objects born, merged and dropped; and what its solve came to."""
    lines: list[Line] = []
    at, before = 0, None
    for number, r in enumerate(trace):
        names = [f"{label_names[k]} #{j}" for j, k in enumerate(r.association.label.tolist())]
        free = int((r.association.object < 0).sum())
        head = f"round {number + 1}, {_WHY[r.why]}: {r.association.count} objects, {free} rays that none explains"
        lines.append(Line(at, "INFO", head))
        if before is not None and before.why == "labels":
            lines.append(Line(at, "WARN", "labels are no identities: too many rays disagreed with the one object of theirs"))
        told = _changes(before, r, names, label_names)
        lines += [Line(at, "INFO", text) for text in told[:_MOST]]
        if len(told) > _MOST:
            lines.append(Line(at, "INFO", f"... and {len(told) - _MOST} more"))
        solves = [i.cost for i in r.iterations if i.stage == "solve"]
        if solves:
            held = r.association.object >= 0
            rejected = int((r.weight[held] == 0).sum())
            text = f"solved in {len(solves)} iterations, cost {solves[0]:.4g} to {solves[-1]:.4g}, {rejected} rays rejected"
            lines.append(Line(at + len(r.iterations) - 1, "INFO", text))
        at, before = at + len(r.iterations), r
    return lines


def _changes(before: Round | None, now: Round, names: list[str], label_names: tuple[str, ...]) -> list[str]:
    """Objects born, merged and dropped between two rounds, by where the rays went."""
    rays = np.bincount(now.association.object[now.association.object >= 0], minlength=now.association.count)
    if before is None:
        return [f"born: {name}, {n} rays" for name, n in zip(names, rays.tolist(), strict=True)]
    old = before.association
    old_names = [f"{label_names[k]} #{i}" for i, k in enumerate(old.label.tolist())]
    went = _flow(old.object, now.association.object, old.count, now.association.count)
    heir = np.where(went.sum(axis=1) > 0, went.argmax(axis=1), -1)  # the last column: explained by nothing
    heir[heir == now.association.count] = -1
    texts = []
    for j in range(now.association.count):
        parents = np.flatnonzero(heir == j)
        if len(parents) == 0:
            texts.append(f"born: {names[j]}, {rays[j]} rays that were others' or nobody's")
        elif len(parents) > 1:
            merged = ", ".join(f"{old_names[i]} ({int(went[i].sum())} rays)" for i in parents)
            gap = float(np.linalg.norm(before.positions[parents[0]] - before.positions[parents[1]]))
            apart = f", {gap:.2f} m apart" if np.isfinite(gap) else ""
            texts.append(f"merged: {merged} are {names[j]}{apart}")
    for i in np.flatnonzero(heir < 0):
        lost, total = int(went[i, -1]), int(went[i].sum())
        texts.append(f"dropped: {old_names[i]}, {lost} of its {total} rays are explained by nothing now")
    return texts


def map_changes(before: ObjectMap, now: ObjectMap) -> list[tuple[Level, str]]:
    """What happened to a live map: objects born, placed, lost and dropped, by their ids."""
    old, new = ({o.id: o for o in m.objects} for m in (before, now))
    lines: list[tuple[Level, str]] = []
    for j, o in new.items():
        name, was = f"{o.label} #{j}", old.get(j)
        if was is None:
            lines.append(("INFO", f"born: {name}, {o.rays} rays, parallax {o.parallax_deg:.0f} deg"))
        if o.status == "ok" and (was is None or was.status != "ok"):
            sigma = "" if o.covariance is None else f", sigma {100 * np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]):.0f} cm"
            lines.append(("INFO", f"placed: {name}, {o.rays} rays, parallax {o.parallax_deg:.0f} deg{sigma}"))
        if o.status != "ok" and was is not None and was.status == "ok":
            lines.append(("WARN", f"no longer sure: {name}, {o.rays} rays, parallax {o.parallax_deg:.0f} deg"))
        if was is not None and was.label != o.label:
            lines.append(("INFO", f"renamed: {was.label} #{j} is a {o.label}"))
    gone = [o for j, o in old.items() if j not in new]
    for o in gone:
        near = [n for n in new.values() if n.label == o.label and np.linalg.norm(n.position - o.position) < _MERGED]
        into = f"merged into {near[0].label} #{near[0].id}" if near else "nothing explains it any more"
        lines.append(("INFO", f"dropped: {o.label} #{o.id}, {o.rays} rays, {into}"))
    return lines


def _flow(old: Ints, new: Ints, olds: int, news: int) -> Ints:
    """How many rays went from each old object to each new one, or to none (the last column): (olds, news + 1)."""
    held = old >= 0
    to = np.where(new[held] < 0, news, new[held])
    return np.bincount(old[held] * (news + 1) + to, minlength=olds * (news + 1)).reshape(olds, news + 1)


def _clock(seconds: float) -> str:
    return f"{seconds:.1f} s"

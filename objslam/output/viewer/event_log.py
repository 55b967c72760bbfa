"""Make the texts of a recording: events of the drive, changes of each round or of a live map, and a table of the run."""

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import ObjectMap
from objslam.core.result import RunResult
from objslam.core.trace import Round
from objslam.errors import one_line
from objslam.mapping.doubts.words import why_unresolved
from objslam.output.plot.style import captions, ray_kinds

Level = Literal["INFO", "WARN"]
_MAX_CHANGES = 40  # The largest number of changes of objects that the log lists for a round.
_MERGED = 0.5  # The distance, m, below which a dropped object counts as merged into another object of its label.
_WHY = {
    "fixed": "association at the fixed poses",
    "labels": "one object assumed for each label",
    "association": "association at the latest poses",
    "merge": "merge of objects that the new poses move together",
    "split": "split of objects that may be two",
    "few rays": "objects that few rays show",
    "bodies": "bearings to the centres of bodies",
}
"""The words that the log shows for the reason of each round."""
_COUNTS = {
    "keyframes": "keyframes",
    "detections": "boxes",
    "rays": "rays",
    "rays_rejected": "rejected by the robust loss (red)",
    "rays_unexplained": "explained by no object (grey)",
    "objects": "objects",
    "unresolved": "unresolved objects",
}
"""The words that the table shows for the counts in summary.json."""


@dataclass(frozen=True)
class Event:
    """One line of the log, at a stamp (s) or an iteration."""

    at: float
    level: Level
    text: str


def drive_events(result: RunResult) -> list[Event]:
    """Return the events of a drive. Events of the whole run come first. Events of objects follow in the order of time."""
    start = float(result.keyframes.stamps[0])
    resolved = len(result.map.resolved())
    objects = f"{resolved} objects, {len(result.map) - resolved} unresolved"
    events = [Event(start, "INFO", f"{objects}, {len(result.rays)} rays, {len(result.keyframes)} keyframes")]
    events += [Event(start, "WARN", str(text)) for text in result.summary.get("warnings", [])]
    enough = _enough_parallax(result)
    rejected = np.bincount(result.association.object[ray_kinds(result)["rejected"]], minlength=max(len(result.map), 1))
    later: list[Event] = []

    def add(stamp: float, level: Level, text: str) -> None:
        later.append(Event(stamp, level, f"{stamp - start:.1f} s {text}"))

    for j, (o, name) in enumerate(zip(result.map.objects, captions(result.map), strict=True)):
        add(o.first_seen, "INFO", f"{name}: first seen")
        if o.status != "ok":
            add(o.last_seen, "WARN", f"{name}: unresolved, {why_unresolved(result, j)}")
            continue
        if np.isfinite(enough[j]):
            limit = result.settings.triangulation.min_parallax_deg
            add(float(enough[j]), "INFO", f"{name}: its rays now span {limit:g} deg, enough for a position")
        out = f", {rejected[j]} rejected" if rejected[j] else ""
        sigma = "" if o.sigma is None else f", sigma {100 * o.sigma:.1f} cm"
        text = f"{name}: {o.rays} rays{out}, parallax {o.parallax_deg:.0f} deg, rms {o.rms_deg:.2f} deg{sigma}"
        add(o.last_seen, "INFO", text)
    return events + sorted(later, key=lambda event: event.at)


def _enough_parallax(result: RunResult) -> Floats:
    """Return the stamp (N,), s, at which each object first has enough parallax.

    At this stamp, a used ray first has an angle of at least `triangulation.min_parallax_deg` to the earliest used ray. The
    stamp of an object without such a ray is NaN.
    """
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


def round_events(trace: tuple[Round, ...], label_names: tuple[str, ...]) -> list[Event]:
    """Return the events of all rounds. The changes of a round are at its first iteration, and the result of its solve is at
    its last iteration."""
    events: list[Event] = []
    at, before = 0, None
    for number, r in enumerate(trace):
        free = int((r.association.object < 0).sum())
        head = f"round {number + 1}, {_WHY[r.why]}: {r.association.count} objects, {free} unexplained rays"
        events.append(Event(at, "INFO", head))
        if before is not None and before.why == "labels":
            text = "a label is not one object: too many rays disagreed with the only object of their label"
            events.append(Event(at, "WARN", text))
        changes = _changes(before, r, label_names)
        events += [Event(at, "INFO", text) for text in changes[:_MAX_CHANGES]]
        if len(changes) > _MAX_CHANGES:
            events.append(Event(at, "INFO", f"... and {len(changes) - _MAX_CHANGES} more"))
        solves = [i.cost for i in r.iterations if i.stage == "solve"]
        if solves:
            held = r.association.object >= 0
            rejected = int((r.weight[held] == 0).sum())
            text = f"solved in {len(solves)} iterations, cost {solves[0]:.4g} to {solves[-1]:.4g}, {rejected} rays rejected"
            events.append(Event(at + len(r.iterations) - 1, "INFO", text))
        at, before = at + len(r.iterations), r
    return events


def _changes(before: Round | None, now: Round, label_names: tuple[str, ...]) -> list[str]:
    """Return a text for each object that is new, merged or dropped since the round `before`.

    An object of the earlier round is the same as the object that now has most of its rays.
    """
    names = [f"{label_names[k]} #{j}" for j, k in enumerate(now.association.label.tolist())]
    rays = np.bincount(now.association.object[now.association.object >= 0], minlength=now.association.count)
    if before is None:
        return [f"new: {name}, {n} rays" for name, n in zip(names, rays.tolist(), strict=True)]
    old = before.association
    old_names = [f"{label_names[k]} #{i}" for i, k in enumerate(old.label.tolist())]
    held, news = old.object >= 0, now.association.count
    to = np.where(now.association.object[held] < 0, news, now.association.object[held])
    went = np.bincount(old.object[held] * (news + 1) + to, minlength=old.count * (news + 1)).reshape(old.count, news + 1)
    heir = np.where(went.sum(axis=1) > 0, went.argmax(axis=1), -1)
    heir[heir == news] = -1  # The last column of `went` counts the rays that are now unexplained.
    texts = []
    for j in range(news):
        parents = np.flatnonzero(heir == j)
        if len(parents) == 0:
            texts.append(f"new: {names[j]}, {rays[j]} rays of other objects or unexplained")
        elif len(parents) > 1:
            merged = ", ".join(f"{old_names[i]} ({int(went[i].sum())} rays)" for i in parents)
            gap = float(np.linalg.norm(before.positions[parents[0]] - before.positions[parents[1]]))
            apart = f", {gap:.2f} m apart" if np.isfinite(gap) else ""
            texts.append(f"merged: {merged} are {names[j]}{apart}")
    for i in np.flatnonzero(heir < 0):
        lost, total = int(went[i, -1]), int(went[i].sum())
        texts.append(f"dropped: {old_names[i]}, {lost} of its {total} rays are now unexplained")
    return texts


def map_changes(before: ObjectMap, now: ObjectMap) -> list[tuple[Level, str]]:
    """Return level and text of each change of a live map. An object is new, resolved, unresolved, renamed or dropped."""
    old, new = ({o.id: o for o in m.objects} for m in (before, now))
    lines: list[tuple[Level, str]] = []
    for j, o in new.items():
        was, text = old.get(j), f"{o.label} #{j}, {o.rays} rays, parallax {o.parallax_deg:.0f} deg"
        if was is None:
            lines.append(("INFO", f"new: {text}"))
        if o.status == "ok" and (was is None or was.status != "ok"):
            sigma = "" if o.sigma is None else f", sigma {100 * o.sigma:.0f} cm"
            lines.append(("INFO", f"resolved: {text}{sigma}"))
        if o.status != "ok" and was is not None and was.status == "ok":
            lines.append(("WARN", f"no longer resolved: {text}"))
        if was is not None and was.label != o.label:
            lines.append(("INFO", f"renamed: {was.label} #{j} is a {o.label}"))
    for o in (o for j, o in old.items() if j not in new):
        near = [n for n in new.values() if n.label == o.label and np.linalg.norm(n.position - o.position) < _MERGED]
        into = f"merged into {near[0].label} #{near[0].id}" if near else "its rays are now unexplained"
        lines.append(("INFO", f"dropped: {o.label} #{o.id}, {o.rays} rays, {into}"))
    return lines


def summary_text(result: RunResult) -> str:
    """Return the table of a run as Markdown: counts, cost, the time of each stage, and the rounds."""
    summary = result.summary
    counts, seconds = summary.get("counts", {}), summary.get("seconds", {})
    rows = [(name, str(counts[key])) for key, name in _COUNTS.items() if key in counts]
    if "cost_before" in summary:
        rows.append(("cost", f"{summary['cost_before']:.4g} to {summary['cost_after']:.4g}"))
    rows += [(f"seconds: {name}", f"{value:.2f}") for name, value in seconds.items()]
    lines = [
        f"**{markdown(summary.get('log', 'run'))}**, {summary.get('mode', result.settings.mode)} mode",
        "",
        *table(rows),
    ]
    if calibration := summary.get("calibration"):
        lines += ["", "| shared error | found | sigma | prior sigma | unit | |", "|---|---:|---:|---:|---|---|"]
        for name, of in calibration["parameters"].items():
            remark = "" if of["observable"] else "not observable from this log"
            shown = " | ".join(f"{of[key]:.4f}" for key in ("value", "sigma", "prior_sigma"))
            lines.append(f"| {markdown(name)} | {shown} | {of['unit']} | {remark} |")
        lines += [f"This log cannot tell apart: {markdown(' and '.join(pair))}." for pair in calibration["traded_off"]]
    if result.trace:
        lines += ["", "| round | objects | unexplained | cost |", "|---|---:|---:|---:|"]
        for number, r in enumerate(result.trace):
            cost = next((f"{i.cost:.4g}" for i in reversed(r.iterations)), "")
            free = int((r.association.object < 0).sum())
            lines.append(f"| {number + 1} {r.why} | {r.association.count} | {free} | {cost} |")
        lines += ["", "The timeline `iteration` steps through the solver."]
    return "\n".join(lines)


def table(rows: list[tuple[str, str]]) -> list[str]:
    """Return the lines of a Markdown table of names and values."""
    return ["| | |", "|---|---:|", *(f"| {markdown(name)} | {value} |" for name, value in rows)]


def markdown(text: str) -> str:
    """Return a text as one line of Markdown. Special characters are escaped, so that they make no link, image or HTML."""
    return re.sub(r"([\\`*_\[\]<>|!~#&])", r"\\\1", one_line(text))

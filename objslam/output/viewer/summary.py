"""The run in a table: counts, time for each stage, rounds."""

from __future__ import annotations

from objslam.core.result import RunResult

_COUNTS = {
    "keyframes": "keyframes",
    "detections": "boxes",
    "rays": "rays",
    "rays_rejected": "rejected by the robust loss (red)",
    "rays_unexplained": "explained by no object (grey)",
    "objects": "objects",
    "unresolved": "of them unresolved",
}
"""The counts of summary.json that the table has, and what it calls them."""


def summary_text(result: RunResult) -> str:
    """A run's summary as Markdown."""
    summary = result.summary
    counts, seconds = summary.get("counts", {}), summary.get("seconds", {})
    rows = [(name, str(counts[key])) for key, name in _COUNTS.items() if key in counts]
    if "cost_before" in summary:
        rows.append(("cost", f"{summary['cost_before']:.4g} to {summary['cost_after']:.4g}"))
    rows += [(f"seconds: {name}", f"{value:.2f}") for name, value in seconds.items()]
    lines = [f"**{summary.get('log', 'run')}**, {summary.get('mode', result.settings.mode)} mode", "", "| | |", "|---|---:|"]
    lines += [f"| {name} | {value} |" for name, value in rows]
    if result.trace:
        lines += ["", "| round | objects | unexplained | cost |", "|---|---:|---:|---:|"]
        for number, r in enumerate(result.trace):
            cost = next((f"{i.cost:.4g}" for i in reversed(r.iterations)), "")
            free = int((r.association.object < 0).sum())
            lines.append(f"| {number + 1} {r.why} | {r.association.count} | {free} | {cost} |")
        lines += ["", "The timeline `iteration` steps through the solver."]
    return "\n".join(lines)

"""Make the HTML page of the map of a site. The page shows the sessions, the objects, and the outcome of each object."""

from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

from objslam.core.object_map import FATES, Life, ObjectMap
from objslam.core.validity import is_date
from objslam.io.atomic_files import write_file
from objslam.io.results.files import PICTURE, REPORT
from objslam.io.results.read import load_map, load_summary
from objslam.output.plot.changes_plot import outcome_colour, outcome_of
from objslam.output.plot.style import captions
from objslam.output.report.render import render
from objslam.output.report.scene import hexadecimal, scene_data


def write_site_report(out: Path) -> Path:
    """Write report.html into the folder `out` of a site, and return its path. Raises OutputError if its map is invalid."""
    objects, summary = load_map(out), load_summary(out)
    every = ObjectMap((*objects, *objects.gone))
    colours = [outcome_colour(outcome_of(o)) for o in every]  # As in the picture of the site.
    number = Counter(o.life.state for o in every if o.life is not None)
    picture = out / PICTURE
    there = colours[: len(objects)]
    page = render(
        "site.html.jinja",
        scene=scene_data(objects, None, None, None, summary.get("up", "z"), there) if len(objects) else None,
        folder=out.resolve().name,
        frame=objects.frame,
        picture=picture.read_bytes() if picture.is_file() else None,
        states=[(state, number[state], hexadecimal(outcome_colour(state))) for state in FATES if number[state]],
        sessions=summary.get("sessions", []),
        warnings=summary.get("warnings", []),
        rows=[
            {"object": o, "name": name, "colour": hexadecimal(colour), "updated": _date(o.life)}
            for o, name, colour in zip(every, captions(every), colours, strict=True)
        ],
    )
    write_file(out / REPORT, page.encode("utf-8", errors="replace"))
    return out / REPORT


def _date(life: Life | None) -> str:
    """Return the time of the last update of an object as text, a date or a stamp in s. It is "" if `life` is None."""
    if life is None:
        return ""
    return (
        f"{datetime.fromtimestamp(life.updated, UTC):%Y-%m-%d %H:%M}" if is_date(life.updated) else f"{life.updated:.1f} s"
    )

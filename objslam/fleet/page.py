"""The page fleet.html. It shows the sites, the failures, the drift of each robot's calibration, and links to the results.

The page needs no network. It escapes texts from logs, because anybody may have chosen the names in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import resources
from urllib.parse import quote

from objslam import __version__
from objslam.errors import printable
from objslam.fleet.drift import drifts
from objslam.fleet.driver import FleetResult, Mapped
from objslam.fleet.record import result_name
from objslam.fleet.tasks.site_task import SITES, folder_of
from objslam.io.results.files import OBJECTS, PICTURE, REPORT, SUMMARY

PAGE = "fleet.html"
"""The name of the page in the store."""
_FAILURES = 500
"""The maximum number of failures on the page. A larger number makes the page longer. failed.parquet has all failures."""
_SESSIONS = 1000
"""The maximum number of sessions on the page. Sessions with the verdict bad come first, then check, then good. Among
sessions with the same verdict, the newest comes first. A larger number makes the page longer. sessions.parquet has all
sessions."""
_WIDTH, _HEIGHT = 100.0, 36.0  # The size of a curve, in units of its drawing.


def fleet_page(found: FleetResult, *, price: float) -> bytes:
    """Return the content of the page of a fleet. price: the price of one hour of one core, NaN if unknown."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("objslam.fleet", ""),
        autoescape=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    of_site: dict[str, list[Mapped]] = {}
    for one in found.mapped:
        of_site.setdefault(one.place.site, []).append(one)
    source, curves = resources.files("objslam.output.report"), drifts(found.mapped)
    hours = sum(one.seconds for one in found.mapped) / 3600
    page = environment.get_template("page.html.jinja").render(
        style=(source / "page.css").read_text(encoding="utf-8"),
        script=(source / "page.js").read_text(encoding="utf-8"),
        version=__version__,
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        found=found,
        spent=duration(hours),
        robots=any(one.place.robot for one in found.mapped),
        cost=hours * price,
        sites=[(one, f"{SITES}/{quote(folder_of(one.site))}", _told(of_site[one.site])) for one in found.sites],
        failures=found.failures[:_FAILURES],
        sessions=[(one, _link(one)) for one in _chosen(found.mapped)],
        curves=[(one, *one.curve(_WIDTH, _HEIGHT)) for one in curves],
        picture=PICTURE,
        objects=OBJECTS,
    )
    return page.encode("utf-8", errors="replace")


def duration(hours: float) -> str:
    """Return a duration as text, in s, min or h, such as 15 s, 4.2 min or 31.50 h. hours: the duration, h."""
    if hours >= 1:
        return f"{hours:.2f} h"
    return f"{60 * hours:.1f} min" if hours >= 1 / 60 else f"{3600 * hours:.0f} s"


def _told(mapped: Sequence[Mapped]) -> dict[str, object]:
    """Return one site's values in the table of sites, by column. They come from the sessions of the site in this run."""
    days = sorted({one.day for one in mapped})
    return {
        "robots": len({one.place.robot for one in mapped} - {""}),
        "days": days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}",
        "new": sum(one.new for one in mapped),
        "bad": sum(one.verdict == "bad" for one in mapped),
    }


def _chosen(mapped: Sequence[Mapped]) -> list[Mapped]:
    """Return the sessions that the page lists. Their number and order are those of `_SESSIONS`."""
    return sorted(mapped, key=lambda one: ("bad", "check", "good").index(one.verdict) * 1e12 - one.begin)[:_SESSIONS]


def _link(one: Mapped) -> str:
    return f"{result_name(one.key)}/{REPORT if one.report else SUMMARY}"

"""fleet.html: the sites, the failures, the drift of each robot's calibration, and links to the results.

The page needs no network. Texts from logs are escaped, because strangers chose the names in them.
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
"""The most failures on the page. failed.parquet has all of them."""
_SESSIONS = 1000
"""The most sessions on the page. Bad verdicts come first, then check, then good, each with the newest first.
sessions.parquet has all of them."""
_WIDTH, _HEIGHT = 100.0, 36.0  # The size of a curve, in units of its drawing.


def fleet_page(found: FleetResult, *, price: float) -> bytes:
    """Return the page of a fleet. price: of an hour of one core, NaN if unknown."""
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
    """Return a time in the unit that suits it, such as 15 s, 4.2 min or 31.50 h."""
    if hours >= 1:
        return f"{hours:.2f} h"
    return f"{60 * hours:.1f} min" if hours >= 1 / 60 else f"{3600 * hours:.0f} s"


def _told(mapped: Sequence[Mapped]) -> dict[str, object]:
    """Return a part of a site's row in the table of sites: the columns that its sessions in this run give."""
    days = sorted({one.day for one in mapped})
    return {
        "robots": len({one.place.robot for one in mapped} - {""}),
        "days": days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}",
        "new": sum(one.new for one in mapped),
        "bad": sum(one.verdict == "bad" for one in mapped),
    }


def _chosen(mapped: Sequence[Mapped]) -> list[Mapped]:
    """Return the sessions that the page lists, as `_SESSIONS` says."""
    return sorted(mapped, key=lambda one: ("bad", "check", "good").index(one.verdict) * 1e12 - one.begin)[:_SESSIONS]


def _link(one: Mapped) -> str:
    return f"{result_name(one.key)}/{REPORT if one.report else SUMMARY}"

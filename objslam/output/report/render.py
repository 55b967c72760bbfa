"""Render a template of the report, with its style and its scripts, as one HTML text."""

from __future__ import annotations

import base64
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

from objslam.errors import printable

if TYPE_CHECKING:
    import jinja2

_ROOM = "objslam.output.report"


def render(template: str, **values: Any) -> str:
    """Return the page of a template in this folder. Texts in the values are escaped, because they may contain HTML."""
    source, page = resources.files(_ROOM), _environment().get_template(template)
    return page.render(
        style=(source / "page.css").read_text(encoding="utf-8"),
        script="\n".join((source / name).read_text(encoding="utf-8") for name in ("page.js", "scene.js")),
        **values,
    )


@cache
def _environment() -> jinja2.Environment:
    """Return the environment of the templates. The environment is cached with its compiled templates, because compiling
    takes most of the time of a small report."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(_ROOM, ""),
        autoescape=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode()
    return environment

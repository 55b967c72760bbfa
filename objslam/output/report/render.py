"""Render a template of the report, with its style and its scripts, as one HTML text."""

import base64
from importlib import resources
from typing import Any

from objslam.errors import printable

_ROOM = "objslam.output.report"


def render(template: str, **values: Any) -> str:
    """Return the page of a template in this folder. Texts in the values are escaped, because they may contain HTML."""
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
    source = resources.files(_ROOM)
    return environment.get_template(template).render(
        style=(source / "page.css").read_text(encoding="utf-8"),
        script="\n".join((source / name).read_text(encoding="utf-8") for name in ("page.js", "scene.js")),
        **values,
    )

"""The formats of `objslam export`: each module in this folder declares one as `EXPORT`, and `FORMATS` lists them.

Every start of the command line imports them, so a module imports what is slow (numpy too) inside its functions. What several
formats share is in `output.export`.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from objslam.output.export.export_format import ExportFormat

_DECLARED: list[ExportFormat] = [import_module(f"{__name__}.{module.name}").EXPORT for module in iter_modules(__path__)]

FORMATS = {declared.name: declared for declared in _DECLARED}
"""The formats by name, in the order of their modules' names."""

"""The formats of `objslam export`, with one module for each format. Code that several formats share is in `output.export`.

Every command imports these modules at its start. These modules therefore import slow packages, including numpy, only inside
their functions.
"""

from importlib import import_module
from pkgutil import iter_modules

from objslam.output.export.export_format import ExportFormat

_DECLARED: list[ExportFormat] = [import_module(f"{__name__}.{module.name}").EXPORT for module in iter_modules(__path__)]
FORMATS = {declared.name: declared for declared in _DECLARED}  # The formats by name, in the order of their module names.

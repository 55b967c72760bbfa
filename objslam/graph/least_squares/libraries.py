"""Load the libraries of every solve. Parts of a library that serve other purposes are not loaded."""

import sys
from importlib import import_module
from importlib.util import LazyLoader, find_spec, module_from_spec

_NEEDED = ("gtsam", "scipy.linalg", "scipy.sparse")
"""The libraries of every solve. Together, they take longer to load than a small solve takes."""

_UNUSED = ("numpy.f2py", "numpy.testing", "numpy.ma")
"""Modules that no solve uses, but that scipy loads, because it copies all names of numpy: a compiler of Fortran (0.06 s),
unittest (0.02 s) and masked arrays (0.01 s)."""


def load_libraries() -> None:
    """Load GTSAM and the parts of scipy that a solve needs."""
    import_module("numpy")
    for module in _UNUSED:
        _import_later(module)
    for library in _NEEDED:
        import_module(library)


def _import_later(name: str) -> None:
    """Let a module load at its first use. The parent of the module must be imported already.

    If another library imports the module only to copy its name into another module, the module is not loaded. Nothing
    happens if the module is imported already, or does not exist.
    """
    spec = None if name in sys.modules else find_spec(name)
    if spec is None or spec.loader is None:
        return
    spec.loader = LazyLoader(spec.loader)
    module = module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    parent, _, child = name.rpartition(".")
    setattr(sys.modules[parent], child, module)

"""Postpone the import of a module until somebody uses it."""

import sys
from importlib.util import LazyLoader, find_spec, module_from_spec


def import_later(name: str) -> None:
    """Let a module, such as "numpy.f2py", load at its first use. Its parent must be imported already.

    A module that only copies the names of the parent then does not load it. Nothing happens if the module is imported
    already, or does not exist.
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

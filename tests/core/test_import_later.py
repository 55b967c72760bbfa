"""A module that is postponed loads at its first use."""

import subprocess
import sys


def test_a_postponed_module_loads_at_its_first_use():
    script = """
import sys, numpy
from objslam.core.import_later import import_later

import_later("numpy.f2py")
import scipy.linalg
assert "numpy.f2py.crackfortran" not in sys.modules
assert callable(numpy.f2py.run_main) and "numpy.f2py.crackfortran" in sys.modules
import_later("numpy.no_such_module")
assert "numpy.no_such_module" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", script], check=True)

"""What a solve loads."""

import subprocess
import sys


def test_what_no_solve_uses_is_loaded_only_when_it_is_used():
    script = """
import sys, numpy
from objslam.graph.least_squares.libraries import load_libraries

load_libraries()
assert "scipy.linalg" in sys.modules and not {"numpy.f2py.crackfortran", "unittest"} & set(sys.modules)
assert callable(numpy.f2py.run_main) and "numpy.f2py.crackfortran" in sys.modules
assert callable(numpy.testing.assert_allclose) and "unittest" in sys.modules
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_pipeline_leaves_them_to_its_first_stage():
    script = """
import sys, objslam.mapping.pipeline

assert not {"gtsam", "scipy", "numpy.f2py", "torch", "cv2"} & set(sys.modules)

import objslam.graph.calibration.self_calibration

assert "scipy.stats" not in sys.modules  # Its import takes longer than those of all that a solve needs.
"""
    subprocess.run([sys.executable, "-c", script], check=True)

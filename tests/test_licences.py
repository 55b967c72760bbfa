"""The page of licences names every package that objslam needs to run."""

import ast
import importlib.util
import json
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

TOOL = Path(__file__).resolve().parents[1] / "tools" / "licences.py"
spec = importlib.util.spec_from_file_location("licences", TOOL)
licences = importlib.util.module_from_spec(spec)
sys.modules["licences"] = licences
spec.loader.exec_module(licences)


def test_every_package_is_on_the_page():
    """If this fails, `python tools/licences.py` writes the page again."""
    found = licences.packages(licences.requirements(licences.ROOT / "pyproject.toml"))
    assert {"gtsam", "torch", "numpy", "zstandard"} <= {one.name for one in found}
    listed = set(licences.names_on(licences.PAGE.read_text(encoding="utf-8")))
    direct = {one.name for one in found if "objslam" in one.needed_by}
    assert direct <= listed
    assert {"objslam"} & set(next(one for one in found if one.name == "numpy").needed_by)


def test_the_bill_of_materials_names_them_too():
    found = [licences.Package("numpy", "2.4.6", "BSD-3-Clause", ("objslam",))]
    (component,) = json.loads(licences.bill(found))["components"]
    assert component["purl"] == "pkg:pypi/numpy@2.4.6"
    assert component["licenses"] == [{"license": {"name": "BSD-3-Clause"}}]


def imported(file: Path) -> set[str]:
    """The packages that a module imports, by the first part of their names."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add((node.module or "").partition(".")[0])
    return names


def test_what_objslam_imports_is_what_it_asks_for():
    """Else it works where the tests run, and not where a user installed it. ROS brings rclpy and rosidl_runtime_py.
    pandas is for those who have it."""
    asked = {canonicalize_name(Requirement(line).name) for line in licences.requirements(licences.ROOT / "pyproject.toml")}
    packages = packages_distributions()
    names = set().union(*(imported(file) for file in (licences.ROOT / "objslam").rglob("*.py")))
    foreign = names - set(sys.stdlib_module_names) - {"objslam", "pandas", "rclpy", "rosidl_runtime_py"}
    assert {"numpy", "gtsam", "cv2"} <= foreign
    assert [name for name in sorted(foreign) if not {*map(canonicalize_name, packages.get(name, []))} & asked] == []

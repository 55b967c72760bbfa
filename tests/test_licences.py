"""The page of licences names every package that objslam needs to run."""

import importlib.util
import json
import sys
from pathlib import Path

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

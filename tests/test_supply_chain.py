"""The list of pinned packages: tools/setup.sh installs what it names, and pip checks the hashes."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

from waiting import LIMIT

ROOT = Path(__file__).parents[1]
LIST = (ROOT / "tools" / "constraints.txt").read_text(encoding="utf-8")


def name_of(requirement):
    return re.sub(r"[-_.]+", "-", re.match(r"[A-Za-z0-9._-]+", requirement)[0]).lower()


def pinned():
    """The names of the pinned packages by set."""
    found = {}
    for part in re.split(r"^# set: ", LIST, flags=re.MULTILINE)[1:]:
        which, _, lines = part.partition("\n")
        found[which] = {name_of(line) for line in lines.splitlines() if not line.startswith(" ")}
    return found


def needed(*extras):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    more = project["project"]["optional-dependencies"]
    wanted = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    for extra in extras:
        wanted += more[extra]
    return {name_of(one) for one in wanted} - {"objslam"}


def test_every_package_is_of_one_version_and_has_hashes():
    packages = re.split(r"\n(?=[A-Za-z0-9])", LIST)[1:]
    assert len(packages) > 100
    for package in packages:
        body = re.sub(r"\n# set: .*", "", package)
        first, *lines = body.replace(" \\\n", "\n").strip().splitlines()
        assert re.fullmatch(r"[a-z0-9.-]+==[0-9][^\s;]*( ; .*)?", first), first
        assert lines, f"{first} has no hash"
        assert all(re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}", line) for line in lines), first


def test_each_set_has_what_its_extras_need():
    found = pinned()
    assert list(found) == ["run", "cuda", "dev", "docs"]
    names = [name for names in found.values() for name in names]
    versions = set(re.findall(r"^([a-z0-9.-]+==[^\s;]+)", LIST, flags=re.MULTILINE))
    assert len(versions) == len(set(names))  # A package in two sets, because of a platform, has one version.
    assert needed("open3d", "torch") <= found["run"]
    assert needed("dev", "fleet", "dds", "open3d", "torch") <= found["run"] | found["dev"]
    assert needed("docs") <= set(names)


def test_an_installed_package_has_every_file():
    """setuptools leaves out each file that is not Python, unless a pattern of pyproject.toml names it."""
    package = ROOT / "objslam"
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["package-data"]
    named = {file for pattern in patterns["objslam"] for file in package.glob(pattern)}
    folders = [package, *(link for link in package.rglob("*") if link.is_symlink())]
    found = (file for folder in folders for file in folder.rglob("*") if file.is_file())
    files = {file for file in found if file.suffix not in (".py", ".pyc")}
    assert len(files) > 10
    assert files - named == set()


def test_mypy_and_editors_see_an_editable_install(tmp_path):
    """It is a path. An import hook, the default of setuptools for this layout, is seen by Python alone."""
    for name in ("pyproject.toml", "README.md", "LICENSE", "objslam/__init__.py", "objslam/core/__init__.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    build = "from setuptools.build_meta import build_editable; print(build_editable('.'))"
    done = subprocess.run(
        [sys.executable, "-c", build], cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT, check=True
    )
    with zipfile.ZipFile(tmp_path / done.stdout.split()[-1]) as wheel:
        (path,) = (name for name in wheel.namelist() if name.endswith(".pth"))
        assert Path(wheel.read(path).decode().strip()).samefile(tmp_path)

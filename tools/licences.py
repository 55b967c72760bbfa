"""Write the packages that objslam needs to run, with their versions and licences, as a page and as a bill of materials.

    python tools/licences.py                  # writes docs/licences.md
    python tools/licences.py --sbom sbom.json # also a CycloneDX 1.5 file

All data come from the metadata of the installed packages, and nothing is downloaded. The packages are the dependencies of
objslam and of its extras open3d, torch, dds and fleet in pyproject.toml, and all packages that these need. Run the tool in
an environment with all of them, as `tools/setup.sh dev` makes it. If the metadata name no licence, the page says so.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "licences.md"
_LONGEST = 60
"""The longest licence text, in letters, that is a name and not the text of the licence itself."""
_HEAD = """# Licences

objslam is under the Apache License 2.0 ([LICENSE](../LICENSE)). It does not ship the packages that it needs: pip installs
them. `python tools/licences.py` makes this page from the metadata of what is installed.

| package | version | licence | needed by |
|---|---|---|---|
"""


@dataclass(frozen=True)
class Package:
    """An installed package. needed_by: the packages that name it, sorted; objslam itself for a direct dependency."""

    name: str
    version: str
    licence: str
    needed_by: tuple[str, ...]


def requirements(project: Path) -> list[str]:
    """What pyproject.toml requires to run: its dependencies, and those of the extras that a user may add."""
    data = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    extras = data["optional-dependencies"]
    return [*data["dependencies"], *extras["open3d"], *extras["torch"], *extras["dds"], *extras["fleet"]]


def packages(required: Iterable[str]) -> list[Package]:
    """The installed packages that the requirements need, directly or not, by name. What is not installed is left out."""
    found: dict[str, Distribution] = {}
    needed_by: dict[str, set[str]] = {}
    waiting = [("objslam", text) for text in required]
    while waiting:
        whose, text = waiting.pop()
        requirement = Requirement(text)
        if requirement.marker is not None and not any(
            requirement.marker.evaluate({"extra": extra}) for extra in ("", *requirement.extras)
        ):
            continue
        name = canonicalize_name(requirement.name)
        needed_by.setdefault(name, set()).add(whose)
        if name in found:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            print(f"licences.py: {name} is not installed: left out", file=sys.stderr)
            continue
        waiting += [(name, inner) for inner in found[name].requires or ()]
    return [
        Package(name, one.version.partition("+")[0], licence_of(one), tuple(sorted(needed_by[name])))
        for name, one in sorted(found.items())
    ]


def licence_of(package: Distribution) -> str:
    """The licence that the metadata name: the expression, the classifiers or a short text, in this order."""
    metadata = package.metadata
    expression = metadata.get("License-Expression")
    if expression:
        return str(expression)
    classifiers = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or () if line.startswith("License")]
    named = [name for name in classifiers if name != "OSI Approved"]
    if named:
        return ", ".join(named)
    text = (metadata.get("License") or "").strip()
    return text if text and len(text) <= _LONGEST and "\n" not in text else "not named in the metadata"


def page(found: Iterable[Package]) -> str:
    """The page, as Markdown."""
    return _HEAD + "".join(
        f"| {one.name} | {one.version} | {re.sub(r'[|]', '/', one.licence)} | {', '.join(one.needed_by)} |\n"
        for one in found
    )


def bill(found: Iterable[Package]) -> str:
    """The bill of materials, as CycloneDX 1.5 in JSON."""

    def component(one: Package) -> dict[str, object]:
        return {
            "type": "library",
            "name": one.name,
            "version": one.version,
            "purl": f"pkg:pypi/{one.name}@{one.version}",
            "licenses": [{"license": {"name": one.licence}}],
        }

    components = [component(one) for one in found]
    return json.dumps({"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1, "components": components}, indent=1)


def names_on(text: str) -> Iterator[str]:
    """The packages on the page."""
    return (match[1] for match in re.finditer(r"^\| ([a-z0-9.-]+) \| [0-9]", text, re.MULTILINE))


def main() -> int:
    """Write the page, and the bill of materials if one is wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sbom", type=Path, metavar="FILE", help="also write a CycloneDX file")
    options = parser.parse_args()
    found = packages(requirements(ROOT / "pyproject.toml"))
    PAGE.write_text(page(found), encoding="utf-8")
    print(f"wrote {PAGE}: {len(found)} packages")
    if options.sbom is not None:
        options.sbom.write_text(bill(found) + "\n", encoding="utf-8")
        print(f"wrote {options.sbom}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

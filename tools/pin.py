"""Write the SHA-256 hashes of all files of all pinned versions into tools/constraints.txt.

    python tools/pin.py                # after a change of a version in tools/constraints.txt, or of pyproject.toml
    python tools/pin.py --upgrade      # take the newest version of everything

It asks pypi.org, by uv (`pip install uv`). The file has a part for each set of packages: run, cuda (what the ordinary build
of torch needs on Linux, the CPU build does not), dev, docs. A package is in the first set that needs it, and again in a set
that needs it on more platforms.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_FILE = _ROOT / "tools" / "constraints.txt"
_SETS = {"run": ("open3d", "torch"), "dev": ("dev",), "docs": ("docs",)}
"""The extras of each set of packages."""
_PYTHON = "3.11.7"
"""The oldest Python that the versions must suit. An older one may have no version of some package."""
_CUDA = re.compile(r"(nvidia|cuda)-|triton=")
_CPU_TORCH = {
    "2.13.0": (
        "6746dbcbeb526eb61330b76b41ff1b4eb848951103a892eeb080dfa2b264667b",  # cp311 x86_64
        "84453b69508ec79902f899c5ed9495acb9e2bbe9fda5f1d5d6f19e3c3842e1a7",  # cp311 aarch64
        "4ca4a9394b0c771238a4f73590fdbbc4debad85ed0fa63d026ae1b085da7d6e2",  # cp312 x86_64
        "6f307c2c32d764ffc6ff6893b801fad6d4752f3e67966cb8abf1843427c02604",  # cp312 aarch64
        "3fbf9c9d1f3c10c2d59d04aca426dee9ccc6ceb32d255c61e93acc3b4f75fae6",  # cp313 x86_64
        "0b8f7d0423027ae8b90c7977c627f3379f325363a08224dffad9b4b2d684a83d",  # cp313 aarch64
        "d20fa53ee744502fa4c69818a720b05ca0d37abd055d4f6e66cae155114bc691",  # cp314 x86_64
        "ca021f9eb2f8345c83fa03e3a04587308afb8df71bd472670b3ece00df58621c",  # cp314 aarch64
    )
}
"""The hashes of the CPU builds for Linux by version. download.pytorch.org/whl/cpu/torch lists them, pypi.org does not."""
_HEAD = """\
# Every version that was tested, dependencies of dependencies included, with the hashes of all its files. tools/pin.py writes
# this file, and tools/setup.sh installs nothing else.
"""


def pins(text: str) -> list[str]:
    """The requirements `name==version` in a file of requirements, without markers and hashes."""
    return re.findall(r"^[A-Za-z0-9._-]+==[^\s;\\]+", text, re.MULTILINE)


def entries(text: str) -> dict[str, str]:
    """The entries of a file of requirements by `name==version`, each with its marker and its hashes."""
    parts = [part for part in re.split(r"\n(?=\S)", text.strip()) if not part.startswith("#")]
    return {pins(part)[0]: part for part in parts}


def compile_set(extras: tuple[str, ...], held: Path) -> dict[str, str]:
    """The entries that these extras of objslam need, on all platforms. held: a file of versions to keep."""
    command = ["uv", "pip", "compile", "--quiet", "--universal", "--python-version", _PYTHON, "--generate-hashes"]
    command += ["--no-annotate", "--no-header", "--constraint", str(held), *(f"--extra={one}" for one in extras)]
    found = subprocess.run([*command, str(_ROOT / "pyproject.toml")], capture_output=True, text=True, check=False)
    if found.returncode:
        sys.exit(f"pin: uv found no versions: {found.stderr.strip()}")
    return entries(found.stdout)


def with_cpu_builds(name: str, entry: str) -> str:
    """The entry of torch with the hashes of its CPU builds. Other entries stay."""
    if not name.startswith("torch=="):
        return entry
    version = name.partition("==")[2]
    if version not in _CPU_TORCH:
        sys.exit(f"pin: no hashes of the CPU builds of torch {version}; add them to _CPU_TORCH in {__file__}")
    return " \\\n".join([entry, *(f"    --hash=sha256:{one}" for one in _CPU_TORCH[version])])


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--upgrade", action="store_true", help="take the newest versions, not those of the file")
    options = parser.parse_args()
    written: dict[str, str] = {}
    parts = {name: list[str]() for name in ("run", "cuda", "dev", "docs")}
    with tempfile.TemporaryDirectory() as folder:
        held = Path(folder) / "held.txt"
        held.write_text("" if options.upgrade else "\n".join(pins(_FILE.read_text(encoding="utf-8"))), encoding="utf-8")
        for which, extras in _SETS.items():
            found = compile_set(extras, held)
            for name in found.keys() - written.keys():
                if "--hash=sha256:" not in found[name]:
                    sys.exit(f"pin: no hash of {name}")
            for name, entry in found.items():
                marker = entry.splitlines()[0].partition(";")[2].rstrip(" \\")
                if written.get(name) not in ("", marker):  # A set may need a package where the sets before it do not.
                    parts["cuda" if _CUDA.match(name) else which].append(with_cpu_builds(name, entry))
                    written[name] = marker
    sections = ("\n".join([f"# set: {which}", *lines]) for which, lines in parts.items())
    _FILE.write_text(_HEAD + "\n".join(sections) + "\n", encoding="utf-8")
    print(f"{len(written)} packages with {sum(line.count('--hash') for part in parts.values() for line in part)} hashes")


if __name__ == "__main__":
    main()

"""The files of examples/fleet can be read, and they run commands that exist."""

import re
import shlex
from pathlib import Path

import pytest
import yaml
from typer.main import get_command

from objslam.cli.commands import build_app

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "fleet"
FILES = sorted(FOLDER.iterdir())


def options():
    """The options of `objslam fleet`."""
    return {flag for one in get_command(build_app()).commands["fleet"].params for flag in one.opts}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_every_command_has_the_options_that_are_shown(file):
    shown = [shlex.split(line) for line in re.findall(r"objslam fleet (.*)", file.read_text(encoding="utf-8"))]
    used = {word for line in shown for word in line if word.startswith("-")}
    assert used <= options()
    assert used or file.name == "Dockerfile"


def test_the_services_and_the_job_are_what_the_page_says():
    compose = yaml.safe_load((FOLDER / "compose.yaml").read_text(encoding="utf-8"))["services"]
    assert set(compose) == {"store", "head", "worker"}
    assert compose["worker"]["deploy"]["replicas"] == 2
    assert (FOLDER / "../.." / compose["head"]["build"]["dockerfile"]).is_file()
    job = yaml.safe_load((FOLDER / "rayjob.yaml").read_text(encoding="utf-8"))
    assert (job["kind"], job["spec"]["entrypoint"].split()[:2]) == ("RayJob", ["objslam", "fleet"])


def test_the_image_has_all_that_the_package_is_built_of():
    """A link that is copied without its target leads nowhere in the image."""
    root = FOLDER.parents[1]
    copied = re.findall(r"^COPY (.*) \S+$", (FOLDER / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    sources = [root / name for line in copied for name in line.split()]
    assert all(source.exists() for source in sources)
    links = [path for path in (root / "objslam").rglob("*") if path.is_symlink()]
    assert links
    assert all(any(link.resolve().is_relative_to(source) for source in sources) for link in links)

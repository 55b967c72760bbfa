"""What a class of options declares is what a command takes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from objslam.cli.options import with_options
from objslam.sources.options import Option, names, unused


@dataclass(frozen=True)
class Shared:
    topics: Annotated[tuple[str, ...], Option("--topic", "Which topic.", metavar="ROLE=/NAME")] = ()
    inside: int = 0


@dataclass(frozen=True)
class Toy(Shared):
    stride: Annotated[int, Option("--stride", "Toy: every Nth frame.")] = 1
    file: Annotated[Path | None, Option("--file", "Toy: a file.")] = None
    with_range: Annotated[bool, Option("--without-range", "Toy: bearings only.")] = True
    fast: Annotated[bool, Option("--fast", "Toy: at once.")] = False
    rectified: Annotated[bool | None, Option("--rectified/--raw", "Toy: which pixels.")] = None


def call(*arguments: str) -> tuple[str, Toy | None]:
    """What a command prints, and the options that reach it."""
    seen: list[Toy] = []
    app = typer.Typer()

    @app.command()
    @with_options
    def command(source: str, number: int = 5, *, options: Toy, last: bool = False) -> None:
        """Do it."""
        assert (source, number, last) == ("here", 5, True)
        seen.append(options)

    done = CliRunner().invoke(app, arguments, env={"COLUMNS": "200"}, catch_exceptions=False)
    return done.output, seen[0] if seen else None


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ((), Toy()),
        (
            ("--stride", "3", "--file", "a.txt", "--without-range", "--fast", "--raw"),
            Toy((), 0, 3, Path("a.txt"), False, True, False),
        ),
        (("--topic", "a=/b", "--rectified", "--topic", "c=/d"), Toy(("a=/b", "c=/d"), rectified=True)),
    ],
)
def test_flags_become_fields(arguments, options):
    assert call("here", "--last", *arguments)[1] == options


def test_help_says_what_was_declared():
    text, _ = call("--help")
    places = [text.index(word) for word in ("--number", "--topic", "--stride", "--without-range", "--raw", "--last")]
    assert places == sorted(places)
    for words in ("ROLE=/NAME", "Which topic.", "Toy: every Nth frame.", "Do it."):
        assert words in text
    assert "--inside" not in text
    assert "--options" not in text


def test_options_that_nobody_takes_have_the_names_of_their_flags():
    options = Toy(topics=("a=/b",), inside=2, stride=1, with_range=False, rectified=False)
    assert unused(options, Toy, names(None)) == ["--topic", "--inside", "--without-range", "--rectified"]
    assert unused(options, Toy, names(Shared)) == ["--without-range", "--rectified"]
    assert unused(options, Shared, names(Shared)) == []

"""What a command of objslam said and how it ended. The fixture `objslam` of conftest.py runs one."""

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

import pytest


class Call(NamedTuple):
    code: int
    out: str
    err: str

    def says(self, *words: str) -> None:
        """One line on stderr with all the words, no traceback."""
        assert len(self.err.strip().splitlines()) == 1, self.err
        self.says_somewhere(*words)

    def says_somewhere(self, *words: str) -> None:
        assert "Traceback" not in self.err
        assert "internal error" not in self.err
        assert "Warning" not in self.err
        for word in words:
            assert word in self.err, self.err


def call(*arguments: object) -> Call:
    """Run a command in this process. For fixtures that several tests share: a test itself takes the fixture `objslam`."""
    from objslam.cli import main

    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["objslam", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    assert isinstance(ended.value.code, int)
    return Call(ended.value.code, out.getvalue(), err.getvalue())

"""What a command of objslam said and how it ended. The fixture `objslam` of conftest.py runs one."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Call:
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

"""DDS domains for tests. Participants of one domain hear each other, so no two tests may be in one at the same time."""

import fcntl
import tempfile
from pathlib import Path
from typing import IO

_DOMAINS = range(10, 100)
"""The domains of tests. The ports of a domain begin at 7400 + 250 times its number. Those of these domains lie below the
ports that Linux gives to other connections, which begin at 32768."""
_kept: list[IO[str]] = []


def own_domain() -> int:
    """Return a domain that no other test of this computer has had while both processes live.

    The lock of a file keeps it until this process ends, because participants may outlive their test.
    """
    for number in _DOMAINS:
        try:
            file = (Path(tempfile.gettempdir()) / f"objslam-test-domain-{number}.lock").open("w")
        except OSError:  # The file of another user.
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        _kept.append(file)
        return number
    raise AssertionError("tests that run on this computer have all DDS domains")

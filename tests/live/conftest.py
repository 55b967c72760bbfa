"""What holds for all tests of live sessions."""

import pytest
from waiting import LIMIT


@pytest.fixture(autouse=True, scope="module")
def patience():
    """Snapshots are whole, and are waited for, however slow the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("objslam.live.session.session._PATIENCE", LIMIT)
        patch.setattr("objslam.live.session.snapshots._BUDGET", LIMIT)
        yield

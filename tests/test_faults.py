"""A few of the faults of tools/bench_faults.py: kills and errors of the disk, spread over the calls of some commands."""

from pathlib import Path

import pytest
from fault_cases import Case, check, faults, make_cases

COUNTS = {"convert --overwrite": (9, 4), "export csv": (3, 4), "run, older result": (5, 4), "live stdin": (2, 2)}
"""How many kills and how many errors each command gets here."""


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Case]:
    return {case.name: case for case in make_cases(tmp_path_factory.mktemp("faults"), tuple(COUNTS))}


@pytest.mark.forks
@pytest.mark.parametrize("name", COUNTS)
def test_a_fault_leaves_a_whole_result_or_none_and_the_next_start_cleans_up(
    cases: dict[str, Case], name: str, tmp_path: Path
) -> None:
    case, (kills, errors) = cases[name], COUNTS[name]
    assert case.steps > 5
    struck = [*faults(case, kills, errors=False), *faults(case, errors, errors=True)]
    states = {check(case, tmp_path / "work", fault, number) for number, fault in enumerate(struck)}
    assert states <= {"old", "new", "none"}
    assert len(states) > 1 or case.live

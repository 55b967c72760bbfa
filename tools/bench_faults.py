"""Check what each command leaves on the disk if its process is killed, or if the disk fails or is full.

    python tools/bench_faults.py                                # 1,000 kills and 300 errors of the disk, half an hour
    python tools/bench_faults.py --kills 100 --errors 50 --cases convert export
    python tools/bench_faults.py --keep rows.jsonl              # a run that was ended goes on where it ended
    python tools/bench_faults.py --special                      # small disks, signals, closed pipes, limits

A fault happens at a call that changes the disk: a write (only a part is written), a sync, a rename, a deletion, or a new
file or folder. tests/faults.py puts it into a forked process, because a new interpreter would take longer. After each fault,
the folder must have the old result, the new result or none (tests/fault_cases.py). The next start of the command must work,
and must remove what the fault left. The faults of a case are spread evenly over its calls. The last rows are sums. The exit
code is 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass
from itertools import accumulate, pairwise
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from fault_cases import Case, check, faults, make_cases
from fault_special import SPECIAL


def cpu() -> float:
    """CPU seconds of this process and of the children that ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@dataclass(frozen=True)
class Row:
    """What the faults of one kind did to a case. states: the number of faults by the state that they left. cpu: s."""

    case: str
    kind: str
    calls: int
    states: dict[str, int]
    cpu: float
    wrong: tuple[str, ...] = ()

    def __str__(self) -> str:
        found = "".join(f"{self.states.get(name, 0):7d}" for name in ("old", "new", "none", "wrong"))
        return f"{self.case:29s}{self.kind:8s}{self.calls:6d}{sum(self.states.values()):8d}{found}{self.cpu:9.1f}"


def measure(case: Case, folder: Path, count: int, kind: str) -> Row:
    """Let faults strike a case."""
    wrong, states, begin = [], Counter[str](), cpu()
    for number, fault in enumerate(faults(case, count, kind == "errors")):
        try:
            states[check(case, folder, fault, number)] += 1
        except AssertionError as error:
            states["wrong"] += 1
            wrong.append(f"{case.name}, {fault}: {str(error)[:600]}")
    return Row(case.name, kind, case.steps, dict(states), cpu() - begin, tuple(wrong))


def measure_all(place: Path, options: argparse.Namespace) -> list[str]:
    """Print a row for each case and kind of fault, then their sums, and return what was wrong.

    The rows in the file --keep are not measured again.
    """
    kept = [Row(**json.loads(line)) for line in options.keep.read_text().splitlines()] if options.keep.exists() else []
    rows = {(row.case, row.kind): row for row in kept}
    chosen = make_cases(place, options.cases, frames=options.frames)
    print("case                         fault    calls  faults    old    new   none  wrong    CPU s")
    for total, kind in ((options.kills, "kills"), (options.errors, "errors")):
        for case, count in zip(chosen, shares(chosen, total) if total else (), strict=False):
            if (case.name, kind) not in rows:
                rows[case.name, kind] = measure(case, place / "work", count, kind)
                with options.keep.open("a") as file:
                    print(json.dumps(asdict(rows[case.name, kind])), file=file)
            print(rows[case.name, kind], flush=True)
    for kind in ("kills", "errors"):
        mine = [row for row in rows.values() if row.kind == kind]
        states = sum((Counter(row.states) for row in mine), Counter[str]())
        print(Row(f"all {len(mine)} cases", kind, sum(row.calls for row in mine), states, sum(row.cpu for row in mine)))
    return [line for row in rows.values() for line in row.wrong]


def shares(cases: list[Case], total: int) -> list[int]:
    """Return how many of the faults each case gets, `total` in all: in proportion to the square root of its calls."""
    ends = list(accumulate(case.steps**0.5 for case in cases))
    return [round(total * end / ends[-1]) - round(total * begin / ends[-1]) for begin, end in pairwise([0.0, *ends])]


def main() -> int:
    """Print the table, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--errors", type=int, default=300)
    parser.add_argument("--frames", type=int, default=20, help="the number of frames in the log")
    parser.add_argument("--cases", nargs="*", default=[], help="only the cases whose names begin with one of these words")
    parser.add_argument("--keep", type=Path, help="a file that gets each row, and whose rows are not measured again")
    parser.add_argument(
        "--special", nargs="*", metavar="NAME", help=f"instead of the cases, all or the named ones of: {', '.join(SPECIAL)}"
    )
    options = parser.parse_args()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        if options.special is not None:
            for title, special in SPECIAL.items():
                if not options.special or title in options.special:
                    (place / title).mkdir()
                    lines = special(place / title)
                    print(f"{title:29s}{'wrong' if lines else 'right'}", flush=True)
                    wrong += [f"{title}: {line}" for line in lines]
        else:
            options.keep = options.keep or place / "rows.jsonl"
            wrong = measure_all(place, options)
    for line in wrong:
        print(f"wrong: {line}")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())

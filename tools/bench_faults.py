"""Check what each command leaves on the disk if its process is killed, or if the disk fails or is full.

    python tools/bench_faults.py                                # 1,000 kills and 300 errors of the disk, half an hour
    python tools/bench_faults.py --kills 100 --errors 50 --cases convert export
    python tools/bench_faults.py --special                      # small disks, signals, closed pipes, limits

A fault happens at a call that changes the disk: a write (only a part is written), a sync, a rename, a deletion, or a new
file or folder. tests/faults.py puts it into a forked process, because a new interpreter would take longer. After each fault,
the folder must have the old result, the new result or none (tests/fault_cases.py). The next start of the command must work,
and must remove what the fault left. The faults of a case are spread evenly over its calls. The exit code is 1 if anything is
wrong.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import Counter
from itertools import accumulate, pairwise
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from fault_cases import Case, check, faults, make_cases
from fault_special import SPECIAL


def cpu() -> float:
    """CPU seconds of this process and of the children that ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def measure(case: Case, folder: Path, count: int, errors: bool) -> list[str]:
    """Let faults strike a case, print a row, and return what was wrong."""
    wrong, states, begin = [], Counter[str](), cpu()
    for number, fault in enumerate(faults(case, count, errors)):
        try:
            states[check(case, folder, fault, number)] += 1
        except AssertionError as error:
            states["wrong"] += 1
            wrong.append(f"{case.name}, {fault}: {str(error)[:600]}")
    kind = "errors" if errors else "kills"
    found = "".join(f"{states[name]:7d}" for name in ("old", "new", "none", "wrong"))
    print(f"{case.name:29s}{kind:8s}{case.steps:6d}{count:8d}{found}{cpu() - begin:9.1f}", flush=True)
    return wrong


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
            chosen = make_cases(place, options.cases, frames=options.frames)
            print("case                         fault    calls  faults    old    new   none  wrong    CPU s")
            for total, errors in ((options.kills, False), (options.errors, True)):
                for case, count in zip(chosen, shares(chosen, total) if total else (), strict=False):
                    wrong += measure(case, place / "work", count, errors)
    for line in wrong:
        print(f"wrong: {line}")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())

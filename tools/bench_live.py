"""Whether the map while the robot drives keeps up, agrees with offline, and survives what robots do.

    python tools/bench_live.py [--parts realtime same overload kill disorder memory] [--minutes 60]

realtime: 200 Hz odometry and 20 Hz frames of 5 boxes, pushed at that pace until there are 10,000 keyframes (9 minutes).
same: the final map, and the last one before the end, against offline `run --mode joint` on the same data: ten simulated
drives, and UTIAS MRCLAM 6 robots 1, 3, 5 from the folder in OBJSLAM_DATA. overload: frames five times as fast as they can be
worked in. kill: twenty sessions killed with signal 9 at random moments and resumed. disorder: late, repeated and swapped
messages, a clock that jumps, odometry that starts anew. memory: an hour at 200 Hz and 10 Hz, as fast as possible.
"""

from __future__ import annotations

import argparse

from live_parts.agreement import same
from live_parts.faults import disorder, kill
from live_parts.pace import memory, overload, realtime

from objslam.live.session import low_latency

ALONE = {"same": same, "overload": overload, "kill": kill, "disorder": disorder}
"""The parts that take no option."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("realtime", *ALONE, "memory")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--classes", type=int, default=10)
    arguments = parser.parse_args()
    low_latency.configure()
    for part in arguments.parts:
        if part == "realtime":
            realtime(arguments.keyframes, arguments.classes)
        elif part == "memory":
            memory(arguments.minutes)
        else:
            ALONE[part]()


if __name__ == "__main__":
    main()

"""Check that a session keeps up with the robot, agrees with an offline run, and survives kills and disordered messages.

    python tools/bench_live.py [--parts realtime same localised rare unnamed overload kill disorder memory]
        [--minutes 60]

realtime: odometry at 200 Hz and frames of 5 boxes at 20 Hz, pushed in real time until there are 10,000 keyframes (9
minutes). Its second line has the times without the other processes of the machine, from CPU times. same: the last map before
the end and the final map, compared with offline `run --mode joint` on the same data. The data are ten simulated drives, and
robots 1, 3 and 5 of UTIAS MRCLAM 6 from the folder in OBJSLAM_DATA. localised: the last snapshots of sessions whose
localisation errs for seconds. rare: those of sessions whose detector misses most boxes. unnamed: those of sessions whose
things have one label. overload: five times as many frames as the session can map. kill: twenty sessions that are killed with
signal 9 at random moments, and resumed. disorder: late, repeated and swapped messages, a clock that jumps, and odometry that
restarts. memory: one hour of odometry at 200 Hz and frames at 10 Hz (--minutes), pushed as fast as possible.
"""

from __future__ import annotations

import argparse

from live_parts.agreement import same
from live_parts.faults import disorder, kill
from live_parts.pace import memory, overload, realtime
from live_parts.snapshots import localised, rare, unnamed

from objslam.live.session import low_latency

ALONE = {
    **{"same": same, "localised": localised, "rare": rare, "unnamed": unnamed},
    **{"overload": overload, "kill": kill, "disorder": disorder},
}
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

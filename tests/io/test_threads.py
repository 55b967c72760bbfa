"""Threads start, or are refused, with any little memory."""

import subprocess
import sys

import pytest
from waiting import LIMIT

SCRIPT = """
import os, resource, signal, sys, threading
from objslam.io.threads import start_thread

def child(more):
    signal.alarm(int(sys.argv[1]))  # A start that waits forever ends here.
    pages = int(open("/proc/self/statm").read().split()[0])
    size = pages * resource.getpagesize() + (more << 10)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    thread = threading.Thread(target=int)
    try:
        start_thread(thread)
    except OSError:
        os._exit(1)
    thread.join()
    os._exit(0)

for more in (0, *range(8180, 8240, 4), 16 << 10, 17 << 10, 64 << 10):
    number = os.fork() or child(more)
    print(os.waitstatus_to_exitcode(os.waitpid(number, 0)[1]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space")
def test_a_thread_with_too_little_memory_is_refused() -> None:
    words = [sys.executable, "-c", SCRIPT, f"{LIMIT / 10:.0f}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, check=True)
    codes = [int(line) for line in done.stdout.split()]
    assert set(codes) == {0, 1}  # Neither an error of another kind, nor the signal.
    assert codes == sorted(codes, reverse=True)

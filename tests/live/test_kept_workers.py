"""The processes that the tests keep for later sessions: only idle ones, and none where a test asks for its own."""

import os
import signal
from functools import partial
from types import SimpleNamespace

import pytest
from kept_workers import kept_workers
from waiting import wait_for

from objslam.live.worker import Worker

WHO = SimpleNamespace(solve=os.getpid)


def asked(worker: Worker, request=WHO) -> Worker:
    worker.ask(request)
    return worker


def test_an_idle_process_goes_to_the_next_worker(own_processes):
    with kept_workers():
        first, second = Worker(), Worker()
        number = asked(first).result()
        first.close()
        assert not first.busy
        assert asked(second).result() == number
        other = asked(first).result()  # The process has another worker now.
        assert other not in (number, os.getpid(), None)
        first.close()
        second.close()
    for one in (number, other):
        with pytest.raises(ProcessLookupError):
            os.kill(one, 0)


@pytest.mark.parametrize(("ends", "solve"), [(False, signal.pause), (True, partial(int, "no"))])
def test_a_process_that_works_or_failed_is_not_kept(own_processes, ends, solve):
    with kept_workers():
        worker = Worker()
        number = asked(worker).result()
        asked(worker, SimpleNamespace(solve=solve))
        if ends:
            wait_for(lambda: worker.done)
        worker.close()
        with pytest.raises(ProcessLookupError):
            os.kill(number, 0)


def test_a_test_may_have_processes_of_its_own(own_processes):
    numbers = []
    for _ in range(2):
        worker = asked(Worker())
        numbers.append(worker.result())
        worker.close()
        with pytest.raises(ProcessLookupError):
            os.kill(numbers[-1], 0)
    assert numbers[0] != numbers[1]

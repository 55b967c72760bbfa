"""The processes of a fleet: tasks, limits, and processes that die."""

import pytest
from fleet import works

from objslam.errors import LogError
from objslam.fleet.engines.local_engine import local_engine
from objslam.fleet.engines.worker import LimitError, Limits, LostError, Worker

WORK = f"{works.__name__}:"


@pytest.fixture
def worker():
    one = Worker()
    yield one
    one.close()


def test_a_process_does_one_task_after_another(worker):
    first, _ = worker.call(WORK + "process", 1, Limits())
    again, argument = worker.call(WORK + "process", 2, Limits())
    assert first == again  # One process did both tasks, so it imports a library once.
    assert argument == 2


def test_a_failure_of_a_task_is_raised_here_and_the_process_goes_on(worker):
    before, _ = worker.call(WORK + "process", 1, Limits())
    with pytest.raises(LogError, match=r"a/log: no camera \(add one\)"):
        worker.call(WORK + "refuse", "a/log", Limits())
    assert worker.call(WORK + "process", 1, Limits())[0] == before


def test_a_task_whose_process_was_killed_begins_again(worker, tmp_path):
    assert worker.call(WORK + "die", str(tmp_path / "mark"), Limits()) == "alive"
    with pytest.raises(LostError, match="SIGSEGV"):
        worker.call(WORK + "crash", None, Limits(retries=1))


def test_a_task_beyond_its_limits_is_ended(worker):
    with pytest.raises(LimitError, match=r"more than the 1\.0 GB"):
        worker.call(WORK + "fill", 3 * 10**9, Limits(memory=10**9))
    assert worker.call(WORK + "fill", 10**6, Limits(memory=10**9)) == 10**6
    with pytest.raises(LimitError, match=r"more than the 0\.2 s"):
        worker.call(WORK + "hang", None, Limits(seconds=0.2))


def test_a_closed_worker_leaves_no_process_behind(worker):
    idle, _ = worker.call(WORK + "process", 1, Limits())
    worker.close()
    with pytest.raises(ProcessLookupError):
        works.os.kill(idle, 0)


def test_an_engine_yields_every_answer_and_names_each_failure():
    engine = local_engine(2, Limits(memory=10**9, retries=0))
    answers = list(engine(WORK + "fill", [10, 3 * 10**9, 20, 30]))
    assert sorted(one.value for one in answers if not one.kind) == [10, 20, 30]
    assert [(one.argument, one.kind) for one in answers if one.kind] == [(3 * 10**9, "memory")]
    assert [one.kind for one in engine(WORK + "crash", [None])] == ["lost"]
    assert [one.kind for one in engine(WORK + "refuse", ["x"])] == ["error"]


def test_an_engine_that_is_left_ends_its_processes():
    engine = local_engine(2, Limits())
    answers = engine(WORK + "process", range(100))
    first, _ = next(answers).value
    answers.close()
    with pytest.raises(ProcessLookupError):
        works.os.kill(first, 0)


def test_the_processes_of_an_engine_go_on_with_its_next_call_and_end_with_it():
    engine = local_engine(1, Limits())
    (first,), (again,) = (list(engine(WORK + "process", [k])) for k in range(2))
    assert (first.value[0], 1) == again.value
    del engine
    with pytest.raises(ProcessLookupError):
        works.os.kill(first.value[0], 0)


def test_an_engine_takes_arguments_as_it_needs_them():
    taken = []

    def arguments():
        for k in range(1000):
            taken.append(k)
            yield k

    answers = local_engine(1, Limits())(WORK + "process", arguments())
    next(answers)
    assert len(taken) < 10
    answers.close()


def test_an_answer_tells_how_many_tasks_run():
    counts = [one.running for one in local_engine(2, Limits())(WORK + "process", range(6))]
    assert max(counts) == 2
    assert counts[-1] == 0

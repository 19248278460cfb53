"""`run_all` does every piece once, whatever the number of threads, and leaves the process as it was."""

import os
import threading
import time

import pytest
import torch

from kgs.backends.cpu.threads import over
from kgs.raster.threads import run_all

CPU = torch.device("cpu")


@pytest.fixture(params=[1, 2, 3])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def collect(items, device=CPU, work=lambda item: item):
    """Results by piece, and for each worker the thread it lived in."""
    results, workers = [None] * len(items), []

    def make_worker():
        workers.append(threading.current_thread().name)
        buffer = torch.zeros(())

        def worker(index):
            buffer.add_(1)
            assert results[index] is None, "no piece twice"
            results[index] = work(items[index])

        return worker

    run_all(range(len(items)), make_worker, device)
    return results, workers


def in_a_new_thread(function):
    answers = []
    thread = threading.Thread(target=lambda: answers.append(function()))
    thread.start()
    thread.join()
    return answers[0]


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_every_piece_is_done_once(threads, count):
    results, workers = collect(list(range(count)))
    assert results == list(range(count))
    assert len(workers) <= max(threads, 1)


def test_results_do_not_depend_on_the_number_of_threads():
    generator = torch.Generator().manual_seed(0)
    pieces = [torch.randn(200, 200, generator=generator) for _ in range(6)]
    before, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(torch.stack(collect(pieces, work=lambda x: (x @ x).exp().sum())[0]))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


@pytest.mark.parametrize("count", [0, 1, 7, 50])
def test_kernels_get_every_range_once_and_an_error_comes_when_nothing_runs(threads, count):
    found, running = [], set()

    def kernel(begin, end, fails):
        running.add(begin)
        found.extend(range(begin, end))
        running.discard(begin)
        if fails and begin == 0:
            raise ZeroDivisionError

    over(threads, count, kernel, False, pieces=10)
    assert sorted(found) == list(range(count))
    if count:
        with pytest.raises(ZeroDivisionError):
            over(threads, count, kernel, True, pieces=10)
        assert not running
        assert sorted(found) == sorted(2 * list(range(count)))


@pytest.mark.parametrize("count", [1, 20])
def test_each_piece_has_one_thread_and_no_gradient(threads, count):
    def state(_):
        return torch.get_num_threads(), torch.is_grad_enabled()

    with torch.enable_grad():
        results, _ = collect(list(range(count)), work=state)
        assert torch.is_grad_enabled()
    assert set(results) == {(1, False)}


def test_the_number_of_threads_stays_in_the_caller_and_for_threads_born_later(threads):
    collect(list(range(10)))
    assert torch.get_num_threads() == threads
    assert in_a_new_thread(torch.get_num_threads) == threads
    collect(list(range(10)))
    assert torch.get_num_threads() == threads
    assert in_a_new_thread(torch.get_num_threads) == threads


def test_there_are_no_more_workers_than_asked_for(threads):
    started = []

    def make_worker():
        started.append(1)
        return lambda item: time.sleep(0.001)

    run_all(range(20), make_worker, CPU, 1)
    assert len(started) == 1


def test_threads_are_kept_from_call_to_call(threads):
    def count():
        return sum(thread.name.startswith("kgs") for thread in threading.enumerate())

    first = count()
    collect(list(range(20)))
    after_one = count()
    for _ in range(5):
        collect(list(range(20)))
    assert count() == after_one <= first + threads


def test_a_call_from_another_thread(threads):
    assert in_a_new_thread(lambda: collect(list(range(20)))[0]) == list(range(20))


def test_a_call_from_a_piece(threads):
    nested, _ = collect(list(range(6)), work=lambda item: collect([item] * 3)[0])
    assert nested == [[item] * 3 for item in range(6)]


def test_calls_at_the_same_time(threads):
    answers = [None] * 4

    def call(i):
        answers[i] = collect(list(range(30)), work=lambda item: item + 100 * i)[0]

    callers = [threading.Thread(target=call, args=(i,)) for i in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert answers == [[item + 100 * i for item in range(30)] for i in range(4)]
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("culprit", [0, 7, 19])
def test_errors_of_a_piece_reach_the_caller_and_the_next_call_works(threads, culprit):
    def work(item):
        if item == culprit:
            raise KeyError(f"piece {item}")
        return item

    with pytest.raises(KeyError, match=f"piece {culprit}"):
        collect(list(range(20)), work=work)
    assert torch.get_num_threads() == threads
    assert collect(list(range(20)))[0] == list(range(20))


def test_no_piece_is_under_way_and_few_were_begun_when_the_caller_sees_an_error(threads):
    lock, begun, under_way = threading.Lock(), [], set()

    def work(item):
        with lock:
            begun.append(item)
            under_way.add(item)
        if item == 0:
            under_way.remove(item)
            raise KeyError("first")
        threading.Event().wait(0.005)
        under_way.remove(item)

    with pytest.raises(KeyError, match="first"):
        collect(list(range(50)), work=work)
    assert not under_way
    assert len(begun) < 25


def test_errors_of_making_a_worker_reach_the_caller(threads):
    def make_worker():
        raise MemoryError("no buffers")

    with pytest.raises(MemoryError, match="no buffers"):
        run_all(range(5), make_worker, CPU)


def test_off_the_cpu_the_caller_does_it_all(threads):
    results, workers = collect(list(range(20)), torch.device("cuda"))
    assert results == list(range(20))
    assert workers == [threading.current_thread().name]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_makes_threads_of_its_own(threads):
    collect(list(range(20)))
    child = os.fork()
    if child == 0:
        code = 1
        try:
            code = 0 if collect(list(range(20)))[0] == list(range(20)) else 2
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0

"""Blocks of work shared between the threads of a rank."""

import threading
import time

import pytest

from pgfmd.threads import Threads


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize(("total", "block"), [(0, 4), (3, 4), (4, 4), (37, 4), (1000, 1)])
def test_each_block_is_done_once(count, total, block):
    """All of them, by at most as many threads, whichever takes it."""
    done, workers = [], set()

    def work(thread: int, first: int, stop: int):
        done.append((first, stop))
        workers.add(thread)

    Threads(count).share(work, total, block)
    assert sorted(done) == [(first, min(first + block, total)) for first in range(0, total, block)]
    assert workers <= set(range(count))


def test_results_come_in_order():
    """Also where a later block is done first."""

    def work(first: int, stop: int):
        time.sleep(0.01 if first == 0 else 0)
        return first, stop

    assert Threads(3).collect(work, 11, 2) == [(0, 2), (2, 4), (4, 6), (6, 8), (8, 10), (10, 11)]


@pytest.mark.parametrize("where", ["caller", "helper"])
def test_an_exception_ends_in_the_caller_when_all_are_done(where):
    """Whichever thread raised it; no block is at work any more then."""
    caller, at_work, together = threading.get_ident(), [], threading.Barrier(2)

    def work(_: int, first: int, stop: int):
        at_work.append(first)
        if first < 2:
            together.wait(10)
        if (threading.get_ident() == caller) == (where == "caller") and first < 2:
            raise ValueError("wrong")
        time.sleep(0.02)
        at_work.remove(first)

    with pytest.raises(ValueError, match="wrong"):
        Threads(2).share(work, 6, 1)
    assert len(at_work) == 1


def test_no_more_than_there_are_blocks():
    """One block is done by the caller alone: nobody is woken."""
    seen = []
    Threads(4).share(lambda *_: seen.append(threading.get_ident()), 5, 5)
    assert seen == [threading.get_ident()]

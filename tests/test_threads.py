"""Blocks of work shared between the threads of a rank."""

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import pgfmd
from pgfmd.parallel.threads import ThreadPool, Threads, threads_per_rank


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


@pytest.mark.parametrize("pause", [0, 0.05])
@pytest.mark.parametrize("late", [0, 0.05])
def test_every_thread_that_is_there_works_once_on_each_task(pause, late):
    """Also where helpers are asleep when it comes, or the caller when they are done; it waits for all at work."""
    begun, done = [], []

    def work(thread: int):
        begun.append(thread)
        while len(begun) < 3:
            time.sleep(0.001)
        time.sleep(late if thread else 0)
        done.append(thread)

    helpers = ThreadPool()
    for _ in range(20):
        time.sleep(pause)
        helpers.run(work, 3)
        assert sorted(done) == [0, 1, 2]
        begun.clear()
        done.clear()


def test_nobody_waits_for_a_helper_that_has_not_begun():
    """One that comes late finds no work, not even that of the task before."""
    came, helpers, free = [], ThreadPool(), threading.Event()
    helpers._helpers.submit(free.wait, 10)  # its core is taken away
    for number in range(5):
        helpers.run(lambda thread, number=number: came.append((thread, number)), 2)
    free.set()
    time.sleep(0.1)
    assert came == [(0, number) for number in range(5)]


def test_a_team_in_use_lets_the_caller_work_alone():
    """Within the work, or from another thread: no deadlock."""
    helpers, inner = ThreadPool(), []

    def work(_: int):
        helpers.run(inner.append, 2)
        other = threading.Thread(target=helpers.run, args=(inner.append, 2))
        other.start()
        other.join(10)

    helpers.run(work, 2)
    assert len(inner) >= 2 and set(inner) == {0}


def test_a_helper_that_comes_late_takes_no_part_in_a_smaller_task():
    """There is no room for a third thread where two were asked for."""
    seen, helpers, together, free = [], ThreadPool(), threading.Barrier(3), threading.Event()
    helpers.run(lambda _: together.wait(10), 3)
    held = [helpers._helpers.submit(free.wait, 10) for _ in range(2)]
    helpers.run(lambda _: None, 3)

    def work(thread: int):
        seen.append(thread)
        free.set()
        time.sleep(0.1)

    helpers.run(work, 2)
    assert all(each.result() for each in held) and 0 in seen and 2 not in seen


def test_all_grids_share_their_helpers():
    """Else each would leave some awake, which work for nobody."""
    before = threading.active_count()
    for _ in range(5):
        Threads(2).share(lambda *_: None, 10, 1)
    assert threading.active_count() <= before + 1


@pytest.mark.parametrize(("asked", "count"), [("3", 3), ("4,1", 4), ("9" * 20, 0), ("0", 0), ("²", 0), ("", 0)])
def test_threads_that_the_environment_asks_for(monkeypatch, asked, count):
    """OMP_NUM_THREADS is taken where it is a number of threads that a machine can have, else the cores are counted."""
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert threads_per_rank() == (count or len(os.sched_getaffinity(0)))


def test_solutions_of_several_threads_do_not_share_memory():
    """Two threads that solve on grids alike, again and again, get what one gets."""
    surfaces = np.random.default_rng(5).standard_normal((2, 48, 40))
    alone = [pgfmd.solve(each, 0.1).pressure for each in surfaces]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(5):
            found = pool.map(lambda each: pgfmd.solve(each, 0.1).pressure, surfaces)
            assert all(map(np.array_equal, found, alone))

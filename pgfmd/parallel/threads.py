"""The threads of one rank, which share blocks of rows between them.

Helper threads that stay awake for a while after a task; the caller waits only for those that have begun to work.

Waking a sleeping thread takes longer than most tasks, and many times longer on a virtual machine whose cores fall idle.
A helper without a task therefore first polls for the next one.  It holds no interpreter lock meanwhile, and yields its
core to any thread that wants it.  A task costs its caller about 5 µs, with `concurrent.futures` 6 to 50 µs; a solve at
512² shares 125 tasks.  If no helper has begun before the caller is done, the caller does all the work.  All
grids of a process share its helpers; else the helpers of one grid would poll while those of another work.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable

import numba
import numpy as np

from pgfmd.parallel.compiled import compiled

POLLS = 30000  # before a helper falls asleep: about ten milliseconds

_yield_core = numba.types.ExternalFunction("sched_yield", numba.types.intc())


@compiled()
def _poll(number: np.ndarray, value: int, polls: int) -> None:
    """Return when number[0] differs from `value`, at the latest after that many polls."""
    for _ in range(polls):
        if number[0] != value:
            break
        _yield_core()


class _WatchedNumber:
    """A number that one thread sets and for whose change another waits."""

    def __init__(self) -> None:
        self._value = np.zeros(1, np.int64)
        self._asleep, self._changed = False, threading.Condition()

    def get(self) -> int:
        return int(self._value[0])

    def set(self, value: int) -> None:
        self._value[0] = value
        if self._asleep:
            with self._changed:
                self._changed.notify()

    def wait(self, old: int) -> int:
        """Wait until the number differs from `old`; return it."""
        _poll(self._value, old, POLLS)
        if self.get() == old:
            with self._changed:
                self._asleep = True  # before the check below: either it sees the change, or `set` sees the flag
                self._changed.wait_for(lambda: self.get() != old)
                self._asleep = False
        return self.get()


class _Helper:
    """A thread with two numbers: `asked` counts the tasks given to it, `busy` is 1 while it works and else 0."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.asked, self.busy = _WatchedNumber(), _WatchedNumber()
        self._work = work
        threading.Thread(target=self._help, daemon=True).start()

    def _help(self) -> None:
        task = 0
        while True:
            task = self.asked.wait(task)
            self.busy.set(1)
            self._work()
            self.busy.set(0)


class ThreadPool:
    """The calling thread, number 0, and as many helpers as were ever needed."""

    def __init__(self) -> None:
        self._task: tuple[Callable[[int], None] | None, int] = None, 0
        self._failures: list[BaseException] = []
        self._in_use = threading.Lock()
        self._helpers: list[_Helper] = []

    def run(self, work: Callable[[int], None], count: int) -> None:
        """Call `work(0)` in the caller, and `work(thread)` in each of `count` − 1 helpers that begins before the
        caller's own call returns.  A helper may come late or not at all; so each call of `work` must take what is left
        to do, piece by piece, until nothing is left.

        Returns, or raises an exception of the work, when all have finished.  While another thread, or the work itself,
        uses the pool, the caller works alone.
        """
        if not self._in_use.acquire(blocking=False):
            return work(0)
        try:
            self._task = work, count
            for number in range(len(self._helpers) + 1, count):
                self._helpers.append(_Helper(functools.partial(self._take_part, number)))
            for helper in self._helpers[: count - 1]:
                helper.asked.set(helper.asked.get() + 1)
            try:
                work(0)
            finally:
                self._task = None, 0  # before the check who is busy: a helper that begins later finds no task
                for helper in self._helpers:
                    helper.busy.wait(1)
                failures, self._failures = self._failures, []
            if failures:
                raise failures[0]
        finally:
            self._in_use.release()

    def _take_part(self, thread: int) -> None:
        work, count = self._task
        if work is not None and thread < count:  # else the task for which it was asked is over
            try:
                work(thread)
            except BaseException as failure:  # belongs to the caller, whatever it is
                self._failures.append(failure)


@functools.cache
def thread_pool() -> ThreadPool:
    """The threads of this process, made on first use."""
    return ThreadPool()


os.register_at_fork(after_in_child=thread_pool.cache_clear)  # threads do not survive a fork


def threads_per_rank() -> int:
    """OMP_NUM_THREADS if set (of a list "4,1" the first), else the number of cores that this process is bound to."""
    asked = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    return int(asked) if asked.isdigit() and int(asked) > 0 else len(os.sched_getaffinity(0))


class Threads:
    """`count` threads.  What they run must release the GIL (compiled kernels, FFTW, NumPy on large arrays) to gain
    anything.
    """

    def __init__(self, count: int) -> None:
        self.count = count

    def share(self, work: Callable[[int, int, int], None], total: int, block: int) -> None:
        """Call `work(thread, first, stop)` for each block of 0 … total−1, by the thread that is free first.  An
        exception of any thread is raised in the caller.
        """
        if self.count == 1 or total <= block:
            for first in range(0, total, block):
                work(0, first, min(first + block, total))
            return
        blocks = iter(range(0, total, block))  # shared: the interpreter hands each of its numbers to one thread

        def part(thread: int) -> None:
            for first in blocks:
                work(thread, first, min(first + block, total))

        thread_pool().run(part, min(self.count, -(-total // block)))

    def split(self, work: Callable[[int, int], None], total: int) -> None:
        """Call `work(first, stop)` for one contiguous part of 0 … total−1 for each thread."""
        if total > 0:
            self.share(lambda _, first, stop: work(first, stop), total, -(-total // self.count))

    def collect(self, work: Callable[[int, int], object], total: int, block: int = 64) -> list:
        """What `work(first, stop)` returns for each block of 0 … total−1, in their order whatever thread made them."""
        results: list = [None] * -(-total // block)

        def part(_: int, first: int, stop: int) -> None:
            results[first // block] = work(first, stop)

        self.share(part, total, block)
        return results

    def scale(self, field: np.ndarray, factor: float) -> None:
        """field *= factor"""
        self.deal(lambda first, stop: np.multiply(field[first:stop], factor, out=field[first:stop]), len(field))

    def deal(self, work: Callable[[int, int], None], total: int, least: int = 256) -> None:
        """Call `work(first, stop)` for blocks of at least `least` rows, about four for each thread, each by the thread
        that is free first: in place of `split` where some rows take longer than others.
        """
        if self.count == 1:
            self.split(work, total)
        else:
            self.share(lambda _, first, stop: work(first, stop), total, max(least, total // (4 * self.count)))

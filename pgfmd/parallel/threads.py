"""The threads of one rank, which share blocks of rows.  All grids of a process share its helpers (`ThreadPool`)."""

from __future__ import annotations

import functools
import os
import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np


class ThreadPool:
    """The calling thread, number 0, and as many helpers as were ever needed."""

    def __init__(self) -> None:
        self._in_use = threading.Lock()
        self._size = 1
        self._helpers = ThreadPoolExecutor(self._size)

    def run(self, work: Callable[[int], None], count: int) -> None:
        """Call `work(0)` in the caller, and `work(thread)` in each of `count` − 1 helpers that begins before the
        caller's own call returns.  A helper may begin late or never; so each call of `work` must take piece after piece
        of what is left, until nothing is.

        Returns, or raises an exception of the work, when all have finished.  While the pool is in use, by another
        thread or by the work itself, the caller works alone.
        """
        if not self._in_use.acquire(blocking=False):
            return work(0)
        try:
            if count - 1 > self._size:
                self._helpers.shutdown(wait=False)
                self._size = count - 1
                self._helpers = ThreadPoolExecutor(self._size)
            asked = [self._helpers.submit(work, number) for number in range(1, count)]
            try:
                work(0)
            finally:
                begun = [task for task in asked if not task.cancel()]
                failures = [failure for task in begun if (failure := task.exception())]  # waits
            if failures:
                raise failures[0]
        finally:
            self._in_use.release()


@functools.cache
def thread_pool() -> ThreadPool:
    """The threads of this process, made on first use."""
    return ThreadPool()


os.register_at_fork(after_in_child=thread_pool.cache_clear)  # threads do not survive a fork


def threads_per_rank() -> int:
    """OMP_NUM_THREADS (of a list the first) if it is from 1 to 9999, else the cores that this process is bound to."""
    asked = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    return int(asked) if re.fullmatch("[1-9][0-9]{0,3}", asked) else len(os.sched_getaffinity(0))


class Threads:
    """`count` threads.  They gain where their work releases the GIL: compiled loops, FFTW, NumPy on large arrays."""

    def __init__(self, count: int) -> None:
        self.count = count

    def share(self, work: Callable[[int, int, int], None], total: int, block: int) -> None:
        """Call `work(thread, first, stop)` for each block of 0 … total−1, by the thread that is free first.  Raises
        an error of any thread.
        """
        if self.count == 1 or total <= block:
            for first in range(0, total, block):
                work(0, first, min(first + block, total))
            return
        blocks = iter(range(0, total, block))  # shared by the threads: each number goes to one of them

        def part(thread: int) -> None:
            for first in blocks:
                work(thread, first, min(first + block, total))

        thread_pool().run(part, min(self.count, -(-total // block)))

    def split(self, work: Callable[[int, int], None], total: int) -> None:
        """Call `work(first, stop)` for one contiguous part of 0 … total−1 for each thread."""
        if total > 0:
            self.share(lambda _, first, stop: work(first, stop), total, -(-total // self.count))

    def collect(self, work: Callable[[int, int], object], total: int, block: int = 64) -> list:
        """What `work(first, stop)` returns for each block of 0 … total−1, in the order of the blocks."""
        results: list = [None] * -(-total // block)

        def part(_: int, first: int, stop: int) -> None:
            results[first // block] = work(first, stop)

        self.share(part, total, block)
        return results

    def scale(self, field: np.ndarray, factor: float) -> None:
        """field *= factor"""
        self.deal(lambda first, stop: np.multiply(field[first:stop], factor, out=field[first:stop]), len(field))

    def deal(self, work: Callable[[int, int], None], total: int, least: int = 256) -> None:
        """Like `split`, where rows take unequal times: some four blocks per thread, each of at least `least` rows."""
        block = total if self.count == 1 else max(least, total // (4 * self.count))
        if total > 0:
            self.share(lambda _, first, stop: work(first, stop), total, block)

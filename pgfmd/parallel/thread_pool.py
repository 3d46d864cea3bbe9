"""Helping threads that stay awake for a while, and that nobody waits for unless they are at work.

To wake a sleeping thread takes longer than most of what it is woken for, on a virtual machine whose cores fall idle
many times longer.  So a helper that has nothing to do first watches for work, without the interpreter's lock and giving
way to whoever wants its core.  Where its core is taken away before it has begun, the caller does all the work itself.
All grids share the helpers of a process, or those of one would be awake while those of another work.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable

import numba
import numpy as np

TURNS = 30000  # for which to watch: about ten milliseconds

_give_way = numba.types.ExternalFunction("sched_yield", numba.types.intc())


@numba.njit(nogil=True, cache=True)
def _watch(number: np.ndarray, value: float, turns: int) -> None:
    """Until number[0] is no longer `value`, or so many turns are over."""
    for _ in range(turns):
        if number[0] != value:
            break
        _give_way()


class _Number:
    """One thread sets it, another waits until it changes."""

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
        """What it is once it is no longer `old`."""
        _watch(self._value, old, TURNS)
        if self.get() == old:
            with self._changed:
                self._asleep = True  # before the last look, so that either it sees the change or `set` the sleeper
                self._changed.wait_for(lambda: self.get() != old)
                self._asleep = False
        return self.get()


class _Helper:
    """A thread: the number of the task that it is asked for, and whether it is at work."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.asked, self.busy = _Number(), _Number()
        self._work = work
        threading.Thread(target=self._help, daemon=True).start()

    def _help(self) -> None:
        task = 0
        while True:
            task = self.asked.wait(task)
            self.busy.set(1)
            self._work()
            self.busy.set(0)


class Team:
    """The calling thread, number 0, and as many helpers as were ever needed."""

    def __init__(self) -> None:
        self._task: tuple[Callable[[int], None] | None, int] = None, 0
        self._failures: list[BaseException] = []
        self._used = threading.Lock()
        self._helpers: list[_Helper] = []

    def run(self, work: Callable[[int], None], count: int) -> None:
        """`work(thread)` in the caller, and in each of `count` − 1 helpers that is there before the caller is done; so
        `work` shares out what is left to do.  An exception ends in the caller when all have finished.  While another
        thread, or the work itself, uses the team, the caller works alone.
        """
        if not self._used.acquire(blocking=False):
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
                self._task = None, 0  # before the look at who is at work: who comes later finds none
                for helper in self._helpers:
                    helper.busy.wait(1)
                failures, self._failures = self._failures, []
            if failures:
                raise failures[0]
        finally:
            self._used.release()

    def _take_part(self, thread: int) -> None:
        work, count = self._task
        if work is not None and thread < count:  # else it was asked for an earlier task
            try:
                work(thread)
            except BaseException as failure:  # belongs to the caller, whatever it is
                self._failures.append(failure)


@functools.cache
def team() -> Team:
    """The one of this process."""
    return Team()


os.register_at_fork(after_in_child=team.cache_clear)  # threads do not survive a fork

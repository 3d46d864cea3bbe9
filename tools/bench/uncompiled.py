"""A plugin of pytest that leaves numba's loops uncompiled, so that `coverage` counts their lines.

Python runs them some hundred times slower.  So of each parametrised test two cases run, and one that takes more than
LIMIT seconds ends there, and fails: what it ran counts all the same.
"""

import functools
import signal
from collections import Counter

import numba
import pytest

LIMIT = 1


class Loop:
    """A function in the place of a compiled one."""

    def __init__(self, function):
        functools.update_wrapper(self, function)
        self.py_func, self.compile = function, lambda types: None

    def __call__(self, *arguments):
        return self.py_func(*arguments)


numba.njit = lambda function=None, **_: Loop if function is None else Loop(function)


def too_long(*_):
    pytest.fail(f"more than {LIMIT} s", pytrace=False)


def pytest_collection_modifyitems(items):
    cases = Counter()
    items[:] = [item for item in items if cases.update([item.function]) or cases[item.function] <= 2]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol():
    signal.signal(signal.SIGALRM, too_long)
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    signal.alarm(LIMIT)
    try:
        return (yield)
    finally:
        signal.alarm(0)

"""The examples in docstrings are run."""

from __future__ import annotations

import doctest
import importlib

import pytest

pytest.importorskip("pandas")

MODULES = ("pgfmd.api", "pgfmd.observables.contact", "pgfmd.io.results", "pgfmd.io.ensemble")


@pytest.mark.parametrize("name", MODULES)
def test_examples_give_what_they_say(name, tmp_path, monkeypatch):
    """Every example of a docstring prints what stands below it; each of these files has some."""
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert found.attempted > 1 and found.failed == 0

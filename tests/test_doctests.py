"""The examples in docstrings are run."""

from __future__ import annotations

import doctest
import importlib

import pytest

pytest.importorskip("pandas")

MODULES = ("api", "application.scripting", "observables.contact", "application.results", "application.ensemble")


@pytest.mark.parametrize("name", [f"pgfmd.{name}" for name in MODULES])
def test_examples_give_what_they_say(name, tmp_path, monkeypatch):
    """Every example of a docstring prints what stands below it; each of these files has some."""
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert found.attempted > 1 and found.failed == 0

"""The test of extremes itself: all its cases end right, and its judge is not to be fooled."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import broad

pytest.importorskip("mpi4py")

from pgfmd.solvers.solution import Certificate

PATH = Path(__file__).resolve().parent.parent / "tools" / "bench" / "extremes.py"


@pytest.fixture(scope="module")
def extremes():
    specification = importlib.util.spec_from_file_location("extremes", PATH)
    module = importlib.util.module_from_spec(specification)
    sys.modules["extremes"] = module  # dataclasses look their module up
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize("step", broad([8, 1]))
def test_every_extreme_ends_right_or_in_a_clear_error(extremes, capsys, monkeypatch, step):
    """No NaN, warning, hang, or wrong answer in any case, by default in every eighth."""
    chosen = list(extremes.cases())[::step]
    monkeypatch.setattr(extremes, "cases", lambda: chosen)
    code = extremes.main([])
    table = capsys.readouterr().out
    assert code == 0, [line for line in table.splitlines() if "WRONG" in line]


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda found: found.pressure.__imul__(1.01), "load"),
        (lambda found: found.pressure.__setitem__((0, 0), np.nan), "not finite"),
        (lambda found: found.gap.__iadd__(1.0), "gap in contact"),
        (lambda found: found.pressure.__setitem__(slice(None), found.pressure.mean()), "gap in contact|error"),
        (lambda found: setattr(found, "certificate", Certificate(1.0)), "tolerance"),
    ],
)
def test_the_judge_sees_what_is_wrong(extremes, monkeypatch, change, verdict):
    """A solution that is spoilt on purpose is called wrong."""
    case = next(case for case in extremes.cases() if case.name == "load 1e-1 E'g")
    solve = extremes.solve_contact

    def spoilt(*arguments):
        found = solve(*arguments)
        change(found)
        return found

    monkeypatch.setattr(extremes, "solve_contact", spoilt)
    found, _, _, right = extremes.judge(case, 1e-6)
    assert not right
    assert any(word in found for word in verdict.split("|"))


def test_a_refusal_is_right_only_where_it_is_expected(extremes, monkeypatch):
    """A case that ought to be solved is wrong if it is refused, in however clear a line."""
    by_name = {case.name: case for case in extremes.cases()}

    def refused(*_):
        raise extremes.InputError("nothing is solved here")

    monkeypatch.setattr(extremes, "solve_contact", refused)
    assert not extremes.judge(by_name["load 1e-1 E'g"], 1e-6)[3]
    assert extremes.judge(by_name["no load, exponential"], 1e-6)[3]

"""The model of many ranks, and one rank's share of them."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from conftest import ROOT, SIZE

sys.path.insert(0, str(ROOT / "tools" / "bench"))
import scaling_model
from scaling_model import COMPUTED, Machine, Parts, levels_of, model

pytestmark = pytest.mark.skipif(SIZE > 1, reason="needs one process")

FREE = Machine("of no latency", 64, float("inf"), 0.0, 0.0)
COSTS = {phase: (0.0, 1e-9) for phase in COMPUTED}
NONE = {"all-to-alls": 0, "reductions": 0, "halos": 0}


def test_points_are_divided_and_contact_is_not():
    """Without messages and without what a call costs, a grid on P ranks takes 1/P of its time on one, but for contact,
    which takes as many times more as its fullest slab has.
    """
    known = Parts((COSTS, COSTS), 0.0, [NONE], 0.0, {1: 1.0, 16: 3.0}, {256: 1.0})
    one, many = model(1024, 1, known, FREE), model(1024, 16, known, FREE)
    assert one["transforms"] == pytest.approx(1024**2 * 1e-9) == one["contact"]
    assert many["transforms"] == pytest.approx(one["transforms"] / 16)
    assert many["contact"] == pytest.approx(3 * one["contact"] / 16)
    assert sum(one.values()) == pytest.approx(3e-9 * sum(side**2 for side in levels_of(1024)))


def test_ranks_take_turns_on_cores():
    """Sixteen ranks on four cores: points take a quarter of the time of one rank, what a call costs four times that."""
    costs = {phase: (1e-3, 1e-9) for phase in COMPUTED}
    known = Parts((costs, costs), 0.0, [NONE], 0.0, {1: 1.0}, {256: 1.0})
    here = FREE._replace(cores=4, costs=(0.0, 0.0))
    one, many = model(512, 1, known, here), model(512, 16, known, here)
    assert many["transforms"] == pytest.approx(one["transforms"] / 4)
    assert one["overhead"] == pytest.approx(6e-3)
    assert many["overhead"] == pytest.approx(3e-3 * 4 + 3e-3)  # the grid of 256² is on one rank


def test_messages_are_counted():
    """Two nodes: reductions take 2 log₂ 2 steps between them, halos two messages, an all-to-all one; bytes go through
    the port that the ranks of a node share.
    """
    nothing = {phase: (0.0, 0.0) for phase in COMPUTED}
    counts = {"all-to-alls": 3, "reductions": 5, "halos": 7}
    known = Parts((nothing, nothing), 0.0, [counts], 18.0, {1: 1.0}, {256: 1.0})
    machine = Machine("two nodes", 4, 1e9, 1e-3, 0.0)
    found = model(256, 8, known, machine)
    assert found["latency"] == pytest.approx(1e-3 * (5 * 2 + 7 * 2))
    assert found["all-to-alls"] == pytest.approx(3e-3 + 18 * 256**2 / 2 * 0.5 / 1e9)


def test_costs_are_a_line():
    """What is whatever the size, and what is per point, from levels of several sizes."""
    assert scaling_model._line([(x, 3.0 + 2.0 * x) for x in (1.0, 4.0, 16.0)]) == pytest.approx((3.0, 2.0))
    assert min(scaling_model._line([(1.0, 1.0), (2.0, 2.1)])) >= 0


def test_a_share_of_many_ranks(tmp_path):
    """One process does the share of one rank of 32: transform, mesh and blocks of its eight rows."""
    words = ["emulate", tmp_path / "found.jsonl", "--n", "256", "--ranks", "32"]
    subprocess.run([sys.executable, ROOT / "tools" / "bench" / "scaling.py", *map(str, words)], check=True, timeout=300)
    found = json.loads((tmp_path / "found.jsonl").read_text())
    assert found["rows"] == 8
    assert all(0 < found[name] < 1e6 for name in ("pair", "mesh", "blocks"))

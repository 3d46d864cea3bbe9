"""Quick versions of tools/bench/: extremes, and from a load to an area, gap or displacement and back, whose judges are
not to be fooled; the model of many ranks, and one rank's share of them."""

import dataclasses
import json
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest
from conftest import ROOT, broad

import pgfmd
from pgfmd.solvers.solution import Certificate

pytest.importorskip("mpi4py")

import extremes  # noqa: E402
import round_trips  # noqa: E402
import scaling_model  # noqa: E402
from scaling_model import COMPUTED, Machine, Parts, levels_of, model  # noqa: E402


@pytest.mark.parametrize("step", broad([8, 1]))
def test_every_extreme_ends_right_or_in_a_clear_error(capsys, monkeypatch, step):
    """No NaN, warning, hang, or wrong answer in any case, by default in every eighth."""
    chosen = list(extremes.cases())[::step]
    monkeypatch.setattr(extremes, "cases", lambda: chosen)
    code = extremes.main([])
    table = capsys.readouterr().out
    assert code == 0, [line for line in table.splitlines() if "WRONG" in line]


@pytest.mark.parametrize(("change", "verdict"), [
    (lambda found: found.pressure.__imul__(1.01), "load"),
    (lambda found: found.pressure.__setitem__((0, 0), np.nan), "not finite"),
    (lambda found: found.gap.__iadd__(1.0), "gap in contact"),
    (lambda found: found.pressure.__setitem__(slice(None), found.pressure.mean()), "gap in contact|error"),
    (lambda found: setattr(found, "certificate", Certificate(1.0)), "tolerance"),
])  # fmt: skip
def test_the_judge_sees_what_is_wrong(monkeypatch, change, verdict):
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


def test_a_refusal_is_right_only_where_it_is_expected(monkeypatch):
    """A case that ought to be solved is wrong if it is refused, in however clear a line."""
    by_name = {case.name: case for case in extremes.cases()}

    def refused(*_):
        raise extremes.InputError("nothing is solved here")

    monkeypatch.setattr(extremes, "solve_contact", refused)
    assert not extremes.judge(by_name["load 1e-1 E'g"], 1e-6)[3]
    assert extremes.judge(by_name["no load, exponential"], 1e-6)[3]


SEED = 27


@pytest.mark.parametrize("count", broad([20, 60]))
def test_every_law_with_every_control(count):
    """One trip of each of the 20 pairs, or three: none wrong; refused are areas of walls that touch everywhere, and
    seldom others: full contact, or a gap that determines no load."""
    verdicts, refused = Counter(), Counter()
    for number, trip, outcome in round_trips.trips(SEED, 0, count):
        assert outcome.verdict != "wrong", f"seed {SEED}, trip {number}: {trip}: {outcome.detail}"
        verdicts[outcome.verdict] += 1
        everywhere = trip.control == "contact_area" and trip.law in ("exponential", "formula")
        assert not everywhere or "touches everywhere" in outcome.detail
        refused[trip.law, trip.control] += outcome.verdict == "refused" and not everywhere
    assert verdicts["right"] + verdicts["jump"] >= 0.8 * count, verdicts
    assert max(refused.values()) <= 1 and sum(refused.values()) <= count / 10, refused


@pytest.mark.parametrize("number", range(4))
def test_the_gap_of_a_wall_with_a_plateau(number):
    """p = .5/(1 + exp 3g): the mean gap asked for comes back to 1e-4 of the rms height, the load of it to 1e-3.  On the
    plateau −p/(dp/dgap) goes up to 3.6e12, of which 1e-4 met any gap."""
    rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 4.0, "rms_slope": 0.1 + 0.1 * number, "seed": number}
    heights = pgfmd.surface({"grid": {"n": 24}, "surface": rough})
    wall = {"kind": "formula", "pressure": "0.5 / (1 + exp(3 * gap))", "gaps": [-10, 12]}
    found = pgfmd.solve(heights, mean_gap=3.0, wall=wall)
    assert found.mean_gap == pytest.approx(3.0, rel=0, abs=1e-4 * np.std(heights))
    assert found.gap.mean() == pytest.approx(found.mean_gap, rel=1e-6)
    again = pgfmd.solve(heights, mean_gap=pgfmd.solve(heights, 0.01, wall=wall).mean_gap, wall=wall)
    assert again.mean_pressure == pytest.approx(0.01, rel=1e-3, abs=0)


@pytest.mark.parametrize(("law", "control"), [(0, 2), (1, 3), (2, 1), (3, 2)])
def test_the_judge_sees_another_load(law, control, monkeypatch):
    """A contact at .8 times the load that belongs to the gap, the displacement or the area is wrong."""
    trip = round_trips.draw(SEED, 20 + law + 4 * control)
    trip = dataclasses.replace(trip, heights=np.random.default_rng(1).standard_normal((24, 24)))
    assert round_trips.run(trip).verdict == "right"
    solve = pgfmd.solve

    def other(heights, load=None, **options):
        options.pop(trip.control, None)
        return solve(heights, load or 0.8 * trip.load, **options)

    monkeypatch.setattr(pgfmd, "solve", other)
    assert round_trips.run(trip).verdict == "wrong"


FREE = Machine("of no latency", 64, float("inf"), 0.0, 0.0)
COSTS = {phase: (0.0, 1e-9) for phase in COMPUTED}
NONE = {"all-to-alls": 0, "reductions": 0, "halos": 0}


def test_points_are_divided_and_contact_is_not():
    """Free of messages and calls, P ranks take 1/P of the time; contact takes that of its fullest slab."""
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
    """Two nodes: 2 log₂ 2 steps for a reduction, two messages for a halo, one for an all-to-all; one port per node."""
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


@pytest.mark.breadth
def test_a_share_of_many_ranks(tmp_path):
    """One process does the share of one rank of 32: transform, mesh and blocks of its eight rows."""
    words = ["emulate", tmp_path / "found.jsonl", "--n", "256", "--ranks", "32"]
    subprocess.run([sys.executable, ROOT / "tools" / "bench" / "scaling.py", *map(str, words)], check=True, timeout=300)
    found = json.loads((tmp_path / "found.jsonl").read_text())
    assert found["rows"] == 8
    assert all(0 < found[name] < 1e6 for name in ("pair", "mesh", "blocks"))

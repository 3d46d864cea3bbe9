"""Load → area, gap, displacement or force → load: the quick version of tools/bench/round_trips.py; and its judge."""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter

import numpy as np
import pytest
from conftest import ROOT, SIZE

import pgfmd

sys.path.insert(0, str(ROOT / "tools" / "bench"))

import round_trips  # noqa: E402

SEED = 27
pytestmark = pytest.mark.skipif(SIZE > 1, reason="trips are made by one process")


def test_every_law_with_every_control():
    """Five trips of each of the 20 pairs: none wrong; refused are areas of walls that touch everywhere, and seldom
    others: full contact, or a gap that determines no load.
    """
    verdicts, refused = Counter(), Counter()
    for number, trip, outcome in round_trips.trips(SEED, 0, 100):
        assert outcome.verdict != "wrong", f"seed {SEED}, trip {number}: {trip}: {outcome.detail}"
        verdicts[outcome.verdict] += 1
        everywhere = trip.control == "contact_area" and trip.law in ("exponential", "formula")
        assert not everywhere or "touches everywhere" in outcome.detail
        refused[trip.law, trip.control] += outcome.verdict == "refused" and not everywhere
    assert verdicts["right"] + verdicts["jump"] >= 80 and max(refused.values()) <= 2, (verdicts, refused)


@pytest.mark.parametrize("number", range(4))
def test_the_gap_of_a_wall_with_a_plateau(number):
    """p = .5/(1 + exp 3g): the mean gap asked for comes back to 1e-4 of the rms height, the load of it to 1e-3.  On the
    plateau −p/(dp/dgap) goes up to 3.6e12, of which 1e-4 met any gap.
    """
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

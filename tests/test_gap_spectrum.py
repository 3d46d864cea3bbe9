"""The spectrum of the gap: its sum rule, its modes, its place in the job and in the files."""

from __future__ import annotations

import numpy as np
import pytest
from job_texts import rough_job
from solids import elastic

from pgfmd.application import job
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.contact import Contact
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.solution import Certificate, ContactSolution

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]

JOB = rough_job(
    [24, 18],
    {"lambda_s": 4.0},
    load={"pressure": [0.01]},
    output={"fields": ["gap"], "observables": ["gap_spectrum"], "gap_spectrum": {"bins": 7, "all_modes": True}},
)


def measure(comm, gap, **options):
    """The spectrum of a whole gap (nx, ny), on every rank, on a surface that has modes up to 1.5."""
    grid = SlabGrid(comm, gap.shape)
    local = gap[grid.rows].copy()
    solution = ContactSolution(local, local, 1.0, 0.0, 0.0, Certificate(0.0), 0.0, 0, 0.0, 0.0)
    problem = ContactProblem(grid, local, elastic(1.0), HardWall())
    surface = RoughSurface(problem, [OBSERVABLES["gap_spectrum"](**options)], 1.5)
    return Contact.of(surface, solution).measure()["gap_spectrum"]


@pytest.mark.parametrize("spacing", ["log", "linear"])
@pytest.mark.parametrize("shape", [(24, 24), (15, 22), (4, 9)])
def test_sum_rule(comm, shape, spacing):
    """Σ_{q≠0} |g̃|² = ⟨g²⟩ − ⟨g⟩², exactly, whatever the bins: rounding over N terms."""
    gap = np.random.default_rng(5).exponential(size=shape)
    found = measure(comm, gap, spacing=spacing, all_modes=True)
    assert found["count"].sum() == gap.size - 1
    assert np.sum(found["count"] * found["value"]) == pytest.approx(gap.var(), rel=1e-12, abs=0)


def test_one_wave(comm):
    """A wave of amplitude A has |g̃|² = A²/4 in its two modes, none elsewhere; bins end at the surface's cut-off."""
    x = np.arange(24)[:, None] * np.ones((1, 24))
    found = measure(comm, 3 + 0.8 * np.cos(2 * np.pi * 5 * x / 24), bins=100)
    place = np.argmin(abs(found["q"] - 2 * np.pi * 5 / 24))
    assert found["value"][place] * found["count"][place] == pytest.approx(2 * 0.8**2 / 4, rel=1e-12, abs=0)
    assert np.delete(found["value"], place) == pytest.approx(0, abs=1e-28)
    assert found["edges"][-1] == pytest.approx(1.5, rel=1e-8, abs=0)


def test_in_a_run(comm, shared_tmp_path):
    """Asked for in a job, it is in the file with its unit, and is that of the gap which the run wrote."""
    simulate(job.parse(JOB), comm, shared_tmp_path / "out")
    comm.Barrier()
    results = Results(shared_tmp_path / "out")
    found, gap = results.load(0)["gap_spectrum"], results.field("gap", 0)
    assert np.sum(found["count"] * found["value"]) == pytest.approx(gap.var(), rel=1e-11, abs=0)

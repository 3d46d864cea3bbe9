"""Solids given as a table: the slab that was tabulated, what lies beyond the ends, and the file's way through a run."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from solids import elastic

import pgfmd
from pgfmd.application.estimate import report
from pgfmd.application.job import load
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.graded import Graded
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.options import Solver

JOB = """
grid.n = [12, 10]
surface = {kind = "self-affine", hurst = 0.8, lambda_s = 4.0, rms_slope = 0.1}
load.pressure = 0.01
solid = {kind = "table", path = "factor.csv", contact_modulus = 2.0}
"""


def tabulated(comm, path, q: np.ndarray, factor: np.ndarray) -> Graded:
    """The table, written by rank 0, as a solid of contact modulus 2."""
    if comm.rank == 0:
        np.savetxt(path, np.column_stack([q, factor]), delimiter=",", fmt="%.17g", header="q, F")
    comm.Barrier()
    return Graded(path=str(path), contact_modulus=2.0)


@pytest.mark.mpi
@pytest.mark.parametrize("transform", ["blocked", "mpi4py-fft"])
@pytest.mark.parametrize("base", ["bonded", "free"])
def test_a_slab_by_its_values_at_the_grid_s_waves(comm, shared_tmp_path, base, transform):
    """With an entry for each |q| of the grid the stiffness is that of the slab to 1e-12, and so is the contact, to the
    root of its tolerance; on a rank's modes alike, though rank 0 alone reads the file."""
    if transform == "mpi4py-fft":
        pytest.importorskip("mpi4py_fft")
    grid, slab = SlabGrid(comm, (24, 20), (24.0, 30.0), transform=transform), elastic(2.0, 4.0, base, 0.3)
    waves = SlabGrid(comm, grid.shape, grid.lengths)
    q = np.unique(np.concatenate(comm.allgather(np.sqrt(waves.q_squared()).ravel())))[1:]
    graded = tabulated(comm, shared_tmp_path / "factor.csv", q, slab.factor(q))
    graded.prepare(grid)
    if comm.rank == 0:
        (shared_tmp_path / "factor.csv").unlink()  # no rank reads it again
    assert graded.stiffness(q) == pytest.approx(slab.stiffness(q), rel=1e-12, abs=0)
    heights = np.random.default_rng(3).standard_normal(grid.shape)[grid.rows].copy()
    found, expected = (
        solve_contact(ContactProblem(grid, heights, solid, HardWall(), 0.1), Solver(tolerance=1e-20))
        for solid in (graded, slab)
    )
    assert np.abs(found.pressure - expected.pressure).max() < 1e-9 * grid.reduction.max(expected.pressure)
    assert found.mean_gap == pytest.approx(expected.mean_gap, rel=1e-9)


@pytest.mark.parametrize("poisson", [0.25, 0.49])
@pytest.mark.parametrize("thickness", [2.0, 20.0, 200.0])
@pytest.mark.parametrize("base", ["bonded", "free", "sliding"])
def test_a_slab_by_four_thousand_values(comm, tmp_path, base, thickness, poisson):
    """Between entries at equal ratios the cubic differs by 3e-10 from the slab, on all waves of a 512² grid; with a
    quarter of the entries by 4³ times that, as a third power."""
    slab, ends = elastic(2.0, thickness, base, poisson), (2 * np.pi / 512, np.sqrt(2) * np.pi)
    waves = np.linspace(*ends, 50_000)
    for count, close in ((4000, 1e-9), (1000, 6.4e-8)):
        q = np.geomspace(*ends, count)
        graded = tabulated(comm, tmp_path / "factor.csv", q, slab.factor(q))
        assert np.abs(graded.factor(waves) / slab.factor(waves) - 1).max() < close


def test_beyond_its_ends_it_is_a_half_space(comm, tmp_path, caplog):
    """F is that of the end, and the log says so if the grid has such waves; between entries it is monotone."""
    solid = tabulated(comm, tmp_path / "factor.csv", np.array([0.1, 0.2, 0.9, 1.0]), np.array([5.0, 5.0, 0.5, 0.1]))
    assert solid.factor(np.array([1e-9, 0.1, 0.15, 1.0, 1e9])) == pytest.approx([5, 5, 5, 0.1, 0.1], rel=1e-14)
    assert (np.diff(solid.factor(np.linspace(0.2, 1.0, 500))) < 0).all()
    assert solid.stiffness(1e9) == pytest.approx(solid.half_space_stiffness(1e9), rel=1e-14)
    assert solid.surface_modulus == pytest.approx(0.2, rel=1e-15) and solid.mean_stiffness() == 0
    assert solid.in_units(2.0, 0.5).stiffness(0.3) == pytest.approx(4 * solid.stiffness(0.3), rel=1e-14)
    with caplog.at_level(logging.INFO, "pgfmd"):
        solid.prepare(SlabGrid(comm, (32, 32)))
        assert "q = 0.19635 to 4.44288; below 0.1 F is 5, above 1 it is 0.1" in caplog.text
        caplog.clear()
        solid.prepare(SlabGrid(comm, (10, 10), (60.0, 60.0)))
        assert not caplog.text


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("1, 1\n2, 0\n", "all q and F(q) must be > 0"), ("1, 1\n2, -1\n", "> 0"), ("0, 1\n2, 1\n", "> 0"),
        ("2, 1\n1, 1\n", "larger than the one before"), ("1, 1\n1, 1\n", "larger"), ("1, nan\n2, 1\n", "finite"),
        ("1, 1\n", "at least two lines"), ("1 2 3\n1 2 3\n", "two columns"), ("words\n", "two columns"), (None, "read"),
    ],
)  # fmt: skip
def test_a_table_that_is_none_is_refused(comm, shared_tmp_path, lines, words):
    """One line that names the file, on all ranks."""
    path, rows = shared_tmp_path / "factor.csv", np.zeros((8, 8))[SlabGrid(comm, (8, 8)).rows].copy()
    if comm.rank == 0 and lines is not None:
        path.write_text(lines)
    comm.Barrier()
    with pytest.raises(InputError, match="factor.csv") as caught:
        pgfmd.solve(rows, 0.1, comm=comm, solid={"kind": "table", "path": str(path), "contact_modulus": 1.0})
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.mpi
def test_a_job_s_table_is_found_checked_and_compared(comm, shared_tmp_path):
    """Its path counts from the job's folder; `check` describes it; a restart refuses a table that has changed."""
    folder = shared_tmp_path / "jobs"
    if comm.rank == 0:
        folder.mkdir()
        (folder / "job.toml").write_text(JOB)
    comm.Barrier()
    if comm.rank == 0:
        with pytest.raises(InputError, match=r"solid.path: no such file: .*jobs/factor.csv"):
            load(folder / "job.toml")
    tabulated(comm, folder / "factor.csv", np.array([0.5, 5.0]), np.array([2.0, 1.0]))
    job = load(folder / "job.toml")
    assert "solid      table: table of 2 entries, q from 0.5 to 5, F from 2 to 1" in report(job, 1)
    simulate(job, comm, shared_tmp_path / "out")
    simulate(job, comm, shared_tmp_path / "out", restart=True)
    tabulated(comm, folder / "factor.csv", np.array([0.5, 5.0]), np.array([2.0, 1.1]))
    with pytest.raises(InputError, match=r"the content of .*factor.csv has changed"):
        simulate(job, comm, shared_tmp_path / "out", restart=True)

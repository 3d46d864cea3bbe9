"""The error bar of the grid, against finer grids and its own definition."""

from __future__ import annotations

import numpy as np
import pytest

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.io.results import Results, table
from pgfmd.job.job import parse
from pgfmd.observables.observer import Observer
from pgfmd.observables.statistics.grid_error import MODES, long_waves
from pgfmd.observables.table import OBSERVABLES
from pgfmd.physics.elasticity import Elasticity
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.simulate import simulate
from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
from pgfmd.surfaces.self_affine import self_affine

pytestmark = pytest.mark.mpi

NUMBERS = ("contact_area_corrected", "contact_perimeter", "mean_gap", "elastic_energy", "mean_square_pressure")


def measured(grid, heights, load, cutoff):
    """The row of a load, and its error bars on every rank."""
    problem = ContactProblem(grid, heights, Elasticity(1.0), HardWall(), load)
    observer = Observer(problem, [OBSERVABLES["discretisation"]()], cutoff)
    contact = observer.contact(solve_hard_wall(problem, 1e-9))
    return observer.row(contact), grid.comm.bcast(observer.groups(contact)["discretisation"]), contact


def test_bars_hold_what_a_finer_grid_finds(comm):
    """Of 40 numbers of rough contacts (λ_s = 8a), 9 in 10 are meant to lie within their bars of those on a grid four
    times as fine, whose errors are some 50 times smaller, and bars to be about three times the errors in the middle.
    Were the five numbers of a surface to fail together, 30 of 40 (6 surfaces of 8) would hold with a chance of .96.
    """
    held, ratios = [], []
    for seed, (hurst, load) in enumerate([(0.3, 0.03), (0.3, 0.15), (0.5, 0.01), (0.5, 0.4), (0.8, 0.03), (0.8, 0.15),
                                          (0.3, 0.4), (0.8, 0.01)]):  # fmt: skip
        found = []
        for n in (96, 384):
            grid = SlabGrid(comm, (n, n), (1.0, 1.0))
            row, bars, _ = measured(grid, self_affine(grid, hurst, 1 / 12, 1.0, seed), load, 2 * np.pi * 12)
            found.append((row | bars, bars))
        for name in NUMBERS:
            error, bar = abs(found[0][0][name] - found[1][0][name]), found[0][1][f"{name}_error"]
            held.append(error <= bar)
            ratios.append(bar / error)
    assert len(held) == 40 and sum(held) >= 30
    assert np.median(ratios) < 6


def test_long_waves_are_fourier_coefficients(comm):
    """Their means are the numbers of the row; the others are coefficients of fields, here against NumPy."""
    grid = SlabGrid(comm, (40, 32), (40.0, 16.0))
    heights = self_affine(grid, 0.5, 10, 0.05, 5)
    row, bars, contact = measured(grid, heights, 0.01, 2 * np.pi / 10)
    found = long_waves(contact.problem, contact.solution, contact.line)
    assert found["area"][0].real == pytest.approx(row["contact_area_corrected"], rel=1e-12)
    assert found["perimeter"][0].real == pytest.approx(row["contact_perimeter"], rel=1e-12)
    pressure, gap, heights = (
        grid.fetch(field, 0, 40) for field in (contact.solution.pressure, contact.solution.gap, heights)
    )  # fmt: skip
    energy = (pressure - 0.01) * (gap + heights) / 2
    for name, field in {"mean_gap": gap, "mean_square_pressure": pressure**2, "elastic_energy": energy}.items():
        expected = np.fft.fft2(field)[: MODES + 1, 0] / grid.size
        np.testing.assert_allclose(found[name], expected, atol=1e-12 * abs(expected[0]))
    assert energy.mean() == pytest.approx(row["elastic_energy"], rel=1e-4)  # the row's is that of the unclipped state
    assert bars["mean_square_pressure"] == pytest.approx(np.mean(pressure**2), rel=1e-12)
    assert all(bars[f"{name}_error"] > 0 for name in (*NUMBERS, "kappa"))


def test_no_bars_where_the_grid_belongs_to_the_surface(comm):
    """Where roughness goes down to the pixel there is no finer grid to compare with."""
    grid = SlabGrid(comm, (32, 32))
    _, bars, _ = measured(grid, self_affine(grid, 0.5, 1, 0.05, 5), 0.01, None)
    assert all(np.isnan(value) for name, value in bars.items() if name.endswith("_error"))


def test_bars_are_printed(comm, tmp_path):
    """`pgfmd info` shows number ± bar for the numbers that have one."""
    job = """
[grid]
n = 32
[surface]
kind = "self-affine"
hurst = 0.5
lambda_s = 8
rms_slope = 0.05
seed = 1
[solid]
contact_modulus = 1.0
[load]
pressure = 0.01
[output]
observables = ["discretisation"]
"""
    folder = comm.bcast(tmp_path / "run")
    simulate(parse(job), comm, folder)
    results = Results(folder)
    bar = results.load(0)["discretisation"]["contact_area_corrected_error"]
    assert f"{results.loads['contact_area_corrected'][0]:.5g} ± {bar:.1g}" in table(results)

"""Error bars: how far the numbers of a load are from those of an exact solution on an infinitely fine grid.

**Grid.** Each number is the mean of a field F over the surface, and its error has two parts,

    error² = (ΔF̃_0/(2^q − 1))² + c² mean_{1 ≤ k ≤ MODES} |ΔF̃_k|²,        ΔF̃_k = F̃_k − F̃'_k − s (p̃_k − p̃'_k),

F̃_k the coefficient of the wave number 2πk/lx along x, primed on the coarse grid.

The first part has one sign everywhere and the order q in a.  In a strip of width a along the edges of contacts,
pressures (∝ √d, d: distance to the edge) and gaps differ from those of the continuum: q = 2.  The energy at given load
is least at the solution, so that only the energy of the strip is missing, pressure times displacement (∝ a²) times
width: q = 3.

The second part is random, since edges lie anywhere between the points: local errors have either sign, and partly cancel
in the mean.  Their spectrum is white, so that long waves show the typical size of their sum, while the change of the
mean alone is often small by chance.  The mean load is imposed, that of a region is not: load moves between regions
until their gaps fit the elastic deformation, and F changes with it, by the slope s = Σ Re p̃_k* F̃_k / Σ |p̃_k|²,
1 ≤ k ≤ MODES.  The term with s takes that change out.

The field of the mean gap is d − (pd + w)/p̄, with w that of the elastic energy and d the plastic depth, which is 0
except where a wall of limited hardness yields.  Reason: with g' = g − d, the mean of w + pd + p̄g' is, up to constants,
the least energy, of order 3, while w + pd and p̄g' have opposite errors of order 5/2, like its derivatives by the load:
edges that move with the load pass points.  At λ_s = 4a, 8a, 16a, 32a, the measured errors of the sum are .57, .46, .29,
.26 of those of w (rms).  At f_c = .02, the gap's own long waves change half as much as its mean.

c is from contacts of 200 self-affine surfaces (H = .3, .5, .8; f_c from .02 to .6; 16 λ_s across; λ_s = 4a, 8a, 16a,
for 38 of them 32a), compared with λ_s = 64a, for 32a with 128a, such that the error is large enough in 19 cases of 20;
that of the perimeter, which was .9, from 320 others, half of them slabs (`tools/bench/error_bars.py held`, seeds
20261125 and 20261126), of which .9 held 91 %.

**Band.** Where roughness reaches the pixel, the coarser grid lacks a part of it.  The errors against the same heights,
interpolated onto a grid eight times finer, are then estimated from the roughness s of the surface (`rough_surface`) and
the number e of edges per pixel in contact: BAND times s³ E_el and s³ E_el/p̄ (mean gap), (s e)^1.5 ⟨p²⟩, and the
perimeter.  BAND: so that errors are smaller in 19 of 20 of 213 contacts with λ_s = 1 … 3 pixels.

**Solver.** With the certified energy error B, the mean gap is right to b/p̄ and the elastic energy to b,
b = 2√(B(E_el + ζp̄/2)) + B (`solvers.controls`); the errors are that large if the error of the pressure has the shape of
the pressure itself.  It is rougher.  So ⟨p²⟩, too, is right to far less than 2η⟨p²⟩, η the relative error of the
pressure.  A share η of the points at the edges is on the wrong side, at random, each with a length of about two pixels.
SOLVER: so that errors are smaller in 19 of 20 of 825 solutions (165 surfaces with H = .3, .5 and .8, λ_s from 1 to 64
pixels and f_c from .01 to .8, to 1e-4 … 1e-8, against 1e-12).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict
from pgfmd.observables.contact_area import Area, ContactLine, contact_line
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution, Solve

if TYPE_CHECKING:
    from pgfmd.observables.contact import Contact


@dataclass(frozen=True, kw_only=True)
class Discretisation(Observable):
    """Estimated errors of the numbers of a load, by the grid and by the solver.

    That of the area follows from the contact itself (`contact_area`).  The grid's part of the others comes
    from a second contact on a grid with half as many points each way or, where the grid does not resolve the surface,
    from its spectrum (see above).  An estimate is no bound.  On surfaces with many contacts it is at
    least as large as the true error in nine cases of ten (area: 19 of 20), and the median ratio is about three.  With
    a single contact, both grids may agree by chance.
    """

    name = "discretisation"
    attraction = False
    needs_period = "heights are coarsened by their Fourier modes"
    where = "output.discretisation"
    layout = {
        "discretisation": {
            "contact_area_corrected_error": Dataset("1", "estimated error of contact_area_corrected"),
            "contact_perimeter_error": Dataset("1/({length})", "estimated error of contact_perimeter"),
            "kappa_error": Dataset("1", "estimated error of kappa, which counts pixels"),
            "mean_gap_error": Dataset("{length}", "estimated error of mean_gap"),
            "elastic_energy_error": Dataset("{pressure}*{length}", "estimated error of elastic_energy"),
            "mean_square_pressure": Dataset("{pressure}^2", "⟨p²⟩"),
            "mean_square_pressure_error": Dataset("{pressure}^2", "estimated error of mean_square_pressure"),
        }
    }

    def cost(self, cell: Cell, cutoff: float | None) -> Cost:
        """A contact on a quarter of the points: up to 20 transforms and 60 bytes per point there."""
        return Cost(transforms=5.0, memory=15.0)

    def measure(self, contact: Contact) -> Groups:
        """Solves the second contact, if there is one to compare with.  Collective."""
        problem, area, square = contact.problem, contact.area, contact.mean_square_pressure
        if contact.surface.is_smooth:
            errors = grid_errors(problem, contact, contact.line, contact.surface.solve)
        else:
            errors = band_errors(problem.grid, contact, area, contact.surface.roughness, square)
        others = solver_errors(problem, contact, area, contact.likely_pressure_error, square)
        both = {name: math.hypot(error, others[name]) for name, error in errors.items()}
        per_area = contact.kappa / (area.fraction or math.nan)
        found = {
            "contact_area_corrected_error": contact.area_error,
            "contact_perimeter_error": both["perimeter"],
            "kappa_error": per_area * (abs(area.fraction - area.corrected) + contact.area_error),
            "mean_gap_error": both["mean_gap"],
            "elastic_energy_error": both["elastic_energy"],
            "mean_square_pressure": square,
            "mean_square_pressure_error": both["mean_square_pressure"],
        }
        return {"discretisation": {name: np.array(value) for name, value in found.items()}}


T = TypeVar("T")

MODES = 8  # long waves taken
FACTORS = {
    "perimeter": (1 / 3, 1.2),
    "mean_gap": (1 / 7, 0.35),
    "elastic_energy": (1 / 7, 0.35),
    "mean_square_pressure": (1 / 3, 0.78),
}
"""1/(2^q − 1) and c of each number."""

BAND = {"perimeter": 0.25, "mean_gap": 0.0019, "elastic_energy": 0.0015, "mean_square_pressure": 0.015}
SOLVER = {"perimeter": 2.2, "mean_gap": 0.32, "elastic_energy": 0.32, "mean_square_pressure": 0.21}
"""Of the number of points that change sides, to the power ½, of b, and of 2η⟨p²⟩."""


def band_errors(
    grid: SlabGrid, solution: ContactSolution, area: Area, roughness: float, square: float
) -> dict[str, float]:
    """Estimated errors by the grid of the numbers of FACTORS where it does not resolve the surface.

    roughness: s, radians per pixel;  square: ⟨p²⟩
    """
    energy = roughness**3 * solution.elastic_energy
    scales = {
        "perimeter": area.perimeter / math.prod(grid.lengths),
        "mean_gap": energy / (solution.mean_pressure or math.nan),
        "elastic_energy": energy,
        "mean_square_pressure": (roughness * area.edges / max(area.pixels, 1)) ** 1.5 * square,
    }
    return {name: BAND[name] * scale for name, scale in scales.items()}


def solver_errors(
    problem: ContactProblem, solution: ContactSolution, area: Area, pressure_error: float, square: float
) -> dict[str, float]:
    """Estimated errors by the solver of the numbers of FACTORS.  pressure_error: η;  square: ⟨p²⟩
    """
    grid, energy = problem.grid, solution.elastic_energy
    bound = 2 * energy * solution.certified_error
    mean = solution.mean_pressure
    soft = problem.law.range_at(mean) * mean if mean > 0 else 0.0
    work = 2 * math.sqrt(bound) * math.sqrt(energy + soft / 2) + bound
    scales = {
        "perimeter": math.sqrt(pressure_error * area.edges * grid.pixel_area) / math.prod(grid.lengths),
        "mean_gap": work / (mean or math.nan),
        "elastic_energy": work,
        "mean_square_pressure": 2 * pressure_error * square,
    }
    return {name: SOLVER[name] * scale for name, scale in scales.items()}


def grid_errors(
    problem: ContactProblem, solution: ContactSolution, line: ContactLine | None, solve: Solve
) -> dict[str, float]:
    """Estimated errors by the grid of the numbers of FACTORS; NaN of the perimeter without a line, of the mean gap
    without load, and of all without the second contact.  Collective.
    """
    fine = long_waves(problem, solution, line)

    def measure(coarse: ContactProblem, found: ContactSolution) -> dict[str, np.ndarray]:
        other = None if line is None else contact_line(coarse.grid, found.pressure, found.gap, line.solid)
        return long_waves(coarse, found, other)

    waves = on_half_grid(problem, solve, measure)
    errors = {}
    for name, (systematic, random) in FACTORS.items():
        squares = np.abs(change_at_equal_load(fine, waves, name)) ** 2 if waves else np.full(1 + MODES, np.nan)
        errors[name] = float(np.sqrt(systematic**2 * squares[0] + random**2 * np.mean(squares[1:])))
    if line is None:
        errors["perimeter"] = np.nan
    return errors


def on_half_grid(
    problem: ContactProblem, solve: Solve, measure: Callable[[ContactProblem, ContactSolution], T]
) -> T | None:
    """What `measure` finds on the contact of a grid with half as many points each way; None if that is not solved.
    Collective.
    """
    coarse = SubGrid.coarse(problem.grid)
    heights = restrict(problem.grid, coarse, problem.heights)
    options = Solver(method=problem.law.methods[0])

    def work(grid: SlabGrid) -> T | None:
        found = solve(problem.on(grid, heights.copy()), start=None, options=options)
        return None if found is None else measure(problem.on(grid, heights), found)

    value = coarse.on_all(work)
    coarse.free()
    return value


def change_at_equal_load(fine: dict[str, np.ndarray], coarse: dict[str, np.ndarray], name: str) -> np.ndarray:
    """ΔF̃_k, k = 0 … MODES, from the `long_waves` of both grids."""
    load, field = fine["load"][1:], fine[name][1:]
    slope = np.vdot(load, field).real / (np.vdot(load, load).real or np.inf)
    return fine[name] - coarse[name] - slope * (fine["load"] - coarse["load"])


def long_waves(problem: ContactProblem, solution: ContactSolution, line: ContactLine | None) -> dict[str, np.ndarray]:
    """(1/N) Σ F exp(−2πikx/lx), k = 0 … MODES, of the fields of the numbers of FACTORS and of the pressure, "load".
    Collective.
    """
    grid, pressure, gap, plastic = problem.grid, solution.pressure, solution.gap, solution.plastic_depth
    rows = {name: np.zeros(grid.local_shape[0]) for name in (*FACTORS, "load")}

    def add(first: int, stop: int) -> None:
        p, g, d = pressure[first:stop], gap[first:stop], plastic[first:stop]
        rows["load"][first:stop] = p.sum(axis=1)
        rows["mean_square_pressure"][first:stop] = np.einsum("ij,ij->i", p, p)
        work = np.einsum("ij,ij->i", p - problem.mean_pressure, g - d + problem.heights[first:stop]) / 2
        rows["elastic_energy"][first:stop] = work
        lost = work + np.einsum("ij,ij->i", p, d)
        rows["mean_gap"][first:stop] = d.sum(axis=1) - lost / (problem.mean_pressure or np.nan)

    grid.threads.share(lambda _, first, stop: add(first, stop), grid.local_shape[0], 64)
    if line is not None:
        rows["perimeter"] += line.of_rows()[1] / grid.pixel_area
    place = np.arange(grid.rows.start, grid.rows.stop) / grid.shape[0]
    waves = np.exp(-2j * np.pi * np.outer(np.arange(MODES + 1), place))
    sums = np.array([waves @ row for row in rows.values()]) / grid.size
    total = grid.reduction.sums(*sums.real.ravel(), *sums.imag.ravel()).reshape(2, len(rows), MODES + 1)
    return dict(zip(rows, total[0] + 1j * total[1], strict=True))

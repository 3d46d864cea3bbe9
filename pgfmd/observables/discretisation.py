"""Error bars: how far the numbers of a load are from those of an exact solution on an infinitely fine grid.

**Grid.** Each number is the mean of a field F over the surface, and its error has two parts,

    error² = (b ΔF̃_0)² + c² mean_{1 ≤ k ≤ MODES} |ΔF̃_k|²,        ΔF̃_k = F̃_k − F̃'_k − s (p̃_k − p̃'_k),

F̃_k the coefficient of the wave number 2πk/lx along x, primed on a grid with half as many points each way, and
s = Σ Re p̃_k* F̃_k / Σ |p̃_k|², 1 ≤ k ≤ MODES, the slope by which F changes with the load that moves between regions.
The field of the mean gap is d − (pd + w)/p̄, with w that of the elastic energy and d the plastic depth.

**Band.** Where roughness reaches the pixel, errors are estimated from the contact: up to BAND of the energy Σ p²/K(π/a)
over all edges between a pixel in contact and one that is not; that of ⟨p²⟩ by (s e)^1.5 ⟨p²⟩, s the roughness of the
surface (`rough_surface`), e the number of edges per pixel in contact.

**Solver.** The level λ is wrong by the mean of the residual r = g − λ in contact with the weights w, the change of the
pressure when the load falls by LESS, on the half grid.  So is the mean gap, and the elastic energy by p̄ times as much.
Without such a w, the mean gap is right to B/p̄ and the elastic energy to B, B = 2√(C(E_el + ζp̄/2)) + C with the
certified energy error C (`solvers.controls`), times SOLVER.

Why, and where b, c, BAND and SOLVER come from: NUMERICS.md, "Error bars of the other numbers".
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pgfmd.grid.grid_cost import Cost
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid, restrict, restrict_locally
from pgfmd.grid.transforms import source
from pgfmd.observables.contact import Contact
from pgfmd.observables.contact_area import ContactLine, contact_line
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset, Groups
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.options import Solver
from pgfmd.solvers.solution import ContactSolution, Solve


@dataclass(frozen=True, kw_only=True)
class Discretisation(Observable):
    """Estimated errors of the numbers of a load, by the grid and by the solver.

    That of the area follows from the contact itself (`contact_area`).  The others compare with contacts on a grid with
    half as many points each way; where the grid does not resolve the surface, its part follows from the pressures at
    edges (see above).  An estimate is no bound.  On rough surfaces it is at least as large as the true error in 19
    cases of 20, and about three times as large in the median.  With a single patch, both grids may agree by chance.
    """

    name = "discretisation"
    usual_cost = Cost(transforms=6.0, memory=15.0)  # two contacts on a quarter of the points and a residual, at 1024²
    attraction = False
    needs_period = "heights are coarsened by their Fourier modes"
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

    def measure(self, contact: Contact) -> Groups:
        """Solves the contacts to compare with.  Collective."""
        problem, area, smooth = contact.problem, contact.area, contact.surface.is_smooth
        line = contact.line if smooth else None
        count = max(1, min(MODES, (contact.grid.shape[0] + 1) // 4 - 1))
        fine = long_waves(problem, contact, line, count)

        def compare(coarse: ContactProblem, found: ContactSolution, *rest: np.ndarray) -> tuple[Waves, float]:
            other = None if line is None else contact_line(coarse.grid, found.pressure, found.gap, line.solid)
            waves = long_waves(coarse, found, other, count)
            return waves, level_shift(coarse, found, contact.surface.solve, *rest) if rest else math.nan

        fields = residual(problem, contact) if problem.law.reach == 0 and contact.mean_pressure > 0 else ()
        found = on_half_grid(problem, contact.surface.solve, compare, fields) if smooth or fields else None
        waves, shift = found or (None, math.nan)
        errors = grid_errors(fine, waves, line) if smooth else band_errors(contact)
        others = solver_errors(contact, shift)
        both = {name: math.hypot(error, others[name]) for name, error in errors.items()}
        per_area = contact.kappa / (area.fraction or math.nan)
        numbers = {
            "contact_area_corrected_error": contact.area_error,
            "contact_perimeter_error": both["perimeter"],
            "kappa_error": per_area * (abs(area.fraction - area.corrected) + contact.area_error),
            "mean_gap_error": both["mean_gap"],
            "elastic_energy_error": both["elastic_energy"],
            "mean_square_pressure": contact.mean_square_pressure,
            "mean_square_pressure_error": both["mean_square_pressure"],
        }
        return {"discretisation": {name: np.array(value) for name, value in numbers.items()}}


T = TypeVar("T")

MODES = 16  # long waves taken, but for small grids: below the shortest one of the half grid
FACTORS = {
    "perimeter": (1 / 3, 1.2),
    "mean_gap": (0.0, 0.38),
    "elastic_energy": (0.0, 0.38),
    "mean_square_pressure": (1 / 3, 0.78),
}
"""b and c of each number."""

BAND = {"perimeter": 0.25, "mean_gap": 0.026, "elastic_energy": 0.026, "mean_square_pressure": 0.015}
LESS = 0.05  # of the load, by which it falls for the weights of the level
LEVEL = 2.5
SOLVER = {"perimeter": 2.2, "energy": 0.32, "mean_square_pressure": 0.21}
"""Of the number of points that change sides, to the power ½, of B, and of 2η⟨p²⟩."""

Waves = dict[str, np.ndarray]  # of `long_waves`


def band_errors(contact: Contact) -> dict[str, float]:
    """Estimated errors by the grid of the numbers of FACTORS where it does not resolve the surface.  Collective."""
    grid, pressure, area, square = contact.grid, contact.pressure, contact.area, contact.mean_square_pressure
    above = grid.fetch(pressure, grid.rows.start - 1, grid.rows.start)

    def at_edges(first: int, stop: int) -> float:
        """Σ p² over edges; one of both pressures is 0."""
        rows = np.concatenate([above, pressure[:stop]]) if first == 0 else pressure[first - 1 : stop]
        here = rows[1:]
        return math.fsum(
            float(np.sum(np.square(here + other), where=(here > 0) != (other > 0)))
            for other in (rows[:-1], np.roll(here, 1, axis=1))
        )

    total = grid.reduction.sum(math.fsum(grid.threads.collect(at_edges, len(pressure), grid.band))) / grid.size
    if not contact.problem.law.releases:  # no pressure is 0
        total = square
    energy = total / float(contact.problem.solid.stiffness(np.array(math.pi / math.sqrt(grid.pixel_area))))
    scales = {
        "perimeter": area.perimeter / math.prod(grid.lengths),
        "mean_gap": energy / (contact.mean_pressure or math.nan),
        "elastic_energy": energy,
        "mean_square_pressure": (contact.surface.roughness * area.edges / max(area.pixels, 1)) ** 1.5 * square,
    }
    return {name: BAND[name] * scale for name, scale in scales.items()}


def residual(problem: ContactProblem, solution: ContactSolution) -> Iterator[np.ndarray]:
    """1 where 0 < p < σ_Y and 0 elsewhere; then, in the same array, g − λ there: (nx_local, ny).  Collective."""
    grid, pressure = problem.grid, solution.pressure
    between = (pressure > 0) & (pressure < problem.law.highest)
    field = between.astype(float)

    def gaps(first: int, stop: int, rows: np.ndarray) -> None:
        field[first:stop] *= rows - problem.heights[first:stop]

    yield field
    load = grid.reduction.dot(field, pressure)
    grid.convolve(source(pressure), problem.solid.apply_compliance(grid, np.float64, 1 / grid.modes), gaps)
    level = grid.reduction.dot(field, pressure) / (load or math.nan)
    yield np.subtract(field, level, out=field, where=between)


def level_shift(
    problem: ContactProblem, found: ContactSolution, solve: Solve, between: np.ndarray, rest: np.ndarray
) -> float:
    """Error of the level by the residual on the finer grid, see above; NaN if it is not known.  Collective.

    problem, found: the contact on the half grid; between, rest: `residual` there.
    """
    less = solve(problem.at((1 - LESS) * problem.mean_pressure), start=None, options=Solver())
    if less is None:
        return math.nan
    change = found.pressure - less.pressure
    shift, weight = (problem.grid.reduction.dot(change, field) for field in (rest, between))
    return shift / weight if weight > 0 else math.nan


def solver_errors(contact: Contact, shift: float) -> dict[str, float]:
    """Estimated errors by the solver of the numbers of FACTORS.  Collective.

    shift: error of the level, NaN if not known
    """
    grid, energy, mean = contact.grid, contact.elastic_energy, contact.mean_pressure
    bound, eta = 2 * energy * contact.certified_error, contact.likely_pressure_error
    soft = contact.problem.law.range_at(mean) * mean if mean > 0 else 0.0
    work = SOLVER["energy"] * (2 * math.sqrt(bound) * math.sqrt(energy + soft / 2) + bound)
    if not math.isnan(shift):
        work = LEVEL * abs(shift) * mean
    edges = math.sqrt(eta * contact.area.edges * grid.pixel_area) / math.prod(grid.lengths)
    return {
        "perimeter": SOLVER["perimeter"] * edges,
        "mean_gap": work / (mean or math.nan),
        "elastic_energy": work,
        "mean_square_pressure": SOLVER["mean_square_pressure"] * 2 * eta * contact.mean_square_pressure,
    }


def grid_errors(fine: Waves, coarse: Waves | None, line: ContactLine | None) -> dict[str, float]:
    """Estimated errors by the grid of the numbers of FACTORS; NaN of the perimeter without a line, of the mean gap
    without load, and of all without the second contact.
    """
    errors = {}
    for name, (systematic, random) in FACTORS.items():
        change = np.full(2, np.nan) if coarse is None else np.abs(change_at_equal_load(fine, coarse, name))
        size = change.max() or 1.0  # squares of large units overflow
        squares = (change / size) ** 2
        errors[name] = float(size * math.sqrt(systematic**2 * squares[0] + random**2 * np.mean(squares[1:])))
    if line is None:
        errors["perimeter"] = np.nan
    return errors


def on_half_grid(
    problem: ContactProblem, solve: Solve, measure: Callable[..., T], fields: Iterable[np.ndarray] = ()
) -> T | None:
    """What `measure` finds on the contact of a grid with half as many points each way, given its problem, solution, and
    these fields (nx_local, ny) there; None if that is not solved.  Collective.
    """
    coarse = SubGrid.coarse(problem.grid)
    given = [restrict_locally(problem.grid, coarse, field) for field in fields]
    heights = restrict(problem.grid, coarse, problem.heights)

    def work(grid: SlabGrid) -> T | None:
        half = problem.on(grid, heights)
        found = solve(half, start=None, options=Solver())
        return None if found is None else measure(half, found, *given)

    value = coarse.on_all(work)
    coarse.free()
    return value


def change_at_equal_load(fine: Waves, coarse: Waves, name: str) -> np.ndarray:
    """ΔF̃_k, k = 0, 1 …, from the `long_waves` of both grids."""
    size = np.abs(fine["load"][1:]).max() or 1.0  # squares of large units overflow
    load, field = fine["load"][1:] / size, fine[name][1:]
    slope = np.vdot(load, field).real / (np.vdot(load, load).real or np.inf)
    return fine[name] - coarse[name] - slope * ((fine["load"] - coarse["load"]) / size)


def long_waves(problem: ContactProblem, solution: ContactSolution, line: ContactLine | None, count: int) -> Waves:
    """(1/N) Σ F exp(−2πikx/lx), k = 0 … count, of the fields F of FACTORS and of the pressure, "load".  Collective."""
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
    waves = np.exp(-2j * np.pi * np.outer(np.arange(count + 1), place))
    sums = np.array([waves @ row for row in rows.values()]) / grid.size
    total = grid.reduction.sums(*sums.real.ravel(), *sums.imag.ravel()).reshape(2, len(rows), count + 1)
    return dict(zip(rows, total[0] + 1j * total[1], strict=True))

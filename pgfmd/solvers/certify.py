"""The certificate of any pressure, however it was found.

The bound of `active_set` and `second_order` holds for every feasible pressure, 0 ≤ p ≤ σ_Y and Σ p = P.  Others are
projected first: cut to their bounds, then multiplied by one factor.  Under a hard wall a trace of pressure far from the
contact would spoil the bound, since ε = g − λ where p > 0.  Such points pay p (g − λ − ε) for an ε < g − λ instead, as
in `second_order`, and do not count as in contact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pgfmd.errors import InputError
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import Relaxation, State
from pgfmd.solvers.active_set.feasible import scale_to_load
from pgfmd.solvers.law_operations import LawOperations, LawState, local_compliance
from pgfmd.solvers.nondimensional import Dimensionless
from pgfmd.solvers.solution import ContactSolution

REGIONS = 4, 16  # pixels across, of which the compliance says which points pay; the least bound of these counts
TRACES = 0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1  # pressures over p̄ below which no point may touch
MANY = 0.1  # points with pressure and a gap over those without: more are traces; solutions by other programs had .06
WRONG, FACTOR = 0.1, 1.5  # certified error from which scales are doubted, and the factor on heights that confirms it


@dataclass(frozen=True)
class Projection:
    """What was done to a given pressure p₀ of mean p̄₀: ‖p − c p₀‖₂/‖c p₀‖₂, c = p̄/p̄₀, is its relative change.

    outside: part of the load on traces of pressure where there is a gap, which were then set to 0.  doubt: why the
    pressure is probably not one on these heights, in one line; empty if there is no doubt.
    """

    given_mean: float
    change: float
    outside: float = 0.0
    doubt: str = ""


def certify(
    problem: ContactProblem, given: np.ndarray, mean_pressure: float | None = None
) -> tuple[ContactSolution, Projection]:
    """The certified contact of a given pressure (nx_local, ny), all finite.  Collective.

    mean_pressure: to be borne; that of the given pressure if None.  The certified error is that of the projected
    pressure.  Raises InputError for a pressure that is uniform or without a positive sum, and as the solvers do.
    """
    grid, reduction, law = problem.grid, problem.grid.reduction, problem.law
    if not law.convex:
        raise InputError(f"wall.kind = {law.kind}: its energy has several minima; only convex laws can be certified")
    with np.errstate(over="ignore"):
        given_mean = reduction.sum(given / grid.size)
    if not 0 < given_mean < math.inf:
        raise InputError(f"pressure: its mean is {given_mean:g}; must be positive (where the solids press) and finite")
    problem = problem.at(given_mean if mean_pressure is None else mean_pressure)
    scaled = Dimensionless(problem.with_law(problem.law.up_to(problem.load)))
    if scaled.uniform is not None:
        raise InputError("heights: all are the same; there is no elastic energy of which an error could be a part")
    given = given / given_mean
    pressure = np.clip(given, 0.0, scaled.problem.law.highest)
    scale_to_load(scaled.problem, (pressure, -scaled.problem.heights))
    change = pressure - given
    change_of_all = math.sqrt(reduction.dot(change, change) / reduction.dot(given, given))
    under = _under_wall if "active-set" in problem.law.methods else _under_law
    state, energy = under(scaled.problem, pressure)
    if not energy > 0:
        raise InputError("pressure: it is the same everywhere; there is no elastic energy of which to state the error")
    factor = _fitting_factor(problem, state, scaled)
    outside = _cut_traces(scaled.problem, state) if isinstance(state, State) else 0.0
    found, doubt = scaled.solution(state, energy, math.inf), ""
    if not (found.certified_error <= WRONG or 1 / FACTOR <= factor <= FACTOR):
        doubt = (
            f"the certified error is {found.certified_error:.2g}, of order 1, and the pressure fits heights that are "
            f"{factor:.3g} times these: are heights, pressures and contact modulus in the same units, peaks positive, "
            "axes alike?"
        )
    return found, Projection(given_mean, change_of_all, outside, doubt)


def _under_law(problem: ContactProblem, pressure: np.ndarray) -> tuple[LawState, float]:
    """The certified state of a feasible pressure of mean 1 under any law, and its energy per point.  Collective."""
    operations, state = LawOperations(problem), LawState(pressure, problem.grid.new_field())
    operations.compute_gap(state)
    operations.certify(state)
    return state, state.work / 2


def _under_wall(problem: ContactProblem, pressure: np.ndarray) -> tuple[State, float]:
    """The same under a hard wall, or one of limited hardness.  Collective."""
    relaxation, state = Relaxation(problem), State(pressure, problem.grid.new_field())
    relaxation.compute_gap(state, np.float64)
    relaxation.measure(state)
    if (highest := problem.law.highest) < math.inf:  # points next to σ_Y, with gaps far below, must not count
        weight, reduction = pressure * (highest - pressure), problem.grid.reduction
        total = reduction.sum(weight)
        state.level = reduction.dot(weight, state.gap) / total if total > 0 else state.level
    for pixels in REGIONS if state.energy > 0 else ():
        relaxation.spare = local_compliance(problem, pixels)
        state.error = min(state.error, relaxation.bound(state, np.float64))
    return state, state.energy / problem.grid.size


def _fitting_factor(problem: ContactProblem, state: State | LawState, scaled: Dimensionless) -> float:
    """The factor on heights that fits the pressure best: in contact, displacements follow the heights.  Collective."""
    weight, heights, reduction = state.pressure / problem.grid.size, problem.heights, problem.grid.reduction
    high = heights - reduction.max(heights)
    high -= reduction.dot(weight, high)
    product, square = reduction.sums(
        np.sum(weight * high * (state.gap + scaled.problem.heights)), np.sum(weight * high * high)
    )
    return float(product / square) * scaled.units.height if square > 0 else 1.0


def _cut_traces(problem: ContactProblem, state: State) -> float:
    """If many points with pressure have a gap (those that pay in the certificate), sets to 0 pressures below the one of
    `TRACES` that separates them best from the others; returns their part of the load.  Collective.
    """
    pressure, edges = state.pressure, (*TRACES, math.inf)
    outside = state.gap - state.level > local_compliance(problem, REGIONS[0]) * pressure
    parts = [np.histogram(pressure[where & (pressure > 0)], edges)[0] for where in (outside, ~outside)]
    above, below = problem.grid.reduction.sums(*np.ravel(parts)).reshape(2, -1)
    wrong = np.cumsum(above[::-1])[::-1] + np.cumsum(below) - below  # points on the wrong side of each edge
    traces = pressure < TRACES[int(np.argmin(wrong)) if wrong[0] > MANY * below.sum() else 0]
    load = problem.grid.reduction.sum(pressure[traces])
    pressure[traces] = 0.0
    return load / problem.load

"""What the solvers `gfmd` and `newton` share: the gap of a pressure, its certificate, the resolvent of the law.

Pressures are over their mean, p̂ = p/p̄, so that feasible ones have mean 1; gaps and heights share one unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from pgfmd.grid.transforms import source
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.second_order import Rounding, certified, energy_of_residual, last_digits
from pgfmd.solvers.solution import uncertifiable

PIXELS = 4  # diameter of the region whose compliance is the α of `second_order`: of 2, 4 and 8, 4 gives least bounds
ROUNDED = 1e-15  # relative excess over the highest pressure that counts as rounding, and is cut off


@dataclass
class LawState:
    """p̂ and g (nx_local, ny) on one grid, and what is known of them; error: bound on J(p̂) − J(p̂*) over ⟨p̂, Gp̂⟩."""

    pressure: np.ndarray
    gap: np.ndarray
    error: float = math.inf
    work: float = 0.0  # ⟨p̂, Gp̂⟩
    level: float = 0.0  # c: at the solution the law's gap at p̂ is g − c
    contact: int = 0  # points in contact
    iterations: int = 0
    pressure_error: float = math.nan  # ‖Kε‖/‖p̂‖, an estimate
    shift: int = 0
    base: float = 0.0
    rounding: float = 0.0  # error that rounding of the gap and of the pressure's last digits may make


def local_compliance(problem: ContactProblem, pixels: float) -> float:
    """Compliance of a region of that diameter in pixels."""
    return 1 / float(problem.solid.stiffness(np.array(2 / (pixels * max(problem.grid.spacing)))))


class LawOperations:
    """Computes gaps, certificates and resolvents for a dimensionless `problem` of mean pressure 1; squares: Σ p̂² and
    Σ u² of the last gap.  Collective to make.
    """

    def __init__(self, problem: ContactProblem) -> None:
        self.problem, self.grid, self.heights, self.law = problem, problem.grid, problem.heights, problem.law
        scale, solid = 1 / self.grid.modes, problem.solid
        self.compliance = {real: solid.apply_compliance(self.grid, real, scale) for real in (np.float32, np.float64)}
        self.stiffness, self.rounding = solid.apply_stiffness(self.grid, np.float32, scale), Rounding(self.grid, solid)
        self.squares = np.zeros(2)
        self.summit = self.grid.reduction.max(self.heights)

    def compute_gap(self, state: LawState) -> None:
        """g = Gp̂ − h in double precision, and ⟨p̂, Gp̂⟩, which g + h would give with fewer digits.  Collective."""
        parts: dict[int, tuple[float, ...]] = {}

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            pressure = state.pressure[first:stop]
            parts[first] = tuple(
                float(np.vdot(*pair)) for pair in ((rows, pressure), (pressure, pressure), (rows, rows))
            )
            np.subtract(rows, self.heights[first:stop], out=state.gap[first:stop])

        self.grid.convolve(source(state.pressure), self.compliance[np.float64], drain)
        work, *squares = self.grid.reduction.sums_of_blocks(parts, 3)
        state.work, self.squares = float(work) / self.grid.size, np.array(squares)

    def total(self, function: Callable[..., float | tuple[float, ...]], *fields: np.ndarray) -> np.ndarray:
        """The sums over all rows of all ranks of what a function returns for rows of some fields.  Collective."""
        parts = self.grid.threads.collect(
            lambda a, b: np.atleast_1d(function(*(field[a:b] for field in fields))), self.grid.local_shape[0]
        )
        return self.grid.reduction.sums(*np.sum(parts, axis=0))

    def each(self, function: Callable[..., None], *fields: np.ndarray) -> None:
        """Calls a function with the same rows of some fields, a band at a time, which stays in cache; threads share the
        bands.
        """

        def part(_: int, first: int, stop: int) -> None:
            with np.errstate(over="ignore", invalid="ignore"):  # numbers of a diverging iteration
                function(*(field[first:stop] for field in fields))

        self.grid.threads.share(part, self.grid.local_shape[0], self.grid.band)

    def certify(self, state: LawState) -> None:
        """Level, contact and certified error of a state whose gap was computed last.  The error is infinite if a
        pressure is above the highest, as `_carry` may leave it.  Collective.
        """
        grid, law, fields = self.grid, self.law, (state.pressure, state.gap)
        threshold = law.contact_above(1.0, self.squares[0] / grid.size)
        potential, load, contact, softness = self.total(partial(law.moments, threshold=threshold), *fields)
        level = state.level = float(potential / load) if load > 0 else state.level
        state.contact = int(contact)
        compliance, excess = local_compliance(self.problem, PIXELS), dict[int, float]()

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            pressure, gap = (field[first:stop] for field in fields)
            excess[first] = law.excess(pressure, gap, rows, compliance, level)

        square, change = energy_of_residual(grid, fill, self.stiffness)
        work = grid.size * state.work

        def squares_of_heights(pressure: np.ndarray, heights: np.ndarray) -> float:
            high = heights[pressure > threshold]
            return float(high @ high + (high - self.summit) @ (high - self.summit))

        (heights_squared,) = self.total(squares_of_heights, state.pressure, self.heights)
        rounding = self.rounding.bound(self.squares, heights_squared, work)
        bound = certified(square, rounding) + grid.reduction.sum([excess[first] for first in sorted(excess)])
        rounding += grid.size * last_digits(self.problem, self.squares[0] / grid.size, softness / grid.size)
        state.error, state.rounding = (bound / work, rounding / work) if work > 0 else (math.inf, math.inf)
        if law.highest < math.inf and grid.reduction.max(state.pressure) > law.highest * (1 + ROUNDED):
            state.error = math.inf
        state.pressure_error = math.sqrt(change / self.squares[0])

    @staticmethod
    def arrived(state: LawState, tolerance: float) -> bool:
        """Whether the error is at most the tolerance.  Raises Uncertifiable if more is left, mostly rounding."""
        if tolerance < state.rounding and state.error < 4 * state.rounding:  # as long as more is left, the error falls
            raise uncertifiable(state.rounding, tolerance)
        return state.error <= tolerance

    def respond(self, state: LawState, target: np.ndarray, compliance: float) -> None:
        """Sets p̂ to the law's answer of mean 1, compliance · p̂ − gap(p̂) = target + c, and the level, from which the
        search begins, to c.  Collective.
        """
        count, level, low, high = self.grid.size, state.level, -np.inf, np.inf
        enough = 1e-14 * count  # a factor on p̂ corrects the rest
        for _ in range(200):
            answer = partial(self.law.respond, compliance=compliance, level=level)
            total, slope = self.total(answer, target, state.pressure)
            if abs(total - count) <= enough:
                break
            low, high = (level, high) if total < count else (low, level)
            if slope > 0 < total:  # Newton for Σ p̂, which is nearly linear in c, or for its logarithm: the shorter step
                steps = (count - total) / slope, math.log(count / total) * total / slope
                trial = level + min(steps, key=abs)
            elif total > 0:  # all at their bounds
                trial = level + math.copysign(compliance, count - total)
            else:  # all underflowed: the level at which the point of the largest target bears about 1
                trial = compliance - self.grid.reduction.max(target)
            if abs(trial - level) <= 1e-15 * abs(level):
                break
            level = trial if low < trial < high else (low + high) / 2
        self._carry(state.pressure, total)
        state.level = level

    def _carry(self, pressure: np.ndarray, total: float) -> None:
        """Multiplies p̂, the sum of which is `total`, so that its mean is 1.  Points at the highest pressure keep it to
        the last digit if possible, as energies are of first order in its error.  Collective.
        """
        highest, missing, reduction = self.law.highest, self.grid.size - total, self.grid.reduction
        if highest < math.inf:
            free = pressure < highest
            below = pressure[free]
            carried, most = reduction.sum(below), reduction.max(below)
            if carried > 0 and 0 < (factor := 1 + missing / carried) and most * factor <= highest * (1 + ROUNDED):
                np.multiply(pressure, factor, out=pressure, where=free)
                np.minimum(pressure, highest, out=pressure)
                return
        with np.errstate(divide="ignore", invalid="ignore"):  # where all underflowed no pressure is certified
            pressure *= self.grid.size / total

"""The exponential wall on one grid: a smoothed active-set Newton method on the dual problem.

With p̂ = p/p̄, G the compliance per p̂ and heights h, minimise J(p̂) = ½⟨p̂, Gp̂⟩ − ⟨h, p̂⟩ + ζ⟨p̂, ln p̂⟩ over p̂ > 0
of mean 1.  Newton's equation for the change δp̂ = √p̂ y is

    (ζ + √p̂ G √p̂) y = −√p̂ (g + ζ ln p̂ − c),  g = Gp̂ − h.

The spectrum of this operator decays fast from the largest eigenvalues on, no entry overflows however small p̂ is, and
conjugate gradients take one convolution per iteration.

The step is taken point by point in x = α p̂ + ζ ln p̂ (α: compliance of a region `REACH` pixels across), so that p̂ stays
positive.  In contact this is a step in p̂, outside it is one in ln p̂.  The old ln p̂ cancels:

    α p̂ + ζ ln p̂ = α (p̂ + δp̂) − (g + Gδp̂) + c.

As ζ → 0 this becomes the primal–dual active set of the hard wall.  The constant c (`level` in the code) is chosen so
that the pressures bear the load.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.transforms import sink
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.exponential_wall import loops
from pgfmd.solvers.law_operations import LawOperations, LawState, local_compliance
from pgfmd.solvers.solution import Patience, Precision, uncertifiable

REACH = 8  # diameter in pixels of the region whose compliance is α: if smaller, points that join a patch overshoot
BACK = 0.25  # a step that raises both merits is shortened to this part
MOST_INNER, MOST_OUTER = 1000, 200
LEAST_CUT, MOST_CUT = 0.1, 0.03  # factor on the linear residual in a step; MOST_CUT after one that cut the error by 10
STIFFEST = 1e4  # −P' over 1/α at most, of any law: where the wall is hard, −P' is infinite
MOST_SHORTENED = 10  # times that a step is shortened at most, down to 1e-6 of it
DESCENT_CUT = 1e-8  # factor on the linear residual in a step: with 1e-2 in single precision, a third never ended
SETTLED = 1e-2  # promised gain per point over ζ at which the next shorter ζ takes over
ENOUGH = 0.1  # a step of a descent is shortened if it gains less than this part of what the slope promises
ROUNDED = 1e-13  # of the objective: smaller gains are rounding
MOST_DESCENT_STEPS, HALVINGS = 100, 40  # steps for one ζ; times that a step is halved
STIFF_LOAD = 1e12  # compliance per p̂ over the heights, whose cube single precision cannot hold (3e38)

Merits = tuple[float, float]


class Newton(LawOperations):
    """Newton iterations for a problem under an exponential wall."""

    law: ExponentialWall
    precision: Precision = np.float32  # of the linear equation

    def __init__(self, problem: ContactProblem):
        super().__init__(problem)
        self.zeta, self.alpha = self.law.length_scale, local_compliance(problem, REACH)
        if self.alpha > STIFF_LOAD:
            self.precision = np.float64

    def relax(self, state: LawState, tolerance: float, monitor: Callable[[LawState], None] | None = None) -> LawState:
        """Iterate until the certified error is at most `tolerance`.  Overwrites and returns `state`.  Collective.

        Raises SolverError if the error stops falling above the tolerance, Uncertifiable if that is due to rounding.
        """
        self.compute_gap(state)
        self.certify(state)
        patience, wanted, merits = Patience(), LEAST_CUT, self.merits(state)
        patience.take(state.error)
        for _ in range(MOST_OUTER):
            if monitor is not None:
                monitor(state)
            if self.arrived(state, tolerance):
                return state
            before = state.error
            enough = min(LEAST_CUT, 0.3 * math.sqrt(tolerance / before))  # the error is of second order in the residual
            merits = self.advance(state, max(wanted, enough), merits)
            wanted = MOST_CUT if state.error < 0.1 * before else LEAST_CUT
            if not patience.take(state.error):
                break
        raise self.failure(patience, state, tolerance)

    def failure(self, patience: Patience, state: LawState, tolerance: float) -> SolverError:
        """What to raise when the error stops falling."""
        if not state.rounding <= tolerance:
            return uncertifiable(state.rounding, tolerance)
        return patience.failure(self.law.kind, self.grid, state.iterations, tolerance)

    def advance(self, state: LawState, wanted: float, before: Merits) -> Merits:
        """One Newton step, shortened while it would raise both merits; returns the new ones.  Collective."""
        pressure, gap = state.pressure.copy(), state.gap.copy()
        self.respond(state, self.newton_target(state, wanted), self.alpha)
        self.compute_gap(state)
        for _ in range(MOST_SHORTENED):
            merits = self.merits(state)
            if merits[0] <= before[0] or merits[1] <= before[1]:
                break
            self.step_back(pressure, gap, state)
        self.certify(state)
        return merits

    def step_back(self, pressure: np.ndarray, gap: np.ndarray, state: LawState) -> None:
        """Shortens a step to the part `BACK`: the objective is convex there, and the gap linear, so that no convolution
        is needed.  Collective.
        """

        def mix(old: np.ndarray, new: np.ndarray) -> None:
            new -= old
            new *= BACK
            new += old

        self.each(mix, pressure, state.pressure)
        self.each(mix, gap, state.gap)
        (work,) = self.total(loops.work, state.pressure, state.gap, self.heights)
        state.work = float(work) / self.grid.size

    def merits(self, state: LawState) -> Merits:
        """J, and the duality gap ζ⟨p̂ ln(p̂/σ̂)⟩ to the wall's answer σ̂ = exp(−g/ζ)/⟨exp(−g/ζ)⟩.  Collective."""
        count, least, zeta = self.grid.size, self.grid.reduction.min(state.gap), self.zeta
        fields = state.pressure, state.gap
        weight, potential = self.total(partial(loops.weight_and_potential, zeta=zeta, least=least), *fields)
        if not weight > 0:  # the law's own answer underflows in every point
            raise SolverError(f"{self.law.kind}: the wall's pressure is 0 in every point; take a larger range or load")
        log_scale = -math.log(weight / count)
        answer = partial(loops.divergence, zeta=zeta, least=least, log_scale=log_scale)
        (divergence,) = self.total(answer, *fields)
        return float(potential / count - state.work / 2 + least), float(zeta * divergence / count)

    def newton_target(self, state: LawState, wanted: float) -> np.ndarray:
        """α (p̂ + δp̂) − (g + Gδp̂) of a Newton step.  Collective."""
        root, change, response = self.newton_step(state, wanted)
        target = self.grid.new_field()

        def aim(_: int, first: int, stop: int) -> None:
            rows = slice(first, stop)
            with np.errstate(over="ignore", invalid="ignore"):  # numbers of a diverging iteration
                pressure = state.pressure[rows] + root[rows] * change[rows]
                target[rows] = self.alpha * pressure - (state.gap[rows] + response[rows])

        self.grid.threads.share(aim, len(target), self.grid.band)
        return target

    def start(self, state: LawState, root: np.ndarray, residual: np.ndarray) -> tuple[float, float]:
        """Fills √p̂ and the right-hand side of Newton's equation; returns Σ residual² of it, and Σ p̂.  Collective."""
        fields = state.pressure, state.gap
        level = float(self.total(partial(self.law.moments, threshold=0.0), *fields)[0]) / self.grid.size
        first = partial(loops.newton_start, zeta=self.zeta, level=level)
        (square,) = self.total(first, *fields, root, residual)
        return float(square), float(self.grid.size)

    def newton_step(self, state: LawState, wanted: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """√p̂, y and G√p̂y (nx_local, ny) of a step δp̂ = √p̂ y; its linear residual falls by `wanted`.  Collective."""
        grid, zeta, real = self.grid, self.zeta, self.precision
        root, residual, direction, product, change, response = np.zeros((6, *grid.local_shape), real)
        square, mass = self.start(state, root, residual)
        goal, beta = wanted**2 * square, 0.0

        def fill(first: int, stop: int, block: np.ndarray) -> None:
            np.multiply(root[first:stop], direction[first:stop], out=block)

        def step(first: int, stop: int) -> float:
            rows = slice(first, stop)
            system, sums = (direction[rows], product[rows]), (change[rows], response[rows])
            return loops.step(root[rows], system, sums, residual[rows], numbers)

        def turn(residual: np.ndarray, direction: np.ndarray) -> None:
            direction *= real(beta)
            direction += residual

        for _ in range(MOST_INNER):
            if square <= goal:
                break
            self.each(turn, residual, direction)
            grid.convolve(fill, self.compliance[real], sink(product), real)
            curved, norm, along = self.total(loops.curvature_sums, root, direction, product)
            length = square / (curved + zeta * norm)
            numbers = real(along / mass), real(zeta), real(length)
            new = grid.reduction.sum(grid.threads.collect(step, len(root)))
            beta, square = new / square, new
            state.iterations += 1
        return root, change, response


class LawNewton(Newton):
    """Newton iterations for any wall whose pressure decreases with the gap, p = P(e), by its `gap_and_slope`.

    With the law's gap e and w = √(−P'(e)), the equation for δp̂ = w y is (1 + w G w) y = −w (g − e − c), Σ w y = 0; the
    pointwise step is that of `Newton`.  A step is shortened where the objective rises along it, by three values of its
    slope, ⟨g − e, p̂₁ − p̂₀⟩: that needs no energy of the law in closed form.
    """

    def __init__(self, problem: ContactProblem):
        super().__init__(problem)
        self.law_gap, self.slope = problem.grid.new_field(), problem.grid.new_field()

    def merits(self, state: LawState) -> Merits:
        """None: steps are judged by slopes."""
        return math.inf, math.inf

    def linearise(self, pressure: np.ndarray) -> None:
        """The law's gap e and −P'(e), at most `STIFFEST`/α, at pressures (nx_local, ny)."""
        self.each(self.problem.law.gap_and_slope, pressure, self.law_gap, self.slope)
        np.minimum(self.slope, STIFFEST / self.alpha, out=self.slope)

    def start(self, state: LawState, root: np.ndarray, residual: np.ndarray) -> tuple[float, float]:
        """Fills w and −w (g − e − c), c such that Σ w × that is 0; returns Σ of its squares, and Σ w².  Collective."""
        self.linearise(state.pressure)
        sums = self.grid.reduction
        mass = sums.sum(self.slope)
        away = state.gap - self.law_gap
        level = sums.dot(self.slope, away) / mass if mass > 0 else 0.0
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of a diverging iteration
            np.sqrt(self.slope, out=root, casting="same_kind")
            np.multiply(root, level - away, out=residual, casting="same_kind")
        return sums.dot(residual, residual), max(mass, np.finfo(float).tiny)

    def advance(self, state: LawState, wanted: float, before: Merits) -> Merits:
        """One Newton step, shortened while the objective rises along it.  Collective."""
        old, level = LawState(state.pressure.copy(), state.gap.copy()), state.level
        self.respond(state, self.newton_target(state, wanted), self.alpha)
        self.compute_gap(state)

        def slope(part: float) -> float:
            """⟨g − e − c, new − old⟩ at that part of the step, where g and p are linear; c only keeps digits."""
            change, scratch = state.pressure - old.pressure, self.slope  # which `start` fills anew
            if part > 0:
                np.multiply(change, part, out=scratch)
                scratch += old.pressure
                self.linearise(scratch)
            np.subtract(state.gap, old.gap, out=scratch)
            scratch *= part
            scratch += old.gap
            scratch -= self.law_gap
            scratch -= level
            return float(self.grid.reduction.dot(scratch, change))

        first = slope(0.0)
        for _ in range(MOST_SHORTENED):
            last = slope(1.0)
            if last <= abs(first) / 2 or first + 4 * slope(0.5) + last <= 0:  # Simpson's rule
                break
            self.step_back(old.pressure, old.gap, state)
            first *= BACK
        self.certify(state)
        return before


class Descent(Newton):
    """Newton's method on the displacement, each step of which lowers the dual objective: for contacts on which steps of
    `Newton` cycle, as under thin slabs, which bend like plates.  Overwrites a source q and its gap Gq − h.

    The dual of the problem is to minimise, without constraints,

        Φ(v) = ½⟨v, Kv⟩ + ζ ln⟨exp((h − v)/ζ)⟩    over the displacements v = Gq of sources q of mean 1 and either sign.

    Its gradient is q − σ, with the wall's answer σ = exp((h − v)/ζ)/⟨exp((h − v)/ζ)⟩, and its Newton step leads to the
    source σ + δp̂, where δp̂ is the step of `Newton` at p̂ = σ.  Φ is convex, so that a step that is short enough lowers
    it.  Few steps are needed if ζ is reduced from the rms height on.  σ is feasible, and is certified.

    The linear equations are solved in double precision: under a thin slab long waves of σ − q displace the surface far
    more than the step does, and conjugate gradients must cancel that.
    """

    precision = np.float64

    def __init__(self, problem: ContactProblem, source: LawState) -> None:
        super().__init__(problem)
        self.source = source

    def relax(self, state: LawState, tolerance: float, monitor: Callable[[LawState], None] | None = None) -> LawState:
        """As `Newton.relax`, by steps of the source; the state becomes the wall's answer to it.  Collective."""
        patience = Patience(MOST_DESCENT_STEPS // 2)
        self.answer(state)
        for _ in range(MOST_DESCENT_STEPS):
            self.certify(state)
            if monitor is not None:
                monitor(state)
            if self.arrived(state, tolerance):
                return state
            if not patience.take(state.error):
                break
            self.advance_source(state)
        raise self.failure(patience, state, tolerance)

    def answer(self, state: LawState) -> None:
        """Sets the state to the wall's answer σ to the source's gap, and its gap to Gσ − h.  Collective."""
        gap = self.source.gap
        np.exp((self.grid.reduction.min(gap) - gap) / self.zeta, out=state.pressure)
        state.pressure *= self.grid.size / self.grid.reduction.sum(state.pressure)
        self.compute_gap(state)

    def advance_source(self, state: LawState) -> float:
        """One step of the source, and the answer to it; returns what the slope promised to gain.  Collective."""
        source, dot = self.source, self.grid.reduction.dot
        root, y, _ = self.newton_step(state, DESCENT_CUT)
        new = LawState(state.pressure + root * y, np.empty_like(state.gap))
        self.compute_gap(new)
        change, gap_change = new.pressure - source.pressure, new.gap - source.gap
        promised = dot(state.pressure - source.pressure, gap_change)
        linear, square = dot(source.pressure, gap_change), dot(change, gap_change)
        before, step = self.free_energy(source.gap), 1.0
        for _ in range(HALVINGS):  # gain = Φ before − Φ after, as ½⟨v, Kv⟩ = ½⟨q, Gq⟩ is quadratic in the step
            gain = before - self.free_energy(source.gap + step * gap_change) - step * linear - step**2 / 2 * square
            if gain >= ENOUGH * step * promised or promised <= ROUNDED * abs(before):
                break
            step /= 2
        source.pressure += step * change
        source.gap += step * gap_change
        self.answer(state)
        return promised

    def free_energy(self, gap: np.ndarray) -> float:
        """ζ N ln⟨exp(−g/ζ)⟩.  Collective."""
        least, count = self.grid.reduction.min(gap), self.grid.size
        weight = self.grid.reduction.sum(np.exp((least - gap) / self.zeta))
        return count * (self.zeta * math.log(weight / count) - least)


def descend(
    softer: Iterable[ContactProblem], problem: ContactProblem, state: LawState, tolerance: float,
    monitor: Callable[[LawState], None] | None,
) -> LawState:  # fmt: skip
    """Solves `problem` from a flat displacement, under the `softer` walls in turn and then its own.  Overwrites and
    returns `state`.  Raises SolverError as `Newton.relax`.  Collective.
    """
    source = LawState(np.ones_like(problem.heights), -problem.heights)
    for soft in softer:
        solver = Descent(soft, source)
        solver.answer(state)
        for _ in range(MOST_DESCENT_STEPS):
            if solver.advance_source(state) <= SETTLED * solver.zeta * soft.grid.size:
                break
    return Descent(problem, source).relax(state, tolerance, monitor)

"""The response of a contact to a small further load while its contact set stays: stiffness, bounded from both sides.

With G the compliance (in a cell without the mean mode) and C the points with 0 < p < σ_Y, the change of the pressure
per change of its mean is the x that minimises ⟨x, Gx⟩/N among those with x = 0 outside C and mean 1.  Its minimum is
1/K, with K = dp̄/d(approach), in a cell −dp̄/dū (ū: mean gap).  For every such x, with S = ⟨x, Gx⟩/N,

    S − ⟨ε, G⁻¹ε⟩/N ≤ 1/K ≤ S,        ε = Gx − S on C,

whatever ε is outside C, since x* − x is 0 there and has mean 0.  ε is continued as for the hard wall, without its cuts.

Under the exponential wall G + D takes the place of G, D = ζ/p, and C is the whole plane.  Then

    S − ⟨ε₁, G⁻¹ε₁⟩/N − ⟨ε₂, D⁻¹ε₂⟩/N ≤ 1/K ≤ S,        ε₁ + ε₂ = (G + D)x − S.

With the compliance α of a few pixels in place of G, ε₁ = αε/(α + D) gives the least bound point by point.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.transforms import sink, source
from pgfmd.parallel.collectives import shared
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import Precision, Relaxation, State
from pgfmd.solvers.active_set.conjugate_gradients import FREE, ConjugateGradients
from pgfmd.solvers.active_set.continuation import HUGE
from pgfmd.solvers.active_set.particle_mesh import inner_response
from pgfmd.solvers.active_set.preconditioner import MultilevelStiffness
from pgfmd.solvers.active_set.unknowns import SetVector, Unknowns
from pgfmd.solvers.law_operations import PIXELS, local_compliance
from pgfmd.solvers.second_order import energy_of_residual

CUT = 0.03  # factor on the residual at the start
LEAST_CUT = 0.01  # in one round of conjugate gradients: to 1e-6 5.1 pairs at f_c .81, with .02 6.3
LAST = 0.6  # in the last round, over the factor that would just do: to 1e-6 4.3 pairs, 5.9 at worst, not 4.5, 6.2
MOST_ROUNDS = 12
MOST_ITERATIONS = 3000  # under an exponential wall
PART = 0.6  # ⟨r, Mr⟩/⟨x, Gx⟩ of a residual r and the preconditioner M over the width of the bounds, about
TOO_WIDE = 1.3  # estimated width over that asked for above which bounds are not computed, which saves half a pair
CROWDED = 0.7  # share of points in contact from which the uniform x is a better start than the mesh's
DOUBLE_TO = 10.0  # a response is in double precision where the expected width is at most this times that asked for
SINGLE_FROM = 1e-4  # width of the bounds from which transforms in single precision suffice


class Increment(NamedTuple):
    """x (nx_local, ny), the change of the pressure per that of its mean, 0 outside a hard wall's contact; bounds of K,
    pressure per length; transform pairs.
    """

    pressure: np.ndarray
    lower: float
    upper: float
    transforms: float


class FixedContact(Relaxation):
    """The linear problem on the contact set of a pressure (nx_local, ny).  Collective to make."""

    def __init__(self, problem: ContactProblem, pressure: np.ndarray, width: float) -> None:
        """width: that the bounds of K may have, relative."""
        grid, solid, highest = problem.grid, problem.solid, problem.law.highest
        self.unit = float(solid.compliance(np.array(2 * math.pi / max(grid.lengths))))  # of displacements per x
        solid = solid.in_units(self.unit, 1.0)
        super().__init__(dataclasses.replace(problem, solid=solid))
        self.width = width
        self.real: Precision = np.float32 if width >= SINGLE_FROM else np.float64
        # 1: in C, 2: at the largest pressure
        self.place = (pressure > 0).astype(np.int8) + (pressure >= highest).view(np.int8)
        self.highest = 2.0
        gap = np.array([0, 0, 0], np.float32)[self.place]
        self.points = Unknowns(grid, (self.place, gap), 0.0, self.highest)
        gap[self.place == 0], gap[self.place == 2] = HUGE, -HUGE  # no limit there on the continued ε
        self.state = State(self.place, gap)
        mean, action = solid.mean_mode(grid), self.compliance[np.float32]
        self.inner = inner_response(grid, solid.half_space_compliance, solid.compliance, action, mean)
        self.preconditioner = MultilevelStiffness(grid, solid.half_space_stiffness, solid.stiffness)

    def solve(self) -> Increment:
        """The x whose bounds are as near as asked.  Collective."""
        grid, points, reduction = self.grid, self.points, self.grid.reduction
        before, count = grid.transforms, int(reduction.sum(self.points.count))
        if count == 0 or count == grid.size and grid.domain.wraps:  # no contact, or nothing but the mean mode
            stiffness = math.inf if count else 0.0
            return Increment(np.full(grid.local_shape, count / grid.size), stiffness, stiffness, 0.0)
        operators, x = (self.inner.apply, self.preconditioner.apply), np.ones(points.count)
        expected, former, best = 1.0, math.inf, (0.0, math.inf)  # expected and former width; best bounds of 1/K
        if count < CROWDED * grid.size:
            one = SetVector(points)
            one.own[:] = 1
            x[:] = ConjugateGradients(one, *operators, FREE).solve(CUT)[0]
            expected = CUT**2
        for left in reversed(range(MOST_ROUNDS)):
            x *= grid.size / reduction.sum(x)
            real = self.real if expected <= DOUBLE_TO * self.width or left == 0 else np.float32
            value = self._respond(x, real)
            system = ConjugateGradients(points.below(0.0, self.state.gap), *operators)
            energy = self.state.energy  # rounding may make it negative where nearly all points are in contact
            width = system.square / (2 * energy) / PART if energy > 0 else math.inf
            near = width <= TOO_WIDE * self.width or width > former / 2 or left == 0
            if near and real is not self.real:
                expected = 0.0
                continue
            former = width
            if near:
                if not energy > 0:
                    raise SolverError("stiffness: the response is lost in rounding; allow a larger width")
                # The computed response has an error e: |⟨x, e⟩| ≤ ‖x‖_G ‖e‖_K.
                slack = value * math.sqrt(self.rounding_bound(self.state, self.real) / energy)
                lower, upper = value * (1 - 2 * self.bound(self.state, self.real)) - slack, value + slack
                stuck = upper - lower > (best[1] - best[0]) / 2
                best = max(best[0], lower), min(best[1], upper)
                width = (best[1] - best[0]) / best[1]
                if width <= self.width or stuck or left == 0:
                    break
            goal = LAST * math.sqrt(self.width / width)
            wanted = goal ** (1 / math.ceil(math.log(goal) / math.log(LEAST_CUT)))
            x += system.solve(wanted)[0]
            expected = wanted**2 * width
        upper = 1 / (best[0] * self.unit) if best[0] > 0 else math.inf
        field = grid.new_field()
        field[...] = 0
        field[self.place == 1] = x
        return Increment(field, 1 / (best[1] * self.unit), upper, grid.transforms - before)

    def free(self) -> None:
        """Frees the transforms of the inner solver.  Collective."""
        super().free()
        self.preconditioner.free()

    def _respond(self, x: np.ndarray, real: Precision) -> float:
        """S = ⟨x, Gx⟩/N of x (count,) of mean 1, in this object's units; sets the residual.  Collective."""
        grid, place, offsets, response = self.grid, self.place, self.points.lists[1], np.empty_like(x)

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            rows[...] = 0
            rows[place[first:stop] == 1] = x[offsets[first] : offsets[stop]]

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            response[offsets[first] : offsets[stop]] = rows[place[first:stop] == 1]

        grid.convolve(fill, self.compliance[real], drain, real)
        pairs = (x, response), (x, x), (response, response)
        work, *squares = grid.reduction.sums(*(np.vdot(*pair) for pair in pairs))
        value, state = float(work) / grid.size, self.state
        state.gap[place == 1] = response - value
        state.energy, self.squares = float(work) / 2, np.array(squares)
        return value


def wall_increment(problem: ContactProblem, pressure: np.ndarray, width: float) -> Increment:
    """The same under an exponential wall, by conjugate gradients for (1 + √p G/ζ √p) y = √p, x ∝ √p y, whose residual
    is √p ε/ζ, in double precision.  Collective.
    """
    grid, reduction, law = problem.grid, problem.grid.reduction, problem.law
    assert isinstance(law, ExponentialWall)
    before, size, unit = grid.transforms, grid.size, problem.mean_pressure / law.zeta
    solid = problem.solid.in_units(law.zeta, problem.mean_pressure)  # displacements over ζ, which may be tiny
    respond, stiffness = (
        apply(grid, real, 1 / grid.modes)
        for apply, real in ((solid.apply_compliance, np.float64), (solid.apply_stiffness, np.float32))
    )
    alpha = local_compliance(dataclasses.replace(problem, solid=solid), PIXELS)
    root = np.sqrt(pressure / problem.mean_pressure)
    residual, direction, y, product = root.copy(), root.copy(), np.zeros_like(root), np.empty_like(root)

    square = goal = reduction.dot(residual, residual)
    for iteration in range(MOST_ITERATIONS):
        grid.convolve(source(root * direction), respond, sink(product))
        product *= root
        product += direction
        curvature = reduction.dot(direction, product)
        stuck = not curvature > 0  # the residual is nothing but rounding
        if not stuck:
            y += square / curvature * direction
            residual -= square / curvature * product
        last, square = square, reduction.dot(residual, residual)
        if square <= goal or stuck or iteration == MOST_ITERATIONS - 1:
            grid.convolve(source(root * y), respond, sink(product))
            residual[...] = root - y - root * product  # the updated one drifts from that of y
            square = reduction.dot(residual, residual)
            upper = size * reduction.dot(y, root - residual) / reduction.dot(root, y) ** 2
            share = alpha * root**2 + 1  # ε₁ = α √p r/share, and ε₂²/D = (r/share)²
            energy, _ = energy_of_residual(grid, source(alpha * root * residual / share), stiffness)
            rest = reduction.dot(residual / share, residual / share)
            lower = upper - upper**2 * (2 * energy + rest) / size
            if upper - lower <= width * upper or stuck:
                break
            goal = square * max(CUT**2, width * upper / (upper - lower) / 2)
        direction *= square / last
        direction += residual
    y *= root
    y *= size / reduction.sum(y)
    return Increment(y, unit / upper, unit / lower if lower > 0 else math.inf, grid.transforms - before)


def increment(problem: ContactProblem, pressure: np.ndarray, width: float) -> Increment:
    """The response of a solved contact of that pressure (nx_local, ny) to a small further load, to a relative `width`
    of the bounds of K.  Raises InputError for laws other than hard, hardness and exponential.  Collective.
    """
    if isinstance(problem.law, ExponentialWall):
        return wall_increment(problem, pressure, width)
    if "active-set" not in problem.law.methods:
        raise InputError(f"stiffness: walls of kind {problem.law.kind} have none; kinds: hard, hardness, exponential")
    contact = FixedContact(problem, pressure, width)
    try:
        found = contact.solve()
    except BaseException as error:
        if shared(problem.grid.comm, error):  # else the ranks that have no error would not come
            contact.free()
        raise
    contact.free()
    return found

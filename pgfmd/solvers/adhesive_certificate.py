"""How far a state is from the minimum of the energy next to it: an estimate by Lanczos iterations, and a proof.

With A = K + s, E(g) − E(g*) ≤ e = ⟨r, A⁻¹r⟩/2 and |g − g*| ≤ t at each point if A ≥ θP⁻¹ and t ≥ 2√(2G(0)e/θ): the
energy is at least that of the quadratic form within t of the gaps, and at the rim exceeds that of g.  With D̄, the
largest −W'' at gaps within t, s = −D̄ at free points, and s = 2b/t − D̄ at points that touch, pressed by b more than
the law's tension.  P is the compliance between the points where s < 1/G(0), and 1/s on the others: K + max(s, 0) ≥ P⁻¹.
Conjugate gradients give e, with what they leave, ⟨r', Pr'⟩/2θ, added.  Functions return e per point.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction, source
from pgfmd.physics.laws.adhesive_laws import AdhesiveWall
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.adhesive import AdhesiveContact
from pgfmd.solvers.adhesive_inner import Steps, apply, conjugate_gradients, decrement, least_ritz, masked
from pgfmd.solvers.adhesive_model import Actions, AdhesiveState, Hold

LEAST_STEPS, LANCZOS = 12, 24  # least and most steps that estimate θ
ROUNDING = 1e-12  # share of ⟨r, Pr⟩ beyond which single precision makes Ritz values of its own
SURE = 0.1  # residual norm of the least Ritz value, over it, at which iterations end
SHAKE = 0.05  # noise in the start over the residual, in the norm of P: finds what the residual does not hold
RITZ = 0.9  # part of the least Ritz value less its residual that counts as θ
PART = 0.45  # of the estimated θ, for which a proof is tried: less proves few more, in a larger distance t
WORTH = 0.2  # least estimate of θ with which one is: K_M is too soft for smaller ones
MOST_PROOF = 40  # most iterations of a proof for each of GOALS
GOALS = 2e-4, 1e-3  # shares of ⟨r, Pr⟩ that a first round leaves of Mv = 1, and one that goes on of that
SWEEPS, BEYOND = 3, 1.4  # Jacobi iterations at most, which mend single points, and their relaxation
LARGEST = 100.0  # of 1/G(0) that s counts at most: more would give the same, by more iterations
MARGIN = 1.2  # of a distance t over what an expected bound asks for
LITTLE = 0.05  # distance t over θ that hardly changes θ
LEFT = 0.36  # share of ⟨r, Pr⟩ over θ that is left where the energy error is computed
ROUNDED = 1.001  # factor on the energy error, for rounding in single precision
POSITIVE = 1e-3  # least value of Mv, of which 1 was asked, that rounding in double precision cannot make of one ≤ 0
Stiffening = Callable[[slice], np.ndarray]  # of some rows, added to K


def estimated(contact: AdhesiveContact, state: AdhesiveState, hold: Hold, far: float) -> tuple[float, float, float]:
    """(θ, bound e of E − E* of the local minimum per point, least t that e allows), with D̄ for t = far.  Collective.

    θ is `RITZ` of the least eigenvalue of PA, 1 without D̄, by the conjugate gradients that give e: the least Ritz value
    less the norm of its residual, which is right if the start holds that eigenvector.  0 where it is not above that.
    With noise n added to r, √⟨r, A⁻¹r⟩ is at most that of the sum plus √(⟨n, Pn⟩/θ).
    """
    start, weight, actions = firm(contact, state, hold, stiffening(contact, state, hold, far))
    more = shake(contact, start, hold, actions, state.square / state.residual**2 if state.residual else 0.0)

    def error(first: float, steps: Steps, floor: float) -> float:
        both = decrement(first, steps, floor), more / floor
        return ROUNDED * (state.residual * sum(map(math.sqrt, both))) ** 2 / 2

    def enough(_: float, left: float, steps: Steps) -> bool:
        if len(steps) < LEAST_STEPS or left <= ROUNDING:
            return left <= ROUNDING
        floor, rest = least_ritz(steps)
        return left <= LEFT * floor and rest <= SURE * floor

    _, negative, first, steps = conjugate_gradients(contact, start, weight, actions, enough, LANCZOS)
    floor, rest = least_ritz(steps)
    floor = 0.0 if negative else max(RITZ * (floor - rest), 0.0)
    bound = error(first, steps, floor) if floor else math.inf
    return floor, bound, distance(contact, hold, floor, bound)


def firm(
    contact: AdhesiveContact, state: AdhesiveState, hold: Hold, added: Stiffening
) -> tuple[np.ndarray, np.ndarray, Actions]:
    """Start, weight and actions of conjugate gradients for A⁻¹r.  Collective."""
    start = contact.residual(state, hold)
    contact.count, weight = contact.grid.size, softened(contact, added)
    return start, weight, contact.actions(hold)._replace(firm=True)


def shake(contact: AdhesiveContact, start: np.ndarray, hold: Hold, actions: Actions, square: float) -> float:
    """Adds noise n on the free points to a start whose ⟨r, Pr⟩ per point is about `square`; returns ⟨n, Pn⟩ per point.
    The noise is the same on any number of ranks.  Collective.
    """
    grid, seed = contact.grid, np.random.default_rng(7)
    added = grid.new_field(np.float32)
    seed.bit_generator.advance(grid.rows.start * grid.shape[1])  # type: ignore[attr-defined]
    for row, free in zip(added, contact.free, strict=True):
        row[...] = (seed.random(row.shape) - 0.5) * free
    if hold.fixed:
        added -= np.float32(grid.reduction.sum(added) / grid.size)
    own, _ = apply(
        grid, actions.soften, source(added), lambda rows, s: masked(rows, added[s], contact.free[s], contact.image[s])
    )
    if not own > 0:
        return 0.0
    share = SHAKE * math.sqrt((square if 0 < square < math.inf else contact.local) * grid.size / own)
    added *= np.float32(share)
    start += added
    return share**2 * own / grid.size


def distance(contact: AdhesiveContact, hold: Hold, floor: float, bound: float) -> float:
    """The least t for θ = floor and that bound of the energy error per point."""
    square = 2 * local_compliance(contact, hold) * bound * contact.grid.size
    return 2 * math.sqrt(square / floor) if floor > 0 else math.inf


def energy_error(contact: AdhesiveContact, state: AdhesiveState, hold: Hold, added: Stiffening, floor: float) -> float:
    """The bound e of the energy error per point, for s = `added` and θ = floor.  Collective."""
    _, negative, first, steps = conjugate_gradients(
        contact, *firm(contact, state, hold, added), lambda _, left, __: left <= LEFT * floor
    )
    return math.inf if negative else ROUNDED * state.residual**2 * decrement(first, steps, floor) / 2


def local_compliance(contact: AdhesiveContact, hold: Hold) -> float:
    """G(0), with the mean's share where that is free."""
    mean = 0.0 if hold.fixed else min(1 / (hold.spring or 1e-300), contact.softest)
    return contact.local + mean / contact.grid.size


def stiffening(contact: AdhesiveContact, state: AdhesiveState, hold: Hold, far: float) -> Stiffening:
    """−D̄ of the free points, 2b/t − D̄ of others, D̄ the largest −W'' within t.  Collective."""
    contact.residual(state, hold)  # chooses the free points
    free, factor = contact.free.copy(), 2 / max(far, 1e-100)

    def added(s: slice) -> np.ndarray:
        out = contact.slope(state, s)
        with np.errstate(over="ignore"):  # at most `LARGEST` below
            out *= factor * ~free[s]
        out -= contact.law.steepest(state.gap[s], far)
        return np.minimum(out, LARGEST / contact.local, out=out)

    return added


def softened(contact: AdhesiveContact, added: Stiffening) -> np.ndarray:
    """−`added` in single precision; the points where that is more than −1/G(0) become the free ones."""
    out = contact.grid.new_field(np.float32)

    def fill(s: slice) -> None:
        np.negative(added(s), out=out[s], casting="same_kind")
        np.greater(out[s], -1 / contact.local, out=contact.free[s])

    contact.rows(fill)
    return out


def proved(
    contact: AdhesiveContact, state: AdhesiveState, hold: Hold, floor: float, expected: float
) -> tuple[float, float, float] | None:
    """(θ, e, t) with a θ that is proved, `PART` of the estimate `floor`; None if the proof fails.  expected: about e.
    Collective.

    With K_M, of symbol ½E'√(4 sin²(q_x a/2)/a² + 4 sin²(q_y b/2)/b²), K ≥ K_M and K_M has no positive entry off its
    diagonal, as the root of a discrete Laplacian.  So M = (1 − θ)K_M + s, with (1 − θ)s where
    that is above 1/G(0), is positive definite if Mv > 0 for some v > 0 (Berman and Plemmons 1994,
    doi:10.1137/1.9781611971262, chapter 6), and then A ≥ θP⁻¹.  M may stiffen the mean as far as its entries allow: at
    a mean gap by anything, at a load by the spring less θ times the stiffness of the mean in P⁻¹.
    For periodic half-spaces and the exponential attraction, whose D̄ is that of the smallest gap.
    """
    problem, grid = contact.problem, contact.grid
    solid = problem.solid
    if not (grid.domain.wraps and isinstance(solid, Homogeneous) and math.isinf(solid.thickness)):
        return None
    if not isinstance(contact.law, AdhesiveWall) or floor < WORTH:
        return None
    modulus = solid.in_units(contact.length, contact.pressure).contact_modulus
    mean = 0.0 if hold.fixed else max(hold.spring, 1 / contact.softest)
    floor *= PART
    far = max(MARGIN * distance(contact, hold, floor, expected), LITTLE * floor)
    modulus *= (1 - floor) / 2
    contact.coupling = contact.coupling or least_coupling(grid)
    extra = 0.999 * modulus * contact.coupling * grid.size
    stiff = extra if hold.fixed else min(extra, hold.spring - floor * mean)
    action = contact.with_mean(smaller_stiffness(grid, modulus), stiff)
    added = stiffening(contact, state, hold, far)

    def part(s: slice) -> np.ndarray:
        out = added(s)
        return np.multiply(out, 1 - floor, out=out, where=out > 1 / contact.local)

    if not is_m_matrix(contact, action, part, stiff):
        return None
    bound = energy_error(contact, state, hold, added, floor)
    return (floor, bound, far) if far >= distance(contact, hold, floor, bound) else None


def least_coupling(grid: SlabGrid) -> float:
    """The least −K_M between two points, for ½E' = 1.  Collective."""
    most, first_here = list[float](), grid.rows.start == 0

    def impulse(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = 0
        rows[:1, :1] = first == 0 and first_here

    def keep(first: int, stop: int, block: np.ndarray) -> None:
        block[:1, :1] -= 1e300 * (first == 0 and first_here)
        most.append(float(block.max()))

    grid.convolve(impulse, smaller_stiffness(grid, 1.0), keep)
    return -grid.reduction.max(most)


def smaller_stiffness(grid: SlabGrid, factor: float) -> ColumnAction:
    """Column action of factor · √(4 sin²(q_x a/2)/a² + 4 sin²(q_y b/2)/b²) with spacings a and b, over the points."""
    a, b = grid.spacing
    x, y = (2 / a * np.sin(grid.qx * a / 2)) ** 2, (2 / b * np.sin(grid.qy * b / 2)) ** 2

    def act(block: np.ndarray, first: int, stop: int) -> None:
        block *= factor / grid.size * np.sqrt(x + y[first:stop])

    return act


def is_m_matrix(contact: AdhesiveContact, action: ColumnAction, added: Stiffening, mean: float) -> bool:
    """Whether a v > 0 with Mv > 0 was found, where M is the action, of that `mean` stiffness, plus what is `added`,
    which decides the free points.  Collective.

    Conjugate gradients for Mv = 1 and Jacobi iterations at points where it is less, in single precision: any v will do
    if the test at the end, in double, passes.
    """
    grid, soften = contact.grid, contact.with_mean(contact.compliance, 1 / max(mean, 1 / contact.softest))
    actions, least = Actions(soften, action, False, True), list[float]()
    weight, left = softened(contact, added), grid.new_field(np.float32)
    left[...] = 1
    v = np.zeros_like(left)

    def keep(first: int, stop: int, rows: np.ndarray) -> None:
        rows += added(slice(first, stop)) * v[first:stop]
        np.subtract(1, rows, out=left[first:stop], casting="same_kind")
        least.append(-float(rows.min()))

    def raise_low(s: slice) -> None:
        v[s] += BEYOND * np.maximum(left[s], 0) / (1 / contact.local + added(s))

    for goal in GOALS:
        found, negative, _, _ = conjugate_gradients(
            contact, left, weight, actions, lambda _, part, __, goal=goal: part <= goal, MOST_PROOF  # type: ignore[misc]
        )
        np.add(v, found, out=v)
        del found
        if negative:
            return False
        for _ in range(SWEEPS):
            contact.rows(raise_low)
            if grid.reduction.min(v) <= 0:
                break
            least.clear()
            grid.convolve(source(v), action, keep)
            if grid.reduction.max(least) < -POSITIVE:
                return True
    return False

"""How far a state is from the minimum of the energy next to it: an estimate by Lanczos iterations, and a proof.

E(g) − E(g*) ≤ ⟨r, Gr⟩/2ν and |g − g*| ≤ t at each point if K + κ − D̄ ≥ νK and t ≥ 2√(G(0)⟨r, Gr⟩)/ν: the energy is
convex where gaps change by at most t, and at its rim exceeds that of g.  D̄ is the largest −W'' within t of a free gap;
κ = 2b/t − D̄ where the points touch, pressed by b more than the law's tension.
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction, sink
from pgfmd.physics.laws.adhesive_laws import AdhesiveWall
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.adhesive import AdhesiveContact
from pgfmd.solvers.adhesive_inner import conjugate_gradients, least_ritz
from pgfmd.solvers.adhesive_model import AdhesiveState, Hold

LANCZOS = 20  # steps: right to 10 % in 10 of 12 states
PART = 0.5  # of the estimated ν, for which a proof is tried
WORTH = 0.2  # least estimate of ν with which one is: K_M is too soft for smaller ones
MOST_PROOF = 40  # conjugate gradients of a proof
LARGEST = 100.0  # of the diagonal of K that κ counts at most: more would be proved as well, by more iterations
POSITIVE = 1e-3  # least value of Mv, of which 1 was asked, that rounding in double precision cannot make of one ≤ 0


def estimated(contact: AdhesiveContact, state: AdhesiveState, hold: Hold) -> tuple[float, float, float]:
    """(ν, bound on E − E* of the local minimum per point, distance t of its gaps), ν by Lanczos iterations on the free
    points.  Collective.
    """
    contact.residual(state, hold)  # chooses the free points
    grid, square = contact.grid, state.square * contact.grid.size
    far, floor = 4 * math.sqrt(contact.local * square) / max(state.curvature, 1e-3), 0.0
    for _ in range(3):
        noise = grid.new_field(np.float32)
        seed = np.random.default_rng(7)
        seed.bit_generator.advance(grid.rows.start * grid.shape[1])  # type: ignore[attr-defined]
        noise[...] = (seed.random(noise.shape) - 0.5) * contact.free
        total = grid.reduction.sum(noise)
        if hold.fixed and contact.count:
            noise -= np.float32(total / contact.count) * contact.free
        weight = contact.weight(state.gap, far)
        _, negative, _, steps = conjugate_gradients(contact, noise, weight, hold, lambda _: 1e-4, LANCZOS)
        floor = min(floor, 0.0) if negative else least_ritz(steps)
        if negative or far >= 2 * math.sqrt(contact.local * square) / floor:
            break
        far *= 2
    return floor, square / (2 * floor) / grid.size if floor > 0 else math.inf, far


def proved(
    contact: AdhesiveContact, state: AdhesiveState, hold: Hold, floor: float
) -> tuple[float, float, float] | None:
    """The same with a ν that is proved, at most the estimate `floor`; None if the proof fails.  Collective.

    With K_M, whose symbol is ½E'√(4 sin²(q_x a/2) + 4 sin²(q_y b/2)) in units of the spacings, K ≥ K_M and K_M has no
    positive entry off its diagonal, as the root of a discrete Laplacian.  So M = (1 − ν)K_M + κ − D̄ is positive
    definite if Mv > 0 for some v > 0 (Berman and Plemmons 1994, doi:10.1137/1.9781611971262, chapter 6), and then
    K + κ − D̄ ≥ νK.  M may stiffen the mean as far as its entries allow: at a mean gap by anything, at a load by the
    spring less ν times the stiffness of the mean with which ⟨r, Gr⟩ was computed.
    For periodic half-spaces and the exponential attraction, whose D̄ is that of the smallest gap.
    """
    problem, grid = contact.problem, contact.grid
    solid = problem.solid
    if not (grid.domain.wraps and isinstance(solid, Homogeneous) and math.isinf(solid.thickness)):
        return None
    if not isinstance(contact.law, AdhesiveWall) or floor < WORTH:
        return None
    contact.residual(state, hold)  # chooses the free points
    modulus = solid.in_units(contact.length, contact.pressure).contact_modulus
    square, mean = state.square * grid.size, 0.0 if hold.fixed else max(hold.spring, 1 / contact.softest)
    local = contact.local + (0.0 if hold.fixed else 1 / mean / grid.size)
    floor *= PART
    far, diagonal = 2.01 * math.sqrt(local * square) / floor, modulus / min(grid.spacing)
    added = np.where(
        contact.free,
        contact.law.curvature(np.maximum(state.gap - far, 0.0)),
        np.minimum(2 * contact.slope(state, slice(None)) / max(far, 1e-300) - 1, LARGEST * diagonal),
    )
    smaller = smaller_stiffness(grid, modulus / 2 * (1 - floor))
    impulse = np.zeros_like(added)
    first_here = grid.rows.start == 0 and len(impulse) > 0
    if first_here:
        impulse[0, 0] = 1
    row = times(grid, smaller, impulse)
    if first_here:
        row[0, 0] = -np.inf
    extra = -0.999 * grid.reduction.max(row) * grid.size
    action = contact.with_mean(smaller, extra if hold.fixed else min(extra, hold.spring - floor * mean))
    if not is_m_matrix(grid, action, added, diagonal):
        return None
    return floor, square / (2 * floor) / grid.size, far


def smaller_stiffness(grid: SlabGrid, factor: float) -> ColumnAction:
    """Column action of factor · √(4 sin²(q_x a/2)/a² + 4 sin²(q_y b/2)/b²) with spacings a and b, over the points."""
    a, b = grid.spacing
    x, y = (2 / a * np.sin(grid.qx * a / 2)) ** 2, (2 / b * np.sin(grid.qy * b / 2)) ** 2

    def act(block: np.ndarray, first: int, stop: int) -> None:
        block *= factor / grid.size * np.sqrt(x + y[first:stop])

    return act


def times(grid: SlabGrid, action: ColumnAction, field: np.ndarray) -> np.ndarray:
    """The field (nx_local, ny) after a column action.  Collective."""
    out = np.empty_like(field)

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = field[first:stop]

    grid.convolve(fill, action, sink(out))
    return out


def is_m_matrix(grid: SlabGrid, action: ColumnAction, added: np.ndarray, diagonal: float) -> bool:
    """Whether a v > 0 with Mv > 0 was found, where M is the action plus `added` (nx_local, ny).  Collective.

    Conjugate gradients for Mv = 1, preconditioned by the diagonal; M has the order of `diagonal` there.
    """

    def least(field: np.ndarray) -> float:
        return -grid.reduction.max(-field)

    jacobi = (1 / np.maximum(diagonal / 2 + added, diagonal / 10)).astype(np.float32)
    # In single precision: any v will do if the test at the end, in double, passes.
    v, residual, search, before = np.zeros_like(jacobi), np.ones_like(jacobi), np.zeros_like(jacobi), math.inf
    for _ in range(MOST_PROOF):
        z = jacobi * residual
        square = grid.reduction.dot(residual, z)
        search *= np.float32(square / before)
        search += z
        del z
        image = times(grid, action, search)
        np.add(image, added * search, out=image, casting="same_kind")
        bend = grid.reduction.dot(search, image)
        if not bend > 0:
            return False
        v += np.float32(square / bend) * search
        image *= np.float32(square / bend)
        residual -= image
        del image
        before = square
        if least(v) > 0 and least(-residual) > 2 * POSITIVE - 1:
            proof = times(grid, action, v.astype(np.float64))
            proof += added * v
            return least(proof) > POSITIVE
    return False

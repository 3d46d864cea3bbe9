"""The certificate of second order, for any convex law.

With the dual energy φ(p) of a law and its conjugate ψ(g) = sup over p of −p g − φ(p), a point of pressure p and gap g
has the excess φ(p) + p g + ψ(g) ≥ 0, which is 0 where the law is obeyed.  For a feasible p with gap g = Gp − h, any
level λ and any field ε

    J(p) − J(p*) ≤ ½⟨ε, Kε⟩ + Σ excess(p, g − λ − ε),        K = G⁻¹ (stiffness; the mean, q = 0, is left out):

with d = p* − p, whose sum is 0, J(p*) − J(p) = ⟨g − λ, d⟩ + ½⟨d, Gd⟩ + Σ φ(p*) − φ(p), where ⟨ε, d⟩ + ½⟨d, Gd⟩ ≥
−½⟨ε, Kε⟩ and Σ (g − λ − ε) p* + φ(p*) ≥ −Σ ψ(g − λ − ε).  The best ε would give the error itself; point by point, with
the compliance α of a few pixels in place of G, it is ε = α (p − p⁺) with the law's answer p⁺, where α p⁺ − gap(p⁺) =
α p − (g − λ).  A gap that is computed with an error e adds ‖e‖_K to ‖ε‖_K (`Rounding`).
"""

from __future__ import annotations

import math

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction, RowAction
from pgfmd.parallel.compiled import compiled
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.solid import Solid

DIGITS = 4.0  # relative error of pressures, from transforms and from their last digits, in units of the last digit
LEAST_ERROR = 1e-24  # certified error below which the level's error is that of rounding, a few 1e-12, not √error
SINGLE = 1e-3  # relative error of ‖ε‖_K, from a transform in single precision
ROUNDING = 1.0, 1.8  # error of a convolution over its input's, per √log₂ 2N, without and with primes above 13 in N
SYMBOL = 4.0  # relative error of compliance and stiffness, in units of the last digit: measured at most 2
COLUMNS = 16  # of the spectrum at a time, so that NumPy's temporary arrays stay in cache


def energy_of_residual(grid: SlabGrid, fill: RowAction, stiffness: ColumnAction) -> tuple[float, float]:
    """½Σ ε Kε and Σ (Kε)² of the field ε that `fill` makes, in single precision, by half a transform; stiffness: acts
    as K over the number of points.  Collective.
    """
    parts: dict[int, tuple[float, ...]] = {}

    def act(block: np.ndarray, first: int, stop: int) -> None:
        before = block.copy()
        stiffness(block, first, stop)
        before, after = (part.view(np.float32).reshape(*part.shape, 2) for part in (before, block))
        weights = grid.hermitian_weight[first:stop, 0]
        parts[first] = spectral_dots(before, after, weights)

    grid.read_spectrum(fill, act, np.float32)
    square, change = grid.reduction.sums_of_blocks(parts, 2)
    return float(square) / 2, float(change) * grid.modes


@compiled()
def spectral_dots(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Σ_j weights[j] Σ_i Re(a* b), and the same of b* b; the last axis of a and b holds (real, imaginary)."""
    product = square = 0.0
    for j in range(a.shape[0]):
        of_row = square_of_row = 0.0
        for i in range(a.shape[1]):
            x, y = np.float64(b[j, i, 0]), np.float64(b[j, i, 1])
            of_row += a[j, i, 0] * x + a[j, i, 1] * y
            square_of_row += x * x + y * y
        product += weights[j] * of_row
        square += weights[j] * square_of_row
    return product, square


class Rounding:
    """A bound of rounding errors on one grid.  Collective to make.

    Rounding errors of transforms are white, in the input and in the output.  So ‖e‖²_K is the mean of K over all modes
    times the squared error of the displacement, plus the mean of G times that of the pressure, plus the rounding of the
    heights themselves, in the precision in which they are stored, plus ⟨p, Gp⟩ times the squared error of G.

    means: of compliance and stiffness over all modes; digit: of stored heights
    """

    def __init__(self, grid: SlabGrid, solid: Solid) -> None:
        columns, counts = grid.spectral_shape[0], grid.even_weight

        def part(first: int, stop: int) -> list[float]:
            compliance, weights = solid.modes(grid, first, stop), grid.hermitian_weight[first:stop, 0]
            stiffness = np.divide(1.0, compliance, out=np.zeros_like(compliance), where=compliance > 0)
            return [float(weights @ (symbol @ counts)) for symbol in (compliance, stiffness)]

        solid.modes(grid, 0, 0)  # collective, where the domain has a border
        sums = np.sum(grid.threads.collect(part, columns, COLUMNS), axis=0) if columns else np.zeros(2)
        self.means = grid.reduction.sums(*sums) / grid.modes
        primes = any(pow(30030, 64, n) for n in grid.torus)  # whether a prime above 13 divides n
        self.digit = float(np.finfo(grid.storage).eps)
        self.factor = ROUNDING[primes] * math.sqrt(math.log2(2 * grid.modes))

    def bound(
        self, squares: np.ndarray, heights_squared: float, work: float, precision: type[np.floating] = np.float64
    ) -> float:
        """A bound of ½‖e‖²_K for the error e of a gap computed in that precision.

        squares: its Σ p² and Σ u²; heights_squared: Σ h² + (h − max h)², as heights may be measured first from the
        highest point, then from their mean; work: Σ p u.
        """
        digit, last = float(np.finfo(precision).eps), self.digit
        unit, compliance, stiffness = self.factor * digit / 2, float(self.means[0]), float(self.means[1])
        transforms = unit**2 * (compliance * float(squares[0]) + stiffness * float(squares[1]))
        return (transforms + last**2 * stiffness * heights_squared + (SYMBOL * digit) ** 2 * work) / 2


def last_digits(problem: ContactProblem, square: float, softness: float) -> float:
    """A bound of the energy of errors δ in the last digits of a stored pressure, ½⟨δ, Gδ⟩ + ½⟨δ, φ''δ⟩ per point, which
    the certificate does not contain.  square: ⟨p²⟩; softness: ⟨p² φ''⟩ (`ContactLaw.softness`).
    """
    longest = np.array(2 * math.pi / max(problem.grid.period))
    digit = DIGITS * float(np.finfo(problem.grid.storage).eps)
    return digit**2 / 2 * (square * float(problem.solid.compliance(longest)) + softness)


def certified(square: float, rounding: float) -> float:
    """The bound of ½‖ε + e‖²_K; square: the computed ½‖ε‖²_K, rounding: `Rounding.bound` of ½‖e‖²_K."""
    return ((1 + SINGLE) * math.sqrt(square) + math.sqrt(rounding)) ** 2

"""Makes the pressure of clipped gaps feasible while each block of pixels keeps about its load.

Pressures are set to 0 at open points and where they are tensions.  The load that this adds or removes is balanced
within the same block: balanced over all points, it would leave long waves, which cost most to correct.
"""

from __future__ import annotations

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.grid_cost import LEAST_MESH_ROWS
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.transfer import SubGrid
from pgfmd.grid.transforms import source
from pgfmd.parallel.layout import Exchange, hops
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.block_stiffness import BlockWindow
from pgfmd.solvers.active_set.feasible import SHIFT
from pgfmd.solvers.active_set.unknowns import Part
from pgfmd.solvers.second_order import energy_of_residual

MOST = 1.2  # largest factor on the pressures of a block, and inverse of the smallest
SIDE = 8  # pixels of a block of the mesh on which the energy of the change is computed

Rows = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pressure, gap and heights."""


class Settling:
    """Settles pressures of one problem.  Collective to make."""

    def __init__(self, problem: ContactProblem) -> None:
        grid, (nx, ny) = problem.grid, (-(-n // SIDE) for n in problem.grid.shape)
        self.grid, self.heights = grid, problem.heights
        self.width = (grid.shape[1] - 1 >> SHIFT) + 1
        self.window = BlockWindow(grid, 1 << SHIFT, 2 * self.width, np.float64)
        self.changes = BlockWindow(grid, SIDE, ny)
        lengths = nx * SIDE * grid.spacing[0], ny * SIDE * grid.spacing[1]
        self.mesh = SubGrid(grid, (nx, ny), lengths, LEAST_MESH_ROWS)
        self._gather = hops(self.changes.layout, self.mesh.layout)
        self._solid = problem.solid

    def free(self) -> None:
        """Frees the transforms of the mesh.  Collective."""
        self.mesh.free()

    def settle(self, pressure: np.ndarray, gap: np.ndarray, load: float) -> tuple[float, float, int]:
        """Makes a pressure (nx_local, ny) of clipped gaps bear the load.  Returns ⟨p, h⟩, Σ p² and the number of points
        with p > 0.  Collective.

        Raises SolverError if all points without a gap are in tension; the pressure is then uniform.
        """
        window, rows = self.window, (pressure, gap, self.heights)
        window.sum(lambda first, stop, sums: sum_in_blocks(pressure, gap, (first, stop), sums))
        loads, feasible = window.own[:, : self.width], window.own[:, self.width :]
        factors = np.clip(loads / np.where(feasible > 0, feasible, 1), 1 / MOST, MOST)
        total = self.grid.reduction.sum((factors * feasible).sum())
        if total == 0:
            pressure[...] = load / self.grid.size
            raise SolverError("hard wall: all points without a gap are in tension; allow a larger tolerance")
        loads[...] = factors * (load / total)
        window.fetch()
        parts: list[tuple[float, ...]] = []

        def settle(first: int, stop: int, sums: np.ndarray) -> None:
            parts.append((first, *settle_rows(rows, window.rows, (window.start, first, stop), sums)))

        self.changes.sum(settle)
        work, squares, count = self.grid.reduction.sums(*np.sum(sorted(parts), axis=0)[1:])
        return float(work), float(squares), int(count)

    def fill_change(self, pressure: np.ndarray, first: int, stop: int, out: np.ndarray) -> None:
        """out = the change that settling made to rows first … stop−1 of the pressure, where it is above 0 now."""
        factors = self.window.rows[self.window.start + np.arange(first, stop) >> SHIFT, : self.width]
        change = np.repeat(1 - 1 / factors, 1 << SHIFT, axis=1)[:, : pressure.shape[1]]
        np.multiply(pressure[first:stop], change, out=out, casting="same_kind")

    def energy(self) -> float:
        """⟨c, Gc⟩ of the change c by the last settling, from sums over blocks of `SIDE` pixels.  Collective."""
        sums, exchange = np.empty(self.mesh.local_shape, np.float32), Exchange(self.grid.comm)
        exchange.relay(self._gather, self.changes.own, sums)
        exchange.carry_out()
        energy = 0.0
        if (mesh := self.mesh.grid) is not None:
            compliance = self._solid.apply_compliance(mesh, np.float32, 1 / mesh.size)
            energy = energy_of_residual(mesh, source(sums), compliance)[0]
        self.grid.transforms += 0.25 * self.mesh.size / self.grid.size
        return 2 * self.grid.comm.bcast(energy) / SIDE**2


@jit
def sum_in_blocks(pressure: np.ndarray, gap: np.ndarray, part: Part, sums: np.ndarray) -> None:
    """sums[(i − first) >> SHIFT, b] += p and sums[(i − first) >> SHIFT, width + b] += max(p, 0) where the gap is 0, for
    the pressures p of those of rows first … stop−1 that exist, b = column >> SHIFT.
    """
    first, stop = part
    width = sums.shape[1] // 2
    for i in range(max(first, 0), min(stop, pressure.shape[0])):
        line = sums[(i - first) >> SHIFT]
        for block in range(width):
            load = feasible = 0.0
            for j in range(block << SHIFT, min((block + 1) << SHIFT, pressure.shape[1])):
                p = np.float64(pressure[i, u(j)])
                load += p
                feasible += p if (p > 0) & (gap[i, u(j)] <= 0) else 0.0
            line[u(block)] += load
            line[u(width + block)] += feasible


@jit
def settle_rows(
    rows: Rows, factors: np.ndarray, part: tuple[int, int, int], sums: np.ndarray
) -> tuple[float, float, int]:
    """Multiplies pressures by factors[(start + i) >> SHIFT, column >> SHIFT] where p > 0 and the gap is 0, and sets the
    others to 0, in those of rows first … stop−1 that exist; adds the changes to sums[(i − first) // SIDE, column //
    SIDE].  Returns Σ p h, Σ p² and the number of points with p > 0.  part: start, first, stop.
    """
    pressure, gap, heights = rows
    start, first, stop = part
    work = squares = 0.0
    count = 0
    for i in range(max(first, 0), min(stop, pressure.shape[0])):
        line, of_row = factors[(start + i) >> SHIFT], sums[(i - first) // SIDE]
        for block in range(of_row.size):
            factor, change = line[u(block * SIDE >> SHIFT)], 0.0
            for j in range(block * SIDE, min((block + 1) * SIDE, pressure.shape[1])):
                before = pressure[i, u(j)]
                p = factor * before if (before > 0) & (gap[i, u(j)] <= 0) else 0.0
                change += p - before
                work += p * heights[i, u(j)]
                squares += p * p
                count += p > 0
                pressure[i, u(j)] = p
            of_row[u(block)] += change
    return work, squares, count

"""The elastic response between the points of a set at a fraction of the cost of a transform: particle–mesh, as in
Ewald sums.

Near part: a kernel of 37 points within √10 pixels, summed over points of the set only.  Far part: the rest of the
response, on a mesh with half as many points per side.  Values are spread to the mesh by cubic B-splines, transformed,
multiplied by the influence function that is best for these splines (Hockney and Eastwood, Computer Simulation Using
Particles, 1988, section 8), and interpolated back by the same splines.  The kernel is fitted so that both together are
nearest to the response (`near_kernel`), within about a per cent.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from pgfmd.grid.grid_cost import LEAST_MESH_ROWS
from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid
from pgfmd.grid.transforms import ColumnAction, scaling, sink
from pgfmd.parallel.layout import Exchange, Piece, RowWindow
from pgfmd.solvers.active_set.stencil import OFFSETS, RADIUS, Stencil, Symbol, power_of, symmetric_kernel
from pgfmd.solvers.active_set.unknowns import Part, Points, SetVector, add_points, take_points

FITTED = 16  # waves of the mesh each way to which the near part is fitted
FACTORS = (2.0, (2, 2)), (8.0, (4, 1))
"""Up to which ratio of the larger to the smaller spacing the mesh has so many times their spacing."""
SPLINE = {1: (2, 1), 2: (16, 23, 8, 1), 4: (128, 235, 184, 121, 64, 27, 8, 1)}
"""The cubic B-spline at points 0, 1, … of which so many are one node apart, up to a factor; twice that beside 0."""
COLUMNS = 16  # of the spectrum at a time, so that NumPy's temporary arrays stay in cache
MARGIN = 4  # nodes beyond half the points, where the mesh does not wrap
# Root of the number of points below which full transforms are as cheap; padded ones; and ones in double precision.
SMALLEST = 256, 64, 128
NARROWEST = 32  # points of the shorter side

Splines = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""First node and weights (nx_local, 4) of each row; nodes, periodic, and weights (ny, 4) of each column."""


class MeshResponse:
    """S A Sᵀ v, nearly: S restricts to a set, A is the solid's compliance or stiffness; stencil: the near part."""

    def __init__(self, grid: SlabGrid, half_space: Symbol | None, response: Symbol, mean: float = 0.0) -> None:
        """half_space(|q|): A for a half-space, to which the near part is fitted; None: it is fitted to response(|q|), A
        for the solid itself; mean: that for the mean mode, on rank 0.
        """
        self.grid, self._mean, self.factors = grid, mean, mesh_factors(grid.spacing) or (2, 2)
        (fx, fy), lengths = self.factors, grid.lengths
        shape = -(-grid.shape[0] // fx), -(-grid.shape[1] // fy)
        scale, shift = (shape[0] / grid.shape[0], shape[1] / grid.shape[1]), 0
        if not grid.domain.wraps:  # splines reach a node beyond the first point and two beyond the last
            shape, scale, shift = (shape[0] + MARGIN, shape[1] + MARGIN), (1 / fx, 1 / fy), 1
            lengths = fx * shape[0] * grid.spacing[0], fy * shape[1] * grid.spacing[1]
        self.place = SubGrid(grid, shape, lengths, LEAST_MESH_ROWS)
        factor, power = (1.0, 0) if half_space is None else power_of(half_space)
        kernel = factor * near_kernel(grid.spacing, power or response, self.factors)
        self.stencil = Stencil(kernel)
        if self.place.grid is not None:
            self.influence = self._influence(self.place.grid, kernel, response)
        rows = _splines(np.arange(grid.rows.start, grid.rows.stop) * scale[0] + shift)
        first, weights = _splines(np.arange(grid.shape[1]) * scale[1] + shift)
        nodes = np.add.outer(first, np.arange(4, dtype=np.int32)) % np.int32(shape[1])
        self.splines: Splines = *rows, nodes, weights
        self.window = RowWindow(self.place.layout, (int(rows[0][0]), int(rows[0][-1]) + 4), shape[1])

    def apply(self, values: SetVector, out: np.ndarray) -> None:
        """out (count,) = the response on the set to `values`; both float32.  Collective.

        One exchange brings the halo of `values` and what other ranks spread to this rank's rows of the mesh.
        """
        window, exchange = self.window, Exchange(self.grid.comm)
        values.send(exchange)
        for first, stop in window.around:
            self._spread(values, first, window.rows[first:stop])
        pieces = exchange.give(window.plan, window.rows)
        exchange.carry_out()
        self.stencil.sum(values, out)
        if self.place.grid is not None:
            self._respond(self.place.grid, values, pieces)
        window.fetch()
        lists, splines, count = values.points.lists, self.splines, self.grid.local_shape[0]
        self.grid.threads.deal(
            lambda a, b: add_interpolated(window.rows, window.low, lists, (a, b), splines, out), count
        )
        self.grid.transforms += 0.5 * self.place.work * self.place.size / self.grid.size

    def _respond(self, mesh: SlabGrid, values: SetVector, pieces: list[Piece]) -> None:
        """The far part of the response; pieces: (first row, rows) that others spread here.  Collective on the mesh."""
        begin = self.window.begin

        def fill(first: int, stop: int, block: np.ndarray) -> None:
            self._spread(values, begin + first, block)
            for at, rows in pieces:
                low, high = max(first, at), min(stop, at + len(rows))
                if low < high:
                    block[low - first : high - first] += rows[low - at : high - at]

        mesh.convolve(fill, scaling(self.influence), sink(self.window.own), np.float32)

    def _spread(self, values: SetVector, first: int, block: np.ndarray) -> None:
        """Sets `block`, rows of the mesh from row `first` of the window on, to what this rank's points spread there."""
        block[...] = 0
        low = self.window.low + first
        part = np.searchsorted(self.splines[0], (low - 3, low + len(block)))
        spread_points(values.own, values.points.lists, (part[0], part[1]), self.splines, low, block)

    def make_room(self) -> None:
        """Frees the transforms of the mesh if they are large.  Collective."""
        if self.place.grid is not None:
            self.place.grid.make_room()

    def free(self) -> None:
        """Frees the transforms of the mesh.  Collective."""
        self.place.free()

    def _influence(self, mesh: SlabGrid, kernel: np.ndarray, response: Symbol) -> np.ndarray:
        """Factors of the mesh's modes (nky_local, nx): the response less that of the truncated near part."""
        offsets, waves = np.arange(-RADIUS, RADIUS + 1), (mesh.qx[0], mesh.qy[:, 0])
        cos_x, cos_y = (np.cos(np.outer(q, a * offsets)) for q, a in zip(waves, self.grid.spacing, strict=True))
        cycles = (q * a / (2 * np.pi) for q, a in zip(waves, mesh.spacing, strict=True))
        spline_x, spline_y = map(_spline_response, cycles, self.factors)
        across, influence = kernel.T @ cos_x.T, np.empty(mesh.spectral_shape, np.float32)
        share = self.grid.pixel_area / (mesh.modes * mesh.pixel_area)

        def part(_: int, first: int, stop: int) -> None:
            rest = response(np.sqrt(mesh.q_squared(first, stop)))
            if first == mesh.columns.start == 0:
                rest[0, 0] = self._mean
            rest -= cos_y[first:stop] @ across
            influence[first:stop] = rest * np.outer(spline_y[first:stop], spline_x * share)

        self.grid.threads.share(part, len(influence), COLUMNS)
        return influence


@lru_cache(maxsize=16)
def near_kernel(spacing: tuple[float, float], power: int | Symbol, factors: tuple[int, int]) -> np.ndarray:
    """Real-space values (7, 7) of the near part, zero beyond √10 pixels, for the operator A = |q|^power, or that of a
    symbol; to read.

    Four waves of the grid are one wave on the mesh.  With their spline weights W, the near part N and the influence I,
    the response to them is diag(N) + I W Wᵀ.  The kernel minimises Σ D_ij²/A_i of its difference D from diag(A), over
    waves evenly spread, with the best I for each: the energy of the error for a white change of the pressure.
    """
    halves = (np.arange(FITTED) + 0.5) / FITTED * np.pi
    along = [np.concatenate([halves / f - 2 * np.pi / f * k for k in range(f)]) for f in factors]
    x, y = np.meshgrid(*(np.where(q < -np.pi, q + 2 * np.pi, q) for q in along), indexing="ij")
    q = np.hypot(x / spacing[0], y / spacing[1])
    root = np.sqrt(power(q)) if callable(power) else q ** (power / 2)
    values = (sum(c * np.cos(j * q) for j, c in enumerate(SPLINE[f])) for q, f in zip((x, y), factors, strict=True))
    weights = np.prod([value / sum(SPLINE[f]) for value, f in zip(values, factors, strict=True)], axis=0) ** 2
    answered = weights / root / np.sqrt(_over_aliases(weights / root**2, factors) * _over_aliases(weights, factors))
    terms = np.array([(1 + (i > 0)) * (1 + (j > 0)) * np.cos(i * x) * np.cos(j * y) for i, j in OFFSETS] + [root**2])
    terms /= root
    by_mesh = _over_aliases(terms * answered, factors)[:, :FITTED, :FITTED]
    normal = np.einsum("aij,bij", terms, terms) - np.einsum("aij,bij", by_mesh, by_mesh)
    return symmetric_kernel(list(np.linalg.solve(normal[:-1, :-1], normal[:-1, -1])))


def _over_aliases(values: np.ndarray, factors: tuple[int, int]) -> np.ndarray:
    """Sums over the waves of the grid that are one wave on the mesh, at each of them."""
    for axis, factor in zip((-2, -1), factors, strict=True):
        values = values + sum(np.roll(values, FITTED * k, axis) for k in range(1, factor))
    return values


def _splines(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each position, the first of the four nodes around it and their cubic B-spline weights (len(at), 4)."""
    base = np.floor(at).astype(np.int64)
    t = (at - base)[:, None]
    weights = np.hstack([(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3]) / 6
    return (base - 1).astype(np.int32), weights.astype(np.float32)


def _spline_response(x: np.ndarray, factor: int) -> np.ndarray:
    """Ŵ²/(Σ Ŵ²)², the sum over aliases, at x cycles per node; Ŵ = sinc⁴, the transform of the cubic B-spline.  Where
    each point is a node, 1/W² with its values there.
    """
    if factor == 1:
        return 9 / (2 + np.cos(2 * np.pi * x)) ** 2
    s = np.sin(np.pi * x) ** 2
    return np.sinc(x) ** 8 / (1 - 4 / 3 * s + 2 / 5 * s**2 - 4 / 315 * s**3) ** 2


class FullResponse:
    """S A Sᵀ v by full transforms."""

    def __init__(self, action: ColumnAction) -> None:
        self.action = action

    def apply(self, values: SetVector, out: np.ndarray) -> None:
        """out (count,) = the response on the set to `values`.  Collective."""
        points = values.points

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            rows[...] = 0
            add_points(values.own, points.lists, first, rows)

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            take_points(rows, points.lists, first, (0.0, 1.0), out)

        points.grid.convolve(fill, self.action, drain, np.float32)

    def free(self) -> None:
        """There is nothing to free."""


def mesh_factors(spacing: tuple[float, float]) -> tuple[int, int] | None:
    """Spacings of the mesh over those of the grid, along x and y; None if pixels are too oblong for one."""
    ratio = max(spacing) / min(spacing)
    small, large = next((factors for most, factors in FACTORS if ratio <= most), (0, 0))
    return ((small, large) if spacing[0] <= spacing[1] else (large, small)) if small else None


def inner_response(
    grid: SlabGrid, half_space: Symbol, response: Symbol, action: ColumnAction, mean: float = 0.0
) -> MeshResponse | FullResponse:
    """A `mesh_response`, or where there is none a `FullResponse`: `action` multiplies modes by A.  Collective."""
    return mesh_response(grid, response, half_space, mean) or FullResponse(action)


def mesh_response(
    grid: SlabGrid, response: Symbol, half_space: Symbol | None = None, mean: float = 0.0
) -> MeshResponse | None:
    """A `MeshResponse` on large grids whose pixels are not too oblong, if the solid responds like the half-space to
    short waves; without a half-space, in place of transforms in double precision.  Collective.
    """
    least = SMALLEST[2 if half_space is None else not grid.domain.wraps]
    large = grid.size >= least**2 and min(grid.shape) >= NARROWEST
    if not (large and mesh_factors(grid.spacing)):
        return None
    q = np.array(0.25 * np.pi / max(grid.spacing))
    alike = half_space is None or abs(response(q) / half_space(q) - 1) < 1e-2
    return MeshResponse(grid, half_space, response, mean) if alike else None


@jit
def spread_points(
    values: np.ndarray, points: Points, part: Part, splines: Splines, mesh_row: int, mesh: np.ndarray
) -> None:
    """mesh[x_first[i] + s − mesh_row, nodes[j, t]] += x_weights[i, s] y_weights[j, t] values[k] for the points k of the
    rows first ≤ i < stop, j = columns[k], and s, t < 4; rows outside `mesh` are left out.
    """
    columns, offsets = points
    x_first, x_weights, nodes, y_weights = splines
    line = np.empty(mesh.shape[1], mesh.dtype)
    for i in range(part[0], part[1]):
        if offsets[i] == offsets[i + 1]:
            continue
        line[:] = 0
        for k in range(offsets[i], offsets[i + 1]):
            column, value = u(columns[k]), values[u(k)]
            for t in range(4):
                line[u(nodes[column, u(t)])] += y_weights[column, u(t)] * value
        for s in range(x_weights.shape[1]):  # not range(4): to unroll it takes long
            row, weight = x_first[i] + s - mesh_row, x_weights[i, s]
            if 0 <= row < mesh.shape[0] and weight != 0:
                target = mesh[row]
                for j in range(line.size):
                    target[u(j)] += weight * line[u(j)]


@jit
def add_interpolated(
    mesh: np.ndarray, mesh_row: int, points: Points, part: Part, splines: Splines, values: np.ndarray
) -> None:
    """values[k] += Σ_st x_weights[i, s] y_weights[j, t] mesh[x_first[i] + s − mesh_row, nodes[j, t]] for the points k
    of the rows first ≤ i < stop, j = columns[k].
    """
    line, (columns, offsets), (first, stop) = np.empty(mesh.shape[1], mesh.dtype), points, part
    x_first, x_weights, nodes, y_weights = splines
    for i in range(first, stop):
        if offsets[i] == offsets[i + 1]:
            continue
        at, a, b, c, d = x_first[i] - mesh_row, x_weights[i, 0], x_weights[i, 1], x_weights[i, 2], x_weights[i, 3]
        for j in range(line.size):
            line[j] = a * mesh[at, j] + b * mesh[at + 1, j] + c * mesh[at + 2, j] + d * mesh[at + 3, j]
        for k in range(offsets[i], offsets[i + 1]):
            column, total = columns[k], values[k]
            for t in range(4):
                total += y_weights[column, t] * line[u(nodes[column, t])]
            values[k] = total

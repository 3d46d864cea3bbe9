"""Flow through the faces between neighbouring points of a periodic grid, bounded from both sides.

With conductances T of the faces and potentials u of the points, a drop of 1 across the cell drives the flow K, the
least Σ T (u_j − u_i + w)² over u, w = ±1 on faces across the cell's border and 0 elsewhere.  The energy of any u is a
bound from above.  If a flux f balances the residual r = b − Au (Σ_j f_ij = r_i), the energy less Σ f²/T is one from
below, since Σ f²/T is at least ⟨r, A⁻¹r⟩; T(u_i − u_j − w) + f is then a flux that is balanced in each point.

The solver is flexible conjugate gradients with aggregation multigrid (K-cycle: Notay and Vassilevski 2008,
doi:10.1002/nla.542).  Aggregates are matched twice (Notay 2010, ETNA 37, 123).  At the start the total pressure is
constant in the largest aggregates, so that the drop lies on the faces between them: from u = 0 the energy would begin
up to 3e7 times too high.  Diagonals are row sums, and the coarsest level is eliminated without subtraction (Grassmann,
Taksar and Heyman 1985, doi:10.1287/opre.33.5.1107), so that a contrast of 1e20 does no harm.  f is made on the coarsest
level, shared over finer faces in proportion to T, and balanced in each aggregate.

Two levels lie in slabs, with copies of the points of neighbouring ranks; aggregates stay within a slab.  The next one,
about .03 of the points, is gathered on rank 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.patch_table import label_patches
from pgfmd.parallel.compiled import compiled
from pgfmd.parallel.mpi import MPI

COARSEST = 400  # points that are eliminated
IN_SLABS = 2  # levels
STRONG = 0.9  # a point is matched if its free neighbour's T is at least this part of its largest
SIZES = 3, 6  # most points of an aggregate after the first and the second matching
SLOW = 0.6  # points left by a coarsening from which aggregates may have any size
FIRST = 4  # steps on rank 0 for the start
INNER, INNER_CUT = 4, 0.25  # most steps on a coarse level, and the factor on the residual
MOST, PATIENCE = 300, 12  # iterations; those without halving the error, after which the bounds stay as they are
NEGLIGIBLE = 1e-6  # of the largest gap: smaller ones count as closed if paths are left.  What rounding leaves in pools
# behind them would have to leave through them, and the bounds would be as far apart.
ACROSS_X, ACROSS_Y = 1, 2  # kinds of faces that cross the border of the cell; negative: backwards


class Graph(NamedTuple):
    """The faces of n points in compressed rows: first (n + 1,), the other point, T, and the kind of border crossed."""

    first: np.ndarray
    other: np.ndarray
    weight: np.ndarray
    border: np.ndarray

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.first) - 1


class Halo:
    """Copies of points of the ranks before and after: they follow the own points in vectors."""

    def __init__(self, comm: MPI.Comm, count: int, sent: list[np.ndarray], copies: list[int]) -> None:
        """count: of own points; sent: those that the rank before and the one after need; copies: of their points."""
        self.comm, self.count, self.sent, self.copies = comm, count, sent, copies

    def fill(self, vector: np.ndarray) -> None:
        """Brings the present values of the copies.  Collective."""
        comm, begin = self.comm, self.count
        for side in (0, 1):  # copies of the rank before; of the one after
            step, end = 2 * side - 1, begin + self.copies[side]
            source, target = (comm.rank + step) % comm.size, (comm.rank - step) % comm.size
            comm.Sendrecv(vector[self.sent[1 - side]], target, recvbuf=vector[begin:end], source=source)
            begin = end

    def coarse(self, aggregate: np.ndarray, count: int) -> Halo:
        """Numbers the aggregates of the copies, after `count` own ones; returns the halo of aggregates.  Collective."""
        sent = [np.unique(aggregate[part], return_inverse=True) for part in self.sent]
        places = np.zeros(len(aggregate), np.int32)
        own = places.copy()
        begin, copies = self.count, []
        for side in (0, 1):
            own[:] = 0
            own[self.sent[1 - side]] = sent[1 - side][1]
            self.fill(own)
            part = slice(begin, begin + self.copies[side])
            places[part] = own[part]
            copies.append(int(places[part].max(initial=-1)) + 1)
            aggregate[part] = count + sum(copies[:-1]) + places[part]
            begin = part.stop
        return Halo(self.comm, count, [unique for unique, _ in sent], copies)


Step = tuple[np.ndarray, np.ndarray, float]
"""A direction, A · direction, and its energy."""


class Level:
    """One level of the multigrid, with all coarser ones.  Vectors hold own points, then copies.  Collective to make.

    halo: None on levels of rank 0 alone.  On other ranks such levels have no points.
    """

    def __init__(self, graph: Graph, halo: Halo | None, depth: int = 0) -> None:
        self.graph, self.halo, self.depth = graph, halo, depth
        self.copies = sum(halo.copies) if halo else 0
        self.diagonal = row_sums(graph)
        self.coarse: Level | None = None
        self.factor = np.empty((0, 0))
        if halo is not None and depth == IN_SLABS:
            self._gather(halo)
        elif graph.points <= COARSEST and halo is None:
            self.factor = eliminated(graph)
        else:
            self._aggregate(halo)

    def _aggregate(self, halo: Halo | None) -> None:
        graph, sizes = self.graph, np.ones(self.graph.points, np.int32)
        whole = np.arange(graph.points + self.copies, dtype=np.int32)
        for most in SIZES:
            found, count = match(graph, sizes, most, halo is None)
            if halo is None and count > SLOW * graph.points:
                found, count = match(graph, sizes, 2 * graph.points, True)
            aggregate = np.concatenate([found, np.empty(self.copies if halo else 0, np.int32)])
            halo = halo.coarse(aggregate, count) if halo else None
            whole = aggregate[whole]
            sizes = np.bincount(found, sizes, count).astype(np.int32)
            self.copies = sum(halo.copies) if halo else 0
            graph = coarsened(graph, aggregate, count)
        self.copies = sum(self.halo.copies) if self.halo else 0
        self.aggregate = whole
        self.members = np.argsort(whole[: self.graph.points], kind="stable").astype(np.int32)
        self.coarse = Level(graph, halo, self.depth + 1)

    def _gather(self, halo: Halo) -> None:
        """Makes the level of rank 0, whose points are those of all ranks in turn."""
        comm, (first, other, weight, border) = halo.comm, self.graph
        self.counts = np.array(comm.allgather(self.graph.points))
        number = np.zeros(self.graph.points + self.copies, np.int32)
        number[: self.graph.points] = np.arange(self.graph.points) + self.counts[: comm.rank].sum()
        halo.fill(number)
        parts = comm.gather((np.diff(first), number[other], weight, border))
        if parts is None:
            nothing = np.empty(0, np.int32)
            whole = Graph(np.zeros(1, np.int64), nothing, np.empty(0), nothing.astype(np.int8))
        else:
            degree, *columns = (np.concatenate(each) for each in zip(*parts, strict=True))
            whole = Graph(np.concatenate([[0], np.cumsum(degree)]), *columns)
        self.faces = np.array(comm.allgather(len(other)))
        self.root = Level(whole, None) if comm.rank == 0 else None

    def to_root(self, values: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """One vector of those of all ranks, on rank 0; empty elsewhere.  Collective."""
        assert self.halo is not None
        comm = self.halo.comm
        whole = np.empty(counts.sum() if comm.rank == 0 else 0)
        comm.Gatherv(np.ascontiguousarray(values), [whole, counts])
        return whole

    def from_root(self, whole: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """This rank's part of a vector of rank 0.  Collective."""
        assert self.halo is not None
        comm = self.halo.comm
        part = np.empty(counts[comm.rank])
        comm.Scatterv([whole, counts], part)
        return part

    def new(self, values: np.ndarray | float = 0.0) -> np.ndarray:
        """A vector with these values on own points."""
        vector = np.zeros(self.graph.points + self.copies)
        vector[: self.graph.points] = values
        return vector

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """Σ a b over the points of all ranks.  Collective."""
        own = float(a[: self.graph.points] @ b[: self.graph.points])
        return own if self.halo is None else float(self.halo.comm.allreduce(own))

    def rest(self, target: np.ndarray, x: np.ndarray) -> np.ndarray:
        """target − Ax.  Collective."""
        if self.halo is not None:
            self.halo.fill(x)
        out = self.new()
        residual(self.graph, target, x, out)
        return out

    def restricted(self, values: np.ndarray) -> np.ndarray:
        """Sums over aggregates."""
        assert self.coarse is not None
        count = self.coarse.graph.points
        return self.coarse.new(np.bincount(self.aggregate[: self.graph.points], values[: self.graph.points], count))

    def cycle(self, target: np.ndarray) -> np.ndarray:
        """z ≈ A⁻¹ target: a symmetric preconditioner, but for inner steps.  Collective."""
        if len(self.factor):
            return back_substituted(self.factor, target)
        if self.coarse is None:
            return self.gathered_solution(target)
        z = self.new()
        relax(self.graph, self.diagonal, target, z, False)
        rest = self.restricted(self.rest(target, z))
        z[: self.graph.points] += self.coarse.solved(rest)[self.aggregate[: self.graph.points]]
        if self.halo is not None:
            self.halo.fill(z)
        relax(self.graph, self.diagonal, target, z, True)
        return z

    def gathered_solution(self, target: np.ndarray) -> np.ndarray:
        """The solution of rank 0 for the target of all ranks, which lies on one of its levels.  Collective."""
        whole = self.to_root(target[: self.graph.points], self.counts)
        if self.root is not None:
            whole = self.root.solved(whole)
        return self.new(self.from_root(whole, self.counts))

    def solved(self, target: np.ndarray) -> np.ndarray:
        """A⁻¹ target by a few steps of flexible conjugate gradients, or exactly on the coarsest level.  Collective."""
        if len(self.factor) or self.coarse is None:
            return self.cycle(target)
        x, r = self.new(), target.copy()
        scaled = np.divide(1.0, self.diagonal, out=np.zeros_like(self.diagonal), where=self.diagonal > 0)
        goal, step = 0.0, None
        for k in range(INNER):
            square = self.dot(r[: self.graph.points] * scaled, r)
            goal = goal or INNER_CUT**2 * square
            if square <= goal and k or square == 0:
                break
            step = self.advance(x, r, self.cycle(r), step)
        return x

    def start(self, b: np.ndarray, kind: int) -> np.ndarray:
        """A good start for Au = b.  Collective."""
        count = self.graph.points
        if self.coarse is not None and self.halo is not None:
            return self.new(self.coarse.start(self.restricted(b), kind)[self.aggregate[:count]])
        if self.halo is not None:
            whole = self.to_root(b[:count], self.counts)
            if self.root is not None:
                whole = self.root.start(whole, kind)
            return self.new(self.from_root(whole, self.counts))
        last: Level = self
        largest: np.ndarray = np.arange(count, dtype=np.int32)
        while last.coarse is not None:
            largest, last = last.aggregate[largest], last.coarse
        x = unrolled(self.graph, largest, kind)
        x += last.cycle(np.bincount(largest, self.rest(b, x), last.graph.points))[largest]
        r, step = self.rest(b, x), None
        for _ in range(FIRST):
            step = self.advance(x, r, self.cycle(r), step)
        return x

    def advance(self, x: np.ndarray, r: np.ndarray, z: np.ndarray, step: Step | None) -> Step:
        """One step along z made conjugate to the last one, whose memory is used.  Collective."""
        if step is None:
            direction, product = z, self.new()
        else:
            direction, product, energy = step
            add_scaled(z, -self.dot(z, product) / energy, direction, z)
            direction[:] = z
        if self.halo is not None:
            self.halo.fill(direction)
        apply(self.graph, direction, product)
        energy = self.dot(direction, product)
        if energy > 0:
            length = self.dot(direction, r) / energy
            add_scaled(x, length, direction, x)
            add_scaled(r, -length, product, r)
        return direction, product, energy or math.inf

    def fluxes(self, r: np.ndarray, keep: bool = True) -> tuple[np.ndarray, float]:
        """A flux f_ij on the faces with Σ_j f_ij = r_i, and Σ f²/T over the faces of this rank's points, each counted
        for both.  keep: else the flux is not stored.  Collective.
        """
        graph = self.graph
        if len(self.factor):
            flux = potential_flux(graph, back_substituted(self.factor, r))
            return flux, float(np.sum(flux**2 / graph.weight))
        if self.coarse is None and graph.points == 0 and self.halo is None:
            return np.empty(0), 0.0
        if self.coarse is None:
            whole = self.to_root(r[: graph.points], self.counts)
            if self.root is not None:
                whole = self.root.fluxes(whole)[0]
            flux = self.from_root(whole, self.faces)
            return flux, float(np.sum(flux**2 / graph.weight))
        coarse, _ = self.coarse.fluxes(self.restricted(r))
        flux = np.empty(len(graph.weight) if keep else 0)
        groups = self.aggregate, self.members
        return flux, shared_flux(graph, self.coarse.graph, coarse, groups, r, flux)


class Flow(NamedTuple):
    """Bounds of K (in T's unit); the balanced flux through the faces to the next row and to the next column (nx_local,
    ny), if asked for; number of iterations.
    """

    lower: float
    upper: float
    fluxes: tuple[np.ndarray, np.ndarray] | None
    iterations: int


class Network:
    """The points that a mask lists, with the conductances of their faces to the next row and to the next column, all
    (nx_local, ny).  Collective to make.
    """

    def __init__(self, grid: SlabGrid, mask: np.ndarray, down: np.ndarray, right: np.ndarray) -> None:
        self.grid, self.mask = grid, mask
        count = int(np.count_nonzero(mask))
        around, faces = grid.neighbours([mask, down])
        copies = [int(np.count_nonzero(row)) for row in around]
        number = np.full((len(mask) + 2, mask.shape[1]), -1, np.int32)
        number[1:-1][mask] = np.arange(count)
        number[0][around[0]] = np.arange(copies[0]) + count
        number[-1][around[1]] = np.arange(copies[1]) + count + copies[0]
        ends = grid.rows.start == 0, grid.rows.stop == grid.shape[0]
        graph, self.sides = grid_graph(number, (np.concatenate([faces[:1], down]), right), count, ends)
        sent = [number[row][number[row] >= 0] for row in (1, -2)]
        self.level = Level(graph, Halo(grid.comm, count, sent, copies))

    def solve(self, axis: int, width: float, with_flux: bool = False) -> Flow:
        """K along x (axis 0) or y (1) to bounds of that relative width, or to what rounding leaves.  Raises SolverError
        if the iteration does not end.  Collective.
        """
        level, kind = self.level, (ACROSS_X, ACROSS_Y)[axis]
        b = level.new()
        sources(level.graph, kind, b)
        u = level.start(b, kind)
        r, step = level.rest(b, u), None
        ready, least, since = math.inf, math.inf, 0
        for iteration in range(MOST):
            z = level.cycle(r)
            estimate = level.dot(r, z)
            upper = self._energy(u, kind)
            if estimate < least / 2:
                least, since = estimate, iteration
            stuck = iteration - since >= PATIENCE or not estimate > 0
            if estimate <= ready * upper or stuck:
                flux, square = level.fluxes(r, with_flux)
                square = self.grid.reduction.sum(square) / 2
                if square <= width * upper or stuck:
                    fluxes = self._on_faces(u, kind, flux) if with_flux else None
                    return Flow(max(upper - square, 0.0), upper, fluxes, iteration)
                ready = 0.7 * width * estimate / square
            step = level.advance(u, r, z, step)
        raise SolverError(f"leakage: no bounds after {MOST} iterations")

    def _energy(self, u: np.ndarray, kind: int) -> float:
        """Σ T (u_j − u_i + w)² over faces.  Collective."""
        assert self.level.halo is not None
        self.level.halo.fill(u)
        return self.grid.reduction.sum(energy(self.level.graph, kind, u)) / 2

    def _on_faces(self, u: np.ndarray, kind: int, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The balanced flux along the mean flow, on the faces to the next row and column."""
        out, fields = np.zeros((2, self.level.graph.points)), np.zeros((2, *self.mask.shape))
        forward_faces(self.level.graph, self.sides, kind, u, flux, out)
        fields[:, self.mask] = out
        return fields[0], fields[1]


def flow_through(grid: SlabGrid, gap: np.ndarray, mask: np.ndarray, how: tuple[int, float, bool]) -> Flow:
    """The flow through a gap (nx_local, ny) where a mask is set, as `Network.solve` gives it: K for g³ as conductivity,
    the flux per width for a mean gradient of −1.  how: axis, width, whether with the flux.  Collective.

    Components that do not wind around the cell along the axis carry nothing, and are left out.
    """
    axis, width, with_flux = how
    unit = grid.reduction.max(gap[mask])
    for least in (NEGLIGIBLE * unit, 0.0):
        labels = label_patches(grid.comm, mask & (gap > least), grid.starts, 4)
        own = np.flatnonzero(labels.winds[:, axis]) + labels.kept_from
        winding = np.concatenate(grid.comm.allgather(own))
        if len(winding):
            break
    else:
        nothing = np.zeros((2, *mask.shape)) if with_flux else None
        return Flow(0.0, 0.0, None if nothing is None else (nothing[0], nothing[1]), 0)
    mask = np.isin(labels.label_field(), winding)
    del labels
    k = np.where(mask, gap / unit, 0.0)
    k **= 3
    after = grid.neighbours([k])[0][1:]
    down, right = _harmonic(k, np.concatenate([k[1:], after])), _harmonic(k, np.roll(k, -1, axis=1))
    (lx, ly), (ax, ay) = grid.lengths, grid.spacing
    down *= ay / ax
    right *= ax / ay
    network = Network(grid, mask, down, right)
    del k, down, right
    found = network.solve(axis, width, with_flux)
    scale = unit**3 * (lx / ly if axis == 0 else ly / lx)
    fluxes = found.fluxes
    if fluxes is not None:
        drop = unit**3 * grid.lengths[axis]
        fluxes = fluxes[0] * (drop / ay), fluxes[1] * (drop / ax)
    return Flow(scale * found.lower, scale * found.upper, fluxes, found.iterations)


def _harmonic(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Harmonic mean; 0 where one of both is."""
    total = a + b
    return np.divide(2 * a * b, total, out=np.zeros_like(a), where=total > 0)


@compiled()
def grid_graph(
    number: np.ndarray, faces: tuple[np.ndarray, np.ndarray], count: int, ends: tuple[bool, bool]
) -> tuple[Graph, np.ndarray]:
    """The graph of the points numbered from 0 in rows 1 … −2 of `number` (−1: none); faces: down, with the row before
    the first, and right; ends: whether the cell's border is before the first row, after the last.  Also the side
    of each face: 0 up, 1 left, 2 right, 3 down.
    """
    down, right = faces
    first, ny = np.zeros(count + 1, np.int64), number.shape[1]
    other, weight = np.empty(4 * count, np.int32), np.empty(4 * count)
    border, sides, at = np.zeros(4 * count, np.int8), np.empty(4 * count, np.int8), 0
    for i in range(1, number.shape[0] - 1):
        for j in range(ny):
            if number[i, j] < 0:
                continue
            for side in range(4):
                row, column = i + (side == 3) - (side == 0), (j + (side == 2) - (side == 1)) % ny
                t = down[i - (side == 0), j] if side in (0, 3) else right[i - 1, column if side == 1 else j]
                if number[row, column] < 0 or not t > 0:
                    continue
                other[at], weight[at], sides[at] = number[row, column], t, side
                if side == 0 and i == 1 and ends[0]:
                    border[at] = -1
                elif side == 3 and i == number.shape[0] - 2 and ends[1]:
                    border[at] = 1
                elif side == 1 and j == 0:
                    border[at] = -2
                elif side == 2 and j == ny - 1:
                    border[at] = 2
                at += 1
            first[number[i, j] + 1] = at
    return Graph(first, other[:at], weight[:at], border[:at]), sides[:at]  # what is not written takes no memory


@compiled()
def row_sums(graph: Graph) -> np.ndarray:
    """Σ_j T_ij of each point."""
    out = np.zeros(len(graph.first) - 1)
    for i in range(len(out)):
        for k in range(graph.first[i], graph.first[i + 1]):
            out[i] += graph.weight[k]
    return out


@compiled()
def crossing(border: int, kind: int) -> int:
    """w of a face: 1 or −1 across that border, forwards or backwards, else 0."""
    return 1 if border == kind else -1 if border == -kind else 0


@compiled()
def sources(graph: Graph, kind: int, out: np.ndarray) -> None:
    """b_i = Σ_j T_ij w_ij."""
    for i in range(len(graph.first) - 1):
        for k in range(graph.first[i], graph.first[i + 1]):
            out[i] += graph.weight[k] * crossing(graph.border[k], kind)


@compiled()
def energy(graph: Graph, kind: int, u: np.ndarray) -> float:
    """Σ_ij T_ij (u_j − u_i + w_ij)², each face from both of its points."""
    total = 0.0
    for i in range(len(graph.first) - 1):
        of_point = 0.0
        for k in range(graph.first[i], graph.first[i + 1]):
            drop = u[graph.other[k]] - u[i] + crossing(graph.border[k], kind)
            of_point += graph.weight[k] * drop * drop
        total += of_point
    return total


@compiled()
def residual(graph: Graph, target: np.ndarray, x: np.ndarray, out: np.ndarray) -> None:
    """out = target − Ax."""
    for i in range(len(graph.first) - 1):
        total = target[i]
        for k in range(graph.first[i], graph.first[i + 1]):
            total += graph.weight[k] * (x[graph.other[k]] - x[i])
        out[i] = total


@compiled()
def apply(graph: Graph, x: np.ndarray, out: np.ndarray) -> None:
    """out = Ax."""
    for i in range(len(graph.first) - 1):
        total = 0.0
        for k in range(graph.first[i], graph.first[i + 1]):
            total += graph.weight[k] * (x[i] - x[graph.other[k]])
        out[i] = total


@compiled()
def add_scaled(a: np.ndarray, factor: float, b: np.ndarray, out: np.ndarray) -> None:
    """out = a + factor · b."""
    for i in range(len(a)):
        out[i] = a[i] + factor * b[i]


@compiled()
def relax(graph: Graph, diagonal: np.ndarray, target: np.ndarray, x: np.ndarray, backward: bool) -> None:
    """A sweep of Gauss–Seidel over own points, forward or backward."""
    count = len(diagonal)
    for step in range(count):
        i = count - 1 - step if backward else step
        total = target[i]
        for k in range(graph.first[i], graph.first[i + 1]):
            total += graph.weight[k] * x[graph.other[k]]
        if diagonal[i] > 0:
            x[i] = total / diagonal[i]


@compiled()
def unrolled(graph: Graph, aggregate: np.ndarray, kind: int) -> np.ndarray:
    """A u with u_j − u_i + w = 0 on the faces of a tree within each aggregate."""
    n = len(aggregate)
    out, seen, stack = np.zeros(n), np.zeros(n, np.bool_), np.empty(n, np.int32)
    for begin in range(n):
        height = 0 if seen[begin] else 1
        stack[0], seen[begin] = begin, True
        while height > 0:
            height -= 1
            i = stack[height]
            for k in range(graph.first[i], graph.first[i + 1]):
                j = graph.other[k]
                if not seen[j] and aggregate[j] == aggregate[i]:
                    out[j] = out[i] - crossing(graph.border[k], kind)
                    stack[height], seen[j] = j, True
                    height += 1
    return out


@compiled()
def match(graph: Graph, sizes: np.ndarray, most: int, over_border: bool) -> tuple[np.ndarray, int]:
    """The aggregate (n,) of each point, and how many there are: pairs of strong neighbours, joined by points that were
    left, up to `most` in the `sizes` of points.  over_border: whether it may lie on both sides of the cell's border.
    Faces over which points cannot join count too: a point of a pool on both sides must not join what is around it.
    """
    count, found = 0, np.full(len(sizes), -1, np.int32)
    whole = np.zeros(len(sizes), np.int32)
    for i in range(len(sizes)):
        largest, best, partner = 0.0, 0.0, -1
        for k in range(graph.first[i], graph.first[i + 1] if found[i] < 0 else graph.first[i]):
            j = graph.other[k]
            if j != i:
                largest = max(largest, graph.weight[k])
                joins = j < len(sizes) and (over_border or graph.border[k] == 0)
                if joins and found[j] < 0 and graph.weight[k] > best and sizes[i] + sizes[j] <= most:
                    best, partner = graph.weight[k], j
        if partner >= 0 and best >= STRONG * largest:
            found[i] = found[partner] = count
            whole[count] = sizes[i] + sizes[partner]
            count += 1
    for i in range(len(sizes)):
        best, target = 0.0, -1
        for k in range(graph.first[i], graph.first[i + 1] if found[i] < 0 else graph.first[i]):
            j = graph.other[k]
            if j != i and graph.weight[k] > best:
                joins = j < len(sizes) and (over_border or graph.border[k] == 0)
                best, target = graph.weight[k], j if joins else -1
        if found[i] < 0 and target >= 0 and found[target] >= 0 and whole[found[target]] + sizes[i] <= most:
            found[i] = found[target]
            whole[found[i]] += sizes[i]
        elif found[i] < 0:
            found[i] = count
            whole[count] = sizes[i]
            count += 1
    return found, count


@compiled()
def coarsened(graph: Graph, aggregate: np.ndarray, count: int) -> Graph:
    """The graph of `count` aggregates; aggregate: of own points, then of copies.  T's are summed; a face crosses a
    border if all of those that it stands for do.
    """
    n = len(graph.first) - 1
    begin = np.zeros(count + 1, np.int64)
    for i in range(n):
        begin[aggregate[i] + 1] += 1
    begin = np.cumsum(begin)
    place, order = begin[:-1].copy(), np.empty(n, np.int32)
    for i in range(n):
        order[place[aggregate[i]]] = i
        place[aggregate[i]] += 1
    first, at = np.zeros(count + 1, np.int64), 0
    other, weight = np.empty(len(graph.other), np.int32), np.empty(len(graph.other))
    border, seen = np.empty(len(graph.other), np.int8), np.full(aggregate.max() + 1 if len(aggregate) else 0, -1)
    for a in range(count):
        for m in range(begin[a], begin[a + 1]):
            i = order[m]
            for k in range(graph.first[i], graph.first[i + 1]):
                b = aggregate[graph.other[k]]
                if b == a:
                    continue
                if seen[b] < first[a]:
                    seen[b], other[at], weight[at], border[at] = at, b, 0.0, graph.border[k]
                    at += 1
                weight[seen[b]] += graph.weight[k]
                if graph.border[k] == 0:
                    border[seen[b]] = 0
        first[a + 1] = at
    return Graph(first, other[:at], weight[:at], border[:at])


@compiled()
def eliminated(graph: Graph) -> np.ndarray:
    """Star–mesh elimination of all points, from the last to the first, without subtraction: row k holds T to the points
    before it when it is eliminated, and their sum on the diagonal.
    """
    n = len(graph.first) - 1
    table = np.zeros((n, n))
    for i in range(n):
        for k in range(graph.first[i], graph.first[i + 1]):
            if graph.other[k] != i:
                table[i, graph.other[k]] += graph.weight[k]
    for k in range(n - 1, -1, -1):
        total = 0.0
        for j in range(k):
            total += table[k, j]
        table[k, k] = total
        for i in range(k if total > 0 else 0):
            share = table[k, i] / total
            for j in range(k if share > 0 else 0):
                if j != i:
                    table[i, j] += share * table[k, j]
    return table


@compiled()
def back_substituted(table: np.ndarray, target: np.ndarray) -> np.ndarray:
    """A⁻¹ target by an elimination; a component's first point has 0."""
    x = target.copy()
    for k in range(len(table) - 1, -1, -1):
        for i in range(k if table[k, k] > 0 else 0):
            x[i] += table[k, i] / table[k, k] * x[k]
    for k in range(len(table)):
        total = x[k]
        for j in range(k):
            total += table[k, j] * x[j]
        x[k] = total / table[k, k] if table[k, k] > 0 else 0.0
    return x


@compiled()
def potential_flux(graph: Graph, x: np.ndarray) -> np.ndarray:
    """f_ij = T_ij (x_i − x_j)."""
    out = np.empty(len(graph.other))
    for i in range(len(graph.first) - 1):
        for k in range(graph.first[i], graph.first[i + 1]):
            out[k] = graph.weight[k] * (x[i] - x[graph.other[k]])
    return out


@compiled()
def shared_flux(
    graph: Graph, coarse: Graph, above: np.ndarray, groups: tuple[np.ndarray, np.ndarray], r: np.ndarray,
    flux: np.ndarray,
) -> float:  # fmt: skip
    """Σ f²/T of a flux with Σ_j f_ij = r_i, stored in `flux` unless that is empty: `above`, that of the coarse graph,
    in proportion to T between aggregates, and the least that balances the rest within each.  groups: aggregate of each
    point, and the points ordered by it.
    """
    aggregate, members = groups
    total, begin, place, largest = 0.0, 0, np.zeros(len(graph.first), np.int32), 0
    for m in range(len(members)):
        begin = m if m == 0 or aggregate[members[m]] != aggregate[members[m - 1]] else begin
        place[members[m]] = m - begin
        largest = max(largest, m - begin + 1)
    table, target, begin = np.empty((largest, largest)), np.empty(largest), 0
    while begin < len(members):
        a, stop = aggregate[members[begin]], begin
        while stop < len(members) and aggregate[members[stop]] == a:
            stop += 1
        table[: stop - begin, : stop - begin] = 0.0
        for m in range(stop - begin):
            i = members[begin + m]
            target[m] = r[i]
            for k in range(graph.first[i], graph.first[i + 1]):
                b = aggregate[graph.other[k]]
                if b == a:
                    if graph.other[k] != i:
                        table[m, place[graph.other[k]]] += graph.weight[k]
                    continue
                c = coarse.first[a]
                while coarse.other[c] != b:
                    c += 1
                f = above[c] * (graph.weight[k] / coarse.weight[c])
                target[m] -= f
                total += f * f / graph.weight[k]
                if len(flux):
                    flux[k] = f
        for m in range(stop - begin - 1, -1, -1):
            for j in range(m):
                table[m, m] += table[m, j]
            for i in range(m if table[m, m] > 0 else 0):
                share = table[m, i] / table[m, m]
                target[i] += share * target[m]
                for j in range(m):
                    if j != i:
                        table[i, j] += share * table[m, j]
        for m in range(stop - begin):
            for j in range(m):
                target[m] += table[m, j] * target[j]
            target[m] = target[m] / table[m, m] if table[m, m] > 0 else 0.0
        for m in range(stop - begin):
            i = members[begin + m]
            for k in range(graph.first[i], graph.first[i + 1]):
                if aggregate[graph.other[k]] == a:
                    difference = target[m] - target[place[graph.other[k]]] if graph.other[k] != i else 0.0
                    total += graph.weight[k] * difference * difference
                    if len(flux):
                        flux[k] = graph.weight[k] * difference
        begin = stop
    return total


@compiled()
def forward_faces(
    graph: Graph, sides: np.ndarray, kind: int, u: np.ndarray, flux: np.ndarray, out: np.ndarray
) -> None:
    """out[0, i] and out[1, i]: T (u_j − u_i + w) − f of the faces of point i to the next row and the next column."""
    for i in range(len(graph.first) - 1):
        for k in range(graph.first[i], graph.first[i + 1]):
            if sides[k] >= 2:
                drop = u[graph.other[k]] - u[i] + crossing(graph.border[k], kind)
                out[3 - sides[k], i] = graph.weight[k] * drop - flux[k]

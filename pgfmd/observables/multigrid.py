"""Potentials of a graph by flexible conjugate gradients with aggregation multigrid (K-cycle: Notay, Vassilevski 2008,
doi:10.1002/nla.542), on slabs.

The finest level is a slab of the grid, the others have compressed rows.  Three levels lie in slabs, with copies of the
points of neighbouring ranks; aggregates stay within a slab.  The next one, .01 to .03 of the points, is gathered on
rank 0, and solved exactly if few of its points have many faces; otherwise it is coarsened until that holds.
Preconditioned residuals and directions in slabs are in single precision, which takes as many iterations as double.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.observables import flow_graph, flow_loops
from pgfmd.observables.elimination import Elimination, eliminated, solve_eliminated
from pgfmd.observables.flow_graph import Graph, match
from pgfmd.parallel.mpi import MPI

IN_SLABS = 3  # levels
MANY = 3_000  # points with many faces that are still eliminated, in .01 s.  Eliminating 7e4, .6 s, saves no iterations
SLOW = 0.8  # points left by a matching on rank 0 from which aggregates may have any size (hubs with many neighbours);
# if that does not help, any match is good (many equal faces per point).  Usually .5 to .7 are left
SIZES = 3, 6  # most points of an aggregate after the first and the second matching
FIRST = 4  # steps on rank 0 for the start
INNER, INNER_CUT = 4, 0.25  # most steps on a coarse level, and the factor by which the residual shall fall
LONGEST = 1e6  # step along a direction: 3e2 where conductances are 1e8 apart.  Rounding in r does not sum up to 0, and
# along the constant in it, which has no energy but rounding, steps were 1e14 to 1e28
PART = 1 << 16  # entries of a sum at a time
SMALLEST = 1e-300  # smaller diagonals are not inverted
NOTHING = np.empty(0)  # in place of a target of 0
NOWHERE = np.empty(0, np.int32)  # in place of aggregates: values are stored point by point


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
        unique = [np.unique(aggregate[part]) for part in self.sent]
        unique = [numbers[numbers >= 0] for numbers in unique]
        begin, copies, places = self.count, list[int](), np.empty(len(aggregate), np.int32)
        for side in (0, 1):
            own, sent = aggregate[self.sent[1 - side]], unique[1 - side]
            places[self.sent[1 - side]] = np.where(own < 0, -1, np.searchsorted(sent, own))
            self.fill(places)
            part = slice(begin, begin + self.copies[side])
            aggregate[part] = np.where(places[part] < 0, -1, count + sum(copies) + places[part])
            copies.append(int(places[part].max(initial=-1)) + 1)
            begin = part.stop
        return Halo(self.comm, count, unique, copies)


class Step(NamedTuple):
    """A direction, −A · direction (not kept on the finest level, where it would take most memory), and its energy."""

    direction: np.ndarray
    product: np.ndarray
    energy: float


class Level:
    """One level of the multigrid, with all coarser ones.  Vectors hold own points, then copies.  Collective to make.

    halo: None on levels of rank 0 alone.  On other ranks such levels have no points.
    """

    def __init__(self, graph: Graph, halo: Halo | None, depth: int = 0) -> None:
        self.graph, self.halo, self.depth = graph, halo, depth
        self.copies = sum(halo.copies) if halo else 0
        self.coarse: Level | None = None
        self.elimination: Elimination | None = None
        self.aggregate, self.inverse = NOWHERE, NOTHING
        if len(graph.first):
            diagonal = flow_graph.summed_diagonals(graph, NOWHERE, graph.points)
            self.inverse = np.divide(1, diagonal, out=np.zeros(graph.points), where=diagonal > SMALLEST)
        if halo is not None and depth == IN_SLABS:
            self._gather(halo)
            return
        if halo is None:
            self.elimination = eliminated(graph, MANY)
            if len(self.elimination.order) == graph.points:
                return
            self.elimination = None
        self.coarse = Level(*self._aggregated(halo), depth + 1)
        if halo is not None and len(graph.first):  # only levels of rank 0, which make the start, need it later
            self.graph = graph._replace(border=np.empty(0, np.int8))

    def _aggregated(self, halo: Halo | None) -> tuple[Graph, Halo | None]:
        """Joins points, and returns the graph and the halo of aggregates."""
        graph, sizes, diagonals = self.graph, np.ones(self.graph.points, np.int32), NOTHING
        if len(graph.first):  # on the grid 4 faces and `STRONG` imply the rule
            diagonals = flow_graph.summed_diagonals(graph, NOWHERE, graph.points)
        for most in SIZES:
            found, count = match(graph, sizes, diagonals, most, halo is None)
            for rule in (diagonals, NOTHING):
                if halo is None and count > SLOW * graph.points:
                    found, count = match(graph, sizes, rule, self.graph.points, True)
            sizes, parts = np.zeros(count, np.int32), sizes
            flow_loops.restrict(parts, found, graph.points, sizes)
            if halo is not None:
                found = np.concatenate([found, np.empty(sum(halo.copies), np.int32)])
                halo = halo.coarse(found, count)
            graph = flow_graph.coarsened(graph, found, count)
            if most == SIZES[0]:
                self.aggregate = found
                diagonals = flow_graph.summed_diagonals(self.graph, found, count)
            else:
                self.aggregate = np.append(found, np.int32(-1))[self.aggregate]  # −1, of no aggregate, stays
        return graph, halo

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

    def on_root(
        self, values: np.ndarray, work: Callable[[Level, np.ndarray], np.ndarray], counts: np.ndarray
    ) -> np.ndarray:
        """Gathers values on own points of all ranks, lets `work` map them on the level of rank 0, and returns this
        rank's part of the result.  counts: how many of its numbers each rank gets.  Collective.
        """
        assert self.halo is not None
        comm = self.halo.comm
        whole = np.empty(self.counts.sum() if comm.rank == 0 else 0)
        comm.Gatherv(np.ascontiguousarray(values[: self.graph.points]), [whole, self.counts])
        if self.root is not None:
            whole = work(self.root, whole)
        part = np.empty(counts[comm.rank])
        comm.Scatterv([whole, counts], part)
        return part

    def new(self, values: np.ndarray | float = 0.0, dtype: DTypeLike = float) -> np.ndarray:
        """A vector with these values on own points."""
        vector = np.zeros(self.graph.points + self.copies, dtype)
        vector[: self.graph.points] = values
        return vector

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """Σ a b over the points of all ranks.  Collective."""
        starts, n = range(0, self.graph.points, PART), self.graph.points  # parts, as other types are copied
        return self.sum(math.fsum(a[k : min(k + PART, n)] @ b[k : min(k + PART, n)] for k in starts))

    def sum(self, own: float) -> float:
        """Sum over the ranks.  Collective."""
        return own if self.halo is None else float(self.halo.comm.allreduce(own))

    def rest(self, target: np.ndarray, x: np.ndarray, out: np.ndarray, aggregate: np.ndarray = NOWHERE) -> np.ndarray:
        """Stores target − Ax in `out`, or adds it up over aggregates.  Returns `out`.  Collective."""
        if self.halo is not None:
            self.halo.fill(x)
        loop = flow_loops.residual if len(self.graph.first) else flow_loops.residual_in_slab
        loop(self.graph, target, x, aggregate, out)
        return out

    def restricted(self, values: np.ndarray) -> np.ndarray:
        """Sums over aggregates."""
        assert self.coarse is not None
        out = self.coarse.new()
        flow_loops.restrict(values, self.aggregate, self.graph.points, out)
        return out

    def prolonged(self, coarse: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Adds the value of its aggregate to each own point of `out`, and returns that."""
        flow_loops.prolong(coarse, self.aggregate, self.graph.points, out)
        return out

    def cycle(self, target: np.ndarray) -> np.ndarray:
        """z ≈ A⁻¹ target: a symmetric preconditioner, but for inner steps.  Collective."""
        if self.elimination is not None:
            return solve_eliminated(self.elimination, target.copy())
        if self.coarse is None:  # where no point has a neighbour, nothing is left there
            return self.new(self.on_root(target, Level.solved, self.counts))
        z = self.new(dtype=np.float32 if self.halo else float)
        self.sweep(target, z, False)
        coarse = self.rest(target, z, self.coarse.new(), self.aggregate)
        self.prolonged(self.coarse.solved(coarse), z)
        if self.halo is not None:
            self.halo.fill(z)
        self.sweep(target, z, True)
        return z

    def sweep(self, target: np.ndarray, x: np.ndarray, backward: bool) -> None:
        """Gauss–Seidel over own points."""
        if len(self.graph.first):
            flow_loops.relax(self.graph, self.inverse, target, x, backward)
        else:
            flow_loops.relax_in_slab(self.graph, target, x, backward)

    def solved(self, target: np.ndarray) -> np.ndarray:
        """About A⁻¹ target, by conjugate gradients; exact on the coarsest level.  The target is lost.  Collective."""
        if self.coarse is None:
            return self.cycle(target)
        x, r, last = self.new(), target, None
        goal = 0.0
        for k in range(INNER):
            square = self.sum(float((r[: self.graph.points] * self.inverse) @ r[: self.graph.points]))
            goal = goal or INNER_CUT**2 * square
            if square <= goal and k or square == 0:
                break
            last = self.advance(x, r, self.cycle(r), last)
            if last is None:
                break
        return x

    def start(self, b: np.ndarray, kind: int) -> np.ndarray:
        """A good start for Au = b.  Collective."""
        if self.coarse is not None and self.halo is not None:
            return self.prolonged(self.coarse.start(self.restricted(b), kind), self.new())
        if self.halo is not None:
            return self.new(self.on_root(b, lambda root, whole: root.start(whole, kind), self.counts))
        last: Level = self
        largest: np.ndarray = np.arange(self.graph.points, dtype=np.int32)
        while last.coarse is not None:
            largest, last = last.aggregate[largest], last.coarse
        x = flow_graph.unrolled(self.graph, largest, kind)
        x += last.cycle(self.rest(b, x, last.new(), largest))[largest]
        r, step = self.rest(b, x, self.new()), None
        for _ in range(0 if last is self else FIRST):
            step = self.advance(x, r, self.cycle(r), step)
        return x

    def advance(self, x: np.ndarray, r: np.ndarray, z: np.ndarray, last: Step | None) -> Step | None:
        """Moves x along z, made conjugate to the last step, and updates r.  Returns the step; None if r is but
        rounding.  Collective.
        """
        lean = len(self.graph.first) == 0
        if last is not None:
            both = self.form(z, last.direction) if lean else -self.dot(z, last.product)
            flow_loops.add_scaled(z, -both / last.energy, last.direction, z)
        product = NOTHING if lean else self.rest(NOTHING, z, self.new())
        energy = self.form(z, z) if lean else -self.dot(z, product)
        length = self.dot(z, r) / energy if energy > 0 else 0.0
        if not abs(length) <= LONGEST:
            return None
        if lean:  # r remains b − Ax: x changes by the rounded direction
            z *= np.float32(length)
            energy, length = energy * length**2, 1.0
            self.rest(r, z, r)
        else:
            flow_loops.add_scaled(r, length, product, r)
        flow_loops.add_scaled(x, length, z, x)
        return Step(z, product, energy or math.inf)

    def form(self, a: np.ndarray, b: np.ndarray, kind: int = 0) -> float:
        """Σ T (a_j − a_i + w)(b_j − b_i + w) over the faces of a slab's graph; kind 0: without w.  Collective."""
        assert self.halo is not None
        self.halo.fill(a)
        if b is not a:
            self.halo.fill(b)
        return self.sum(flow_loops.form_in_slab(self.graph, kind, a, b))

    def fluxes(self, r: np.ndarray, keep: bool = True) -> tuple[np.ndarray, float]:
        """A flux f_ij on the faces with Σ_j f_ij = r_i.  On the finest level also Σ f²/T over the faces of this rank's
        points, each counted for both; elsewhere that has no meaning.  keep: else the flux of a slab of the grid is not
        stored.  Collective.
        """
        graph = self.graph
        if self.elimination is not None:
            x = self.cycle(r)
            return graph.weight * (np.repeat(x, np.diff(graph.first)) - x[graph.other]), 0.0
        if self.coarse is None:
            return self.on_root(r, lambda root, whole: root.fluxes(whole)[0], self.faces), 0.0
        above, _ = self.coarse.fluxes(self.restricted(r))
        r = r[: graph.points]
        if len(graph.first):
            return flow_graph.shared_flux(graph, self.coarse.graph, above, self.aggregate, r), 0.0
        flux = np.zeros(2 * graph.points if keep else 0)
        return flux, flow_graph.shared_flux_in_slab(graph, self.coarse.graph, above, self.aggregate, r, flux)

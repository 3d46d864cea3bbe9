"""One process does one rank's share of a grid, with messages left out: what many ranks would compute, without them."""

import math
import time

import numpy as np

from pgfmd.grid import transfer
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel import alone
from pgfmd.parallel.layout import RowPlan
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.active_set.particle_mesh import MeshResponse
from pgfmd.solvers.active_set.preconditioner import MultilevelStiffness
from pgfmd.solvers.active_set.unknowns import SetVector, Unknowns

AREA, PATCH = 0.08, 12  # contact that is spread evenly: part of the points, in patches of so many points each way
SECONDS = 1.0  # for which each part is repeated


class Silent(alone.Comm):
    """A rank of many.  What it sends is lost, what it receives is 0; reductions give its own value.

    The other ranks ask for the same rows as this one, counted from where they are (`step` rows per rank).
    """

    def __init__(self, size: int, rank: int) -> None:
        self.size, self.rank, self.step = size, rank, 0

    def Allgather(self, send, receive) -> None:
        """What the others ask for."""
        receive[...] = send + self.step * (np.arange(self.size) - self.rank)[:, None, None]

    def Alltoallv(self, send, receive) -> None:
        """Nothing comes."""

    def Irecv(self, message, source: int, tag: int) -> alone.Request:
        """Zeros."""
        message[0][...] = 0
        return alone.Request()

    def Isend(self, message, target: int) -> alone.Request:
        """Lost."""
        return alone.Request()


def _planned(plan: RowPlan, layout, ranges, places=None, make=RowPlan.__init__) -> None:
    if isinstance(layout.comm, Silent):
        layout.comm.step = int(layout.starts[-1]) // layout.comm.size
    make(plan, layout, ranges, places)


def _team(comm, holders: int):
    """As `team_of`, for a rank that is rank 0, or has the same place in both."""
    if holders == comm.size:
        return comm
    if holders == 1:
        return alone.COMM_SELF if comm.rank == 0 else None
    mine = -(-comm.rank * holders // comm.size)
    return Silent(holders, mine) if mine * comm.size // holders == comm.rank else None


def emulate(n: int, ranks: int) -> dict[str, float]:
    """Processor nanoseconds per point of the share of rank 0, which has most, in one transform pair of n × n points
    (double precision), and in one application of the mesh and of the blocks; on one rank, of its whole grid.
    """
    RowPlan.__init__ = _planned
    transfer.team_of = _team
    comm = Silent(ranks, 0) if ranks > 1 else alone.COMM_SELF
    grid = SlabGrid(comm, (n, n), threads=1, transform="exchanged")
    field = np.random.default_rng(1).standard_normal(grid.local_shape)
    share = field.size

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        rows[...] = field[first:stop]

    def drain(first: int, stop: int, rows: np.ndarray) -> None:
        field[first:stop] = rows

    def scale(block: np.ndarray, *_: int) -> None:
        block *= 1 / grid.size

    found = {"emulated": n, "ranks": ranks, "rows": grid.local_shape[0]}
    found["pair"] = 1e9 * _best(lambda: grid.convolve(fill, scale, drain)) / share
    grid.free()
    return found | _inner(grid)


def _inner(grid: SlabGrid) -> dict[str, float]:
    """Of the mesh's response, and of the preconditioner with its blocks; and the part of the points in contact."""
    solid = Homogeneous(contact_modulus=2.66667)
    mesh = MeshResponse(grid, solid.half_space_compliance, solid.compliance)
    blocks = MultilevelStiffness(grid, solid.half_space_stiffness, solid.stiffness)
    along = np.arange(grid.shape[1]) // PATCH
    rows = np.arange(grid.rows.start, grid.rows.stop)[:, None] // PATCH
    chance = np.sin(12.9898 * rows + 78.233 * along) * 43758.5453 % 1  # the same at any rank count
    points = Unknowns(grid, ((chance < AREA).astype(float), np.ones(grid.local_shape)), -math.inf)
    values, out = SetVector(points), np.empty(points.count, np.float32)
    values.all[:] = 0
    values.own[:] = np.random.default_rng(2).standard_normal(points.count)
    share = math.prod(grid.local_shape)
    return {
        "mesh": 1e9 * _best(lambda: mesh.apply(values, out)) / share,
        "blocks": 1e9 * _best(lambda: blocks.apply(values, out)) / share,
        "area": points.count / share,
    }


def _best(work, least: int = 3) -> float:
    """Processor seconds of the fastest of some repetitions."""
    work()
    best, began, count = math.inf, time.process_time(), 0
    while count < least or time.process_time() - began < SECONDS:
        before = time.process_time()
        work()
        best, count = min(best, time.process_time() - before), count + 1
    return best

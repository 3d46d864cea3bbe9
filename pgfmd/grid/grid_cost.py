"""What a part of a run costs, as it declares it for `pgfmd check`; how many ranks hold a grid.  No MPI here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """Work in pairs of transforms in double precision; memory in bytes per point, beside heights, pressure and gap."""

    transforms: float = 0.0
    memory: float = 0.0


LEAST_ROWS = 16  # of a rank: more ranks, with fewer rows each, would not solve a grid faster
LEAST_MESH_ROWS = 4  # the same of meshes and blocks, for which every inner iteration waits
ROOM = 1 << 20  # points of a rank whose transforms are kept, 4 or 8 MB: on many ranks shared memory is slow to make
SMALL = 256 * 256  # points that one rank alone transforms in the time of a few messages


def holders(shape: tuple[int, int], ranks: int, least: int = LEAST_ROWS) -> int:
    """How many of the ranks share a grid of nx × ny points, in slabs of at least so many rows."""
    return 1 if shape[0] * shape[1] <= SMALL else max(1, min(ranks, shape[0] // least))


def largest_shares(shape: tuple[int, int], ranks: int, of: int = 1) -> list[int]:
    """Points that the first `of` ranks, which have most, hold of a grid and of the coarser ones of nested iteration."""
    shares: list[int] = []  # down to the first that is on rank 0 alone, as all coarser ones are
    holding = ranks
    while not shares or min(shape) > 1 and shape[0] * shape[1] > SMALL // 4:
        holding = holders(shape, holding) if shares else ranks
        shares.append(min(-(-shape[0] // holding) * -(-of * holding // ranks), shape[0]) * shape[1])
        shape = -(-shape[0] // 2), -(-shape[1] // 2)
    return shares

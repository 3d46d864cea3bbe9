"""How many ranks hold a grid.  No MPI here: `pgfmd check` asks, too."""

from __future__ import annotations

ROWS = 16  # per rank, at least: of a grid that a rank with fewer would solve no faster
FEW = 4  # the same of grids on which each inner iteration depends
SMALL = 256 * 256  # points that one rank alone transforms in the time of a few messages


def holders(shape: tuple[int, int], ranks: int, least: int = ROWS) -> int:
    """Of so many ranks, those that share a grid of nx × ny points in slabs of at least that many rows."""
    return 1 if shape[0] * shape[1] <= SMALL else max(1, min(ranks, shape[0] // least))


def largest_shares(shape: tuple[int, int], ranks: int) -> list[int]:
    """Points of rank 0, which has most, of a grid on all ranks and of the coarser ones of nested iteration."""
    shares: list[int] = []
    while not shares or min(shape) > 1 and shape[0] * shape[1] > SMALL // 4:
        ranks = holders(shape, ranks) if shares else ranks
        shares.append(-(-shape[0] // ranks) * shape[1])
        shape = -(-shape[0] // 2), -(-shape[1] // 2)
    return shares

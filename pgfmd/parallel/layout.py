"""How rows lie on ranks, and how they travel: from the ranks that hold them to those that need them, and back.

A plan is made once and knows its partners; carrying it out costs messages between these alone, whatever the number of
ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.parallel.collectives import slab_starts
from pgfmd.parallel.mpi import MPI, datatype
from pgfmd.parallel.threads import Threads

Range = tuple[int, int]
"""Rows low … high−1 of a periodic array: they may cross its edge, and be more than a period."""
Offsets = tuple[np.ndarray, np.ndarray]
"""For rows of different lengths, one after the other in flat arrays: where each row of the source begins, and the end
of the last; the same of the target."""

Piece = tuple[int, np.ndarray]
"""First row, and the rows."""

JOINED = 1 << 20  # bytes up to which rows of several arrays go to a rank in one message


class Layout:
    """Rank r of `comm` holds rows starts[r] … starts[r+1]−1 of an array, or none; `rows`: those of this rank."""

    def __init__(self, comm: MPI.Comm, starts: np.ndarray) -> None:
        self.comm, self.starts = comm, starts
        self.rows = slice(int(starts[comm.rank]), int(starts[comm.rank + 1]))

    @classmethod
    def spread(cls, comm: MPI.Comm, count: int, holders: int) -> Layout:
        """`count` rows over so many of the ranks, evenly spaced from rank 0 on."""
        rows = np.zeros(comm.size, np.int64)
        rows[np.arange(holders) * comm.size // holders] = np.diff(slab_starts(count, holders))
        return cls(comm, np.concatenate([[0], np.cumsum(rows)]))

    def fetch(self, field: np.ndarray, first: int, stop: int, threads: Threads | None = None) -> np.ndarray:
        """Rows first … stop−1 of a field of which this rank holds `rows`, as a new array; each rank may ask for others.
        Collective.

        threads: they copy the rows that the rank holds itself.
        """
        out = np.empty((max(stop - first, 0), *field.shape[1:]), field.dtype)
        return RowPlan(self, [(first, stop)]).fetch(field, out, threads=threads)


class RowPlan:
    """Rows of some ranges that each rank needs, of an array with that layout.  Collective to make, not to carry out:
    only ranks that have something for each other communicate.

    sends: (rank, first, stop), rows local to this rank.  receives: (rank, at, end), rows of a `target` that holds the
    ranges one after the other, or each from its `places` on.  copies: (first, stop, at) of rows of its own.  Both sides
    list what passes between them in the same order.
    """

    def __init__(self, layout: Layout, ranges: Sequence[Range], places: Sequence[int] | None = None) -> None:
        self.comm, rank = layout.comm, layout.comm.rank
        wanted = np.empty((layout.comm.size, len(ranges), 2), np.int64)
        if self.comm.size > 1:
            self.comm.Allgather(np.array(ranges, np.int64), wanted)
        lengths = [max(high - low, 0) for low, high in ranges]
        places = np.cumsum([0, *lengths[:-1]]).tolist() if places is None else places
        self.sends: list[tuple[int, int, int]] = []
        self.receives: list[tuple[int, int, int]] = []
        self.copies: list[tuple[int, int, int]] = []
        for which, (low, high) in enumerate(ranges):
            for owner, first, stop, offset in _owners(low, high, layout.starts):
                at = places[which] + offset
                if owner == rank:
                    self.copies.append((first, stop, at))
                else:
                    self.receives.append((owner, at, at + stop - first))
            if self.comm.size > 1:
                self.sends += (piece for piece in _askers(wanted[:, which], layout) if piece[0] != rank)

    def fetch(self, source: np.ndarray, target: np.ndarray, threads: Threads | None = None) -> np.ndarray:
        """Brings rows of `source`, this rank's, to the `target`s of the ranks that need them; returns this rank's."""
        exchange = Exchange(self.comm)
        exchange.fetch(self, source, target, threads=threads)
        exchange.carry_out()
        return target


class Exchange:
    """Rows of one plan or of several, on their way together: at most one message to each partner and one from each.

    All ranks add the same plans in the same order, then `start`, then `finish`.  Arrays may be used again after that.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self.comm = comm
        self._sent: dict[int, list[np.ndarray]] = {}
        self._received: dict[int, list[np.ndarray]] = {}
        self.requests: list[MPI.Request] = []
        self._joined: list[tuple[np.ndarray, list[np.ndarray]]] = []

    def fetch(
        self,
        plan: RowPlan,
        source: np.ndarray,
        target: np.ndarray,
        offsets: Offsets | None = None,
        threads: Threads | None = None,
    ) -> None:
        """Adds: rows of `source`, this rank's, to the `target`s of the ranks that need them.

        threads: they copy the rows that the rank holds itself.
        """
        here, there = (_part(known) for known in offsets or (None, None))
        for owner, at, end in plan.receives:
            self._received.setdefault(owner, []).append(target[there(at, end)])
        for rank, *rows in plan.sends:
            self._sent.setdefault(rank, []).append(source[here(*rows)])
        for first, stop, at in plan.copies:
            part, to = source[here(first, stop)], target[there(at, at + stop - first)]
            if threads is None:
                to[...] = part
            else:
                threads.split(partial(_copy, part, to), len(part))

    def give(self, plan: RowPlan, target: np.ndarray) -> list[Piece]:
        """Adds: the rows of `target` back to the ranks that hold them.  Returns what will have come to this one, those
        of its own `target` included: (first local row, rows), which are to be added up.
        """
        pieces = [(first, np.empty((stop - first, *target.shape[1:]), target.dtype)) for _, first, stop in plan.sends]
        for (rank, *_), (_, rows) in zip(plan.sends, pieces, strict=True):
            self._received.setdefault(rank, []).append(rows)
        for owner, at, end in plan.receives:
            self._sent.setdefault(owner, []).append(target[at:end])
        return pieces + [(first, target[at : at + stop - first]) for first, stop, at in plan.copies]

    def start(self) -> None:
        """Sends what was added."""
        messages: list[tuple[int, np.ndarray]] = []
        for rank, parts in self._received.items():
            whole = _one_message(parts)
            messages += ((rank, each) for each in (parts if whole is None else [whole]))
            if whole is not None and len(parts) > 1:
                self._joined.append((whole, parts))
        self.requests = [self.comm.Irecv(_items(rows), rank, 0) for rank, rows in messages if rows.size]
        for rank, parts in self._sent.items():
            whole = _one_message(parts)
            if whole is not None and len(parts) > 1:
                _copy_parts(whole, parts, join=True)
            for rows in parts if whole is None else [whole]:
                if rows.size:
                    self.requests.append(self.comm.Isend(_items(rows), rank))

    def finish(self) -> None:
        """Waits until all has come and gone."""
        MPI.Request.Waitall(self.requests)
        for whole, parts in self._joined:
            _copy_parts(whole, parts, join=False)

    def carry_out(self) -> None:
        """Sends what was added, and waits."""
        if self._sent or self._received:
            self.start()
            self.finish()


class RowWindow:
    """Rows low … high−1 (periodic) of an array with that layout, widened where they lack rows of this rank.  Collective
    to make.

    Attributes: low; rows (high − low, width), both after widening; own: this rank's rows, a view of `rows`; begin, end:
    where in `rows` they begin and end.
    """

    def __init__(self, layout: Layout, span: Range, width: int, dtype: DTypeLike = np.float32) -> None:
        first, stop = layout.rows.start, layout.rows.stop
        low, high = (min(span[0], first), max(span[1], stop)) if first < stop else span
        self.low, self.begin, self.end = low, max(first - low, 0), max(stop - low, 0)
        if first == stop:
            self.begin = self.end = 0
        self.rows = np.zeros((high - low, width), dtype)
        self.own = self.rows[self.begin : self.end]
        around = [(low, low + self.begin), (low + self.end, high)]
        self.plan = RowPlan(layout, around, (0, self.end))

    @property
    def around(self) -> list[Range]:
        """The rows of the window that are not this rank's, numbered as in `rows`."""
        return [(0, self.begin), (self.end, len(self.rows))]

    def fetch(self) -> None:
        """Fills the window from this rank's rows and those of the ranks that hold the others.  Collective."""
        self.plan.fetch(self.own, self.rows)

    def add(self) -> None:
        """Adds to each rank's own rows what the others have in their windows.  Collective."""
        exchange = Exchange(self.plan.comm)
        pieces = exchange.give(self.plan, self.rows)
        exchange.carry_out()
        for first, rows in pieces:
            self.own[first : first + len(rows)] += rows


def _owners(low: int, high: int, starts: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """The periodic range low … high−1 cut at the edges of slabs: (owner, first and last + 1 of its rows, offset from
    low).
    """
    total, at = int(starts[-1]), low
    while at < high:
        row = at % total
        owner = int(np.searchsorted(starts, row, side="right")) - 1
        first, length = row - int(starts[owner]), min(high - at, int(starts[owner + 1]) - row)
        yield owner, first, first + length, at - low
        at += length


def _askers(wanted: np.ndarray, layout: Layout) -> Iterator[tuple[int, int, int]]:
    """The ranks whose range, a (low, high) in `wanted`, has rows of this one: (rank, first, last + 1 of them)."""
    start, stop, total = layout.rows.start, layout.rows.stop, int(layout.starts[-1])
    low, high = wanted.T
    asking = low < high
    if start == stop or not asking.any():
        return
    for shift in range(int((low[asking].min() - stop) // total), int((high[asking].max() - start) // total) + 1):
        begin, end = np.maximum(low, start + shift * total), np.minimum(high, stop + shift * total)
        for rank in np.flatnonzero(begin < end):
            yield int(rank), int(begin[rank]) - shift * total - start, int(end[rank]) - shift * total - start


def _part(offsets: np.ndarray | None) -> Callable[[int, int], slice]:
    """Which entries rows first … stop−1 are."""
    return slice if offsets is None else lambda first, stop: slice(int(offsets[first]), int(offsets[stop]))


def _copy(source: np.ndarray, target: np.ndarray, first: int, stop: int) -> None:
    target[first:stop] = source[first:stop]


def _one_message(parts: list[np.ndarray]) -> np.ndarray | None:
    """The only part, or room for all of them one after the other; None if they are so large that a copy takes longer
    than a message.
    """
    if len(parts) == 1:
        return parts[0]
    size = sum(part.nbytes for part in parts)
    return np.empty(size, np.uint8) if size <= JOINED else None


def _copy_parts(whole: np.ndarray, parts: list[np.ndarray], join: bool) -> None:
    """Copies the parts into the bytes `whole`, one after the other; without `join` back from there."""
    at = 0
    for part in parts:
        raw, here = part.reshape(-1).view(np.uint8), whole[at : at + part.nbytes]
        at += part.nbytes
        if join:
            here[:] = raw
        else:
            raw[:] = here


def _items(rows: np.ndarray) -> list:
    """A message counted in items: counts above 2³¹ bytes are refused by most MPI libraries."""
    return [rows, datatype(rows.dtype)]

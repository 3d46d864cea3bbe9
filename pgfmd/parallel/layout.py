"""Which rank holds which rows, and exchanges: rows go from the ranks that hold them to those that need them, and back.

A plan is made once and knows its partners; an exchange sends messages to these alone, whatever the number of ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.parallel.collectives import slab_starts
from pgfmd.parallel.mpi import MPI, datatype
from pgfmd.parallel.threads import Threads

Range = tuple[int, int]
"""Rows low … high−1 of a periodic array: they may cross its edge, and be more than a period."""
Offsets = tuple[np.ndarray, np.ndarray]
"""For rows of different lengths in flat arrays: the entry at which each row of the source begins, and the end of the
last; the same of the target."""

Piece = tuple[int, np.ndarray]
"""First row, and the rows."""

JOINED = 1 << 20  # bytes up to which all that goes to a rank is packed into one message
# By `hops`, rows of so many ranks meet on one: on 64 ranks rank 0 gets 9 messages, not 63.
RADIX = 4


class Layout:
    """Rank r of `comm` holds rows starts[r] … starts[r+1]−1 of an array, or none; `rows`: those of this rank."""

    def __init__(self, comm: MPI.Comm, starts: np.ndarray) -> None:
        self.comm, self.starts = comm, starts
        self.rows = slice(int(starts[comm.rank]), int(starts[comm.rank + 1]))

    @classmethod
    def spread(cls, comm: MPI.Comm, count: int, holders: int) -> Layout:
        """`count` rows on `holders` of the ranks, which are evenly spaced from rank 0 on."""
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
    """Which rows of an array go from rank to rank, so that each rank gets its `ranges`.  Collective to make; in an
    exchange only partners communicate.

    places: row of the target at which each range begins; None: one after the other.  count: rows of all ranges.
    sends: (rank, first, stop), local rows of this rank.  receives: (rank, at, end), rows of the target.  copies:
    (first, stop, at), local rows that stay here.  Sender and receiver list their pieces in the same order.
    """

    def __init__(self, layout: Layout, ranges: Sequence[Range], places: Sequence[int] | None = None) -> None:
        self.comm, rank = layout.comm, layout.comm.rank
        wanted = np.empty((layout.comm.size, len(ranges), 2), np.int64)
        if self.comm.size > 1:
            self.comm.Allgather(np.array(ranges, np.int64), wanted)
        lengths = [max(high - low, 0) for low, high in ranges]
        self.count = sum(lengths)
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
        """Sends rows of each rank's `source` to the `target` of each rank that needs them; returns this rank's."""
        exchange = Exchange(self.comm)
        exchange.fetch(self, source, target, threads=threads)
        exchange.carry_out()
        return target


class Exchange:
    """The exchange of one or several plans at once: one message to each partner and one from it, up to `JOINED` bytes.

    All ranks add the same plans in the same order, then call `start` and `finish`.  Arrays must not change in between.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self.comm = comm
        self._sent: dict[int, list[np.ndarray]] = {}
        self._received: dict[int, list[np.ndarray]] = {}
        self.requests: list[MPI.Request] = []
        self._joined: list[tuple[np.ndarray, list[np.ndarray]]] = []
        self._later: list[tuple[RowPlan, np.ndarray, np.ndarray]] = []

    def fetch(
        self,
        plan: RowPlan,
        source: np.ndarray,
        target: np.ndarray,
        offsets: Offsets | None = None,
        threads: Threads | None = None,
    ) -> None:
        """Adds a transfer of rows of this rank's `source` into the `target` of each rank that needs them.

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
        """Adds the transfer back: rows of each `target` to the ranks that hold them.  Returns (first local row, rows)
        of what this rank gets, from its own `target` too, for the caller to add up after `finish`.
        """
        pieces = [(first, np.empty((stop - first, *target.shape[1:]), target.dtype)) for _, first, stop in plan.sends]
        for (rank, *_), (_, rows) in zip(plan.sends, pieces, strict=True):
            self._received.setdefault(rank, []).append(rows)
        for owner, at, end in plan.receives:
            self._sent.setdefault(owner, []).append(target[at:end])
        return pieces + [(first, target[at : at + stop - first]) for first, stop, at in plan.copies]

    def relay(self, plans: Sequence[RowPlan], source: np.ndarray, target: np.ndarray) -> None:
        """Adds a transfer by `hops`: the first with the other plans, the rest in `finish`, one after the other."""
        between = [np.empty((plan.count, *source.shape[1:]), source.dtype) for plan in plans[:-1]]
        fields = [source, *between, target]
        self.fetch(plans[0], source, fields[1])
        self._later += zip(plans[1:], fields[1:-1], fields[2:], strict=True)

    def start(self) -> None:
        """Posts all messages."""
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
        """Waits until all messages have arrived and are unpacked; then carries out the further hops of `relay`."""
        MPI.Request.Waitall(self.requests)
        for whole, parts in self._joined:
            _copy_parts(whole, parts, join=False)
        for plan, source, target in self._later:
            plan.fetch(source, target)

    def carry_out(self) -> None:
        """`start` and `finish`, if this rank has partners."""
        if self._sent or self._received or self._later:
            self.start()
            self.finish()


def hops(source: Layout, target: Layout) -> list[RowPlan]:
    """Plans by which all rows go from one layout to another.  If one layout has over `RADIX` times as many holders as
    the other, rows go through layouts between; each has 1/`RADIX` of the holders of the larger one beside it.
    Collective.
    """
    holders = [int(np.count_nonzero(np.diff(layout.starts))) for layout in (source, target)]
    most, counts = max(holders), list[int]()
    while most > RADIX * min(holders):
        most = -(-most // RADIX)
        counts.append(most)
    counts.sort(reverse=holders[0] > holders[1])
    stops = [source, *(Layout.spread(source.comm, int(source.starts[-1]), count) for count in counts), target]
    return [RowPlan(here, [(there.rows.start, there.rows.stop)]) for here, there in pairwise(stops)]


class RowWindow:
    """Rows low … high−1 (periodic) of an array with that layout, on this rank; the span is widened to hold the rank's
    own rows.  Collective to make.

    Attributes: low and rows (high − low, width), of the widened span; own: this rank's rows, rows[begin:end], a view.
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
    """The periodic range low … high−1 cut at edges of slabs: (owner, its rows first … stop−1, offset from low)."""
    total, at = int(starts[-1]), low
    while at < high:
        row = at % total
        owner = int(np.searchsorted(starts, row, side="right")) - 1 if len(starts) > 2 else 0
        first, length = row - int(starts[owner]), min(high - at, int(starts[owner + 1]) - row)
        yield owner, first, first + length, at - low
        at += length


def _askers(wanted: np.ndarray, layout: Layout) -> Iterator[tuple[int, int, int]]:
    """The ranks whose periodic range in `wanted` (ranks, 2) has rows of this rank: (rank, first, last + 1), local."""
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
    """A function of (first, stop): the entries of these rows."""
    return slice if offsets is None else lambda first, stop: slice(int(offsets[first]), int(offsets[stop]))


def _copy(source: np.ndarray, target: np.ndarray, first: int, stop: int) -> None:
    target[first:stop] = source[first:stop]


def _one_message(parts: list[np.ndarray]) -> np.ndarray | None:
    """The only part, or an empty buffer for all; None if packing them would take longer than several messages."""
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
    """A message counted in items: most MPI libraries refuse counts above 2³¹ (bytes)."""
    return [rows, datatype(rows.dtype)]

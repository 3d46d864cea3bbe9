"""Where a run runs: ranks, nodes, cores, threads, memory, libraries.  Logged once, at its start."""

from __future__ import annotations

import logging
import math
import os
import platform
from collections import Counter

from pgfmd import __version__
from pgfmd.application import hdf5_slabs
from pgfmd.application.estimate import estimate
from pgfmd.application.job import Job
from pgfmd.application.memory import available_memory, largest_memory, readable
from pgfmd.application.provenance import git_commit, versions
from pgfmd.errors import InputError
from pgfmd.options.text import counted
from pgfmd.parallel.collectives import from_root
from pgfmd.parallel.mpi import MPI, library
from pgfmd.parallel.threads import threads_per_rank

log = logging.getLogger("pgfmd")

TOO_MUCH = 1.2  # an estimate above this many times a node's memory is refused; estimates are right to 15 %


def _nodes(comm: MPI.Comm) -> list[tuple[str, int, float]]:
    """Name, number of ranks and bytes of memory of the node of each rank.  Collective."""
    found = comm.allgather((platform.node(), largest_memory()))
    ranks = Counter(node for node, _ in found)
    return [(node, ranks[node], largest) for node, largest in found]


def room_per_rank(comm: MPI.Comm) -> float:
    """Bytes per rank on the node with the least memory per rank.  Collective."""
    return min(largest / count for _, count, largest in _nodes(comm))


def ranks_per_node(comm: MPI.Comm) -> int:
    """Ranks of the fullest node.  Collective."""
    return max(count for _, count, _ in _nodes(comm))


def memory_per_rank(job: Job, comm: MPI.Comm, room: float = math.inf) -> float:
    """Bytes that a job takes on the fullest node, over its ranks; `room` as of `estimate`.  Collective."""
    here = ranks_per_node(comm)
    return from_root(comm, estimate, job, comm.size, room, here).node / here  # may read the surface's table


def refuse_too_large(comm: MPI.Comm, per_rank: float) -> None:
    """Raise InputError on all ranks if `per_rank` bytes each exceed the whole memory of a node.  Collective."""
    for node, count, largest in _nodes(comm):
        if count * per_rank > TOO_MUCH * largest:
            raise InputError(
                f"the job takes about {readable(count * per_rank)} of memory on {node}, which has "
                f"{readable(largest)}; take more nodes, or a smaller grid"
            )


def report(comm: MPI.Comm, per_rank: float) -> None:
    """Log ranks, nodes, threads, libraries and the memory needed, `per_rank` bytes; warn of too little memory or too
    few cores.  Collective.
    """
    here = platform.node(), os.sched_getaffinity(0), threads_per_rank(), available_memory()
    found = comm.gather(here)
    if found is not None:
        log.info("pgfmd %s, commit %s", __version__, git_commit()[:12])
        log.info("MPI: %s, HDF5 %s", library(), hdf5_slabs.version())
        log.info("%s", ", ".join(versions().split("\n")))
        for level, line in describe(found, per_rank):
            log.log(level, "%s", line)


def describe(found: list[tuple[str, set[int], int, float]], per_rank: float) -> list[tuple[int, str]]:
    """The lines of the log, each with its level.

    found: for each rank its node, the cores that it may use, its threads, and the bytes available on the node.
    per_rank: bytes that each rank needs.
    """
    ranks = Counter(node for node, *_ in found)
    memory = {node: available for node, _, _, available in found}
    threads: Counter[str] = Counter()
    cores: dict[str, set[int]] = {node: set() for node in ranks}
    for node, bound, count, _ in found:
        threads[node] += count
        cores[node] |= bound
    spread = ", ".join(f"{node}: {count}" for node, count in list(ranks.items())[:8])
    more = f", and {len(ranks) - 8} more" if len(ranks) > 8 else ""
    counts = sorted({count for _, _, count, _ in found})
    lines = [
        (
            logging.INFO,
            f"{counted(len(found), 'rank')} on {counted(len(ranks), 'node')} ({spread}{more}) × "
            f"{counted(counts[-1], 'thread')}" + f" (some {counts[0]})" * (len(counts) > 1),
        )
    ]
    tight = min(ranks, key=lambda node: memory[node] - ranks[node] * per_rank)
    need = ranks[tight] * per_rank
    lines.append(
        (
            logging.INFO,
            f"memory: about {readable(per_rank)} per rank, {readable(need)} on {tight} of {readable(memory[tight])} "
            "available",
        )
    )
    if need > memory[tight]:
        lines.append((logging.WARNING, f"{tight}: the memory will not suffice; take more nodes, or a smaller grid"))
    crowded = [node for node in ranks if threads[node] > max(len(cores[node]), ranks[node])]
    if crowded:
        lines.append(
            (
                logging.WARNING,
                f"{crowded[0]}: {threads[crowded[0]]} threads on {counted(len(cores[crowded[0]]), 'core')}; "
                "set OMP_NUM_THREADS to cores / ranks",
            )
        )
    return lines

"""The machine of a run (ranks, nodes, cores, memory, libraries) and provenance (version, commit, command, date)."""

import functools
import json
import logging
import math
import os
import platform
import shlex
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib import metadata
from pathlib import Path

from pgfmd import __version__
from pgfmd.application import hdf5_slabs
from pgfmd.application.estimate import Plan, explored
from pgfmd.application.files import FORMAT_VERSION
from pgfmd.application.job import Job
from pgfmd.errors import InputError
from pgfmd.options.text import counted, readable
from pgfmd.parallel.collectives import from_root
from pgfmd.parallel.mpi import MPI, library
from pgfmd.parallel.threads import threads_per_rank

log = logging.getLogger("pgfmd")

TOO_MUCH = 1.2  # an estimate above this many times a node's memory is refused; estimates are right to 15 %
CGROUPS = (  # files with limit and use of memory: of version 2, and of version 1
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
LIBRARIES = ("numpy", "scipy", "numba", "pyfftw", "mpi4py", "mpi4py-fft", "h5py")


def command_line() -> str:
    """The command that started this process, quoted for a shell."""
    return shlex.join(sys.orig_argv)


@functools.cache
def git_commit() -> str:
    """The commit of the checkout that holds the package, with "+" if files were changed since; else "unknown"."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    with suppress(OSError, subprocess.SubprocessError):
        if Path(git("rev-parse", "--show-toplevel")) == root:
            return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    return "unknown"


def now() -> str:
    """The time in ISO 8601, to the second, with the zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


@functools.cache
def versions() -> str:
    """Versions of Python and of the libraries, one per line: "name version"."""
    lines = [f"python {platform.python_version()}"]
    for name in LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            lines.append(f"{name} {metadata.version(name)}")
    return "\n".join(lines)


@dataclass(frozen=True)
class Origin:
    """The input of a run: TOML text, effective job, number of loads, and digests of the files that the job names."""

    job_toml: str = ""
    effective_toml: str = ""
    loads: int = 0
    inputs: dict[str, str] = field(default_factory=dict)


def gather(ranks: int, extra_versions: dict[str, str], origin: Origin) -> dict[str, str | int]:
    """The provenance, as attributes of the root of a result file."""
    extra = "".join(f"\n{name} {version}" for name, version in extra_versions.items())
    return {
        "software": "pgfmd",
        "softwareVersion": __version__,
        "format_version": FORMAT_VERSION,
        "commit": git_commit(),
        "command": command_line(),
        "job_toml": origin.job_toml,
        "effective_toml": origin.effective_toml,
        "inputs": json.dumps(origin.inputs),
        "libraries": versions() + extra,
        "ranks": ranks,
        "threads": threads_per_rank(),
        "host": platform.node(),
        "date": now(),
    }


def available_memory() -> float:
    """Bytes that this process can still get: as the system reports, or fewer if its control group allows no more."""
    return min([_physical(), *_meminfo("MemAvailable"), *(limit - used for limit, used in _control_groups())])


def largest_memory() -> float:
    """Bytes of memory of this machine, swap included, or fewer if the control group allows no more."""
    return min([_physical() + sum(_meminfo("SwapTotal")), *(limit for limit, _ in _control_groups())])


def _physical() -> float:
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def _meminfo(name: str) -> list[float]:
    return [1024.0 * int(line.split()[1]) for line in _lines("/proc/meminfo") if line.startswith(f"{name}:")]


def _control_groups() -> list[tuple[float, float]]:
    """(limit, used) in bytes of each control group that gives both."""
    pairs = [[line.strip() for name in names for line in _lines(name)] for names in CGROUPS]
    return [(float(pair[0]), float(pair[1])) for pair in pairs if len(pair) == 2 and all(map(str.isdigit, pair))]


def _lines(name: str) -> list[str]:
    with suppress(OSError), open(name) as file:
        return file.readlines()
    return []


def _nodes(comm: MPI.Comm) -> list[tuple[str, int, float]]:
    """Name, number of ranks and bytes of memory of the node of each rank.  Collective."""
    nodes = comm.allgather((platform.node(), largest_memory()))
    ranks = Counter(node for node, _ in nodes)
    return [(node, ranks[node], largest) for node, largest in nodes]


def room_per_rank(comm: MPI.Comm) -> float:
    """Bytes per rank on the node with the least memory per rank.  Collective."""
    return min(largest / count for _, count, largest in _nodes(comm))


def memory_per_rank(job: Job, comm: MPI.Comm, room: float = math.inf) -> float:
    """Bytes of a job on the fullest node, divided by its ranks; `room` as of `Plan.estimate`.  Collective.

    Where these are too many for a node, the reach of the contact is explored, as `pgfmd check` does.
    """
    nodes = _nodes(comm)
    fullest, least = max(count for _, count, _ in nodes), min(largest / count for _, count, largest in nodes)

    def need() -> float:  # may read the surface's table
        each = Plan(job).estimate(comm.size, room, fullest).node / fullest
        return each if each <= TOO_MUCH * least else explored(job).estimate(comm.size, room, fullest).node / fullest

    return from_root(comm, need)


def refuse_too_large(comm: MPI.Comm, per_rank: float) -> None:
    """Raise InputError on all ranks if `per_rank` bytes each exceed the whole memory of a node.  Collective."""
    for node, count, largest in _nodes(comm):
        if count * per_rank > TOO_MUCH * largest:
            raise InputError(
                f"the job takes about {readable(count * per_rank)} of memory on {node}, which has "
                f"{readable(largest)}; take more nodes, or a smaller grid"
            )


def report(comm: MPI.Comm, per_rank: float, available: float) -> None:
    """Log ranks, nodes, threads, libraries and memory; warn of too little memory or too few cores.  Collective.

    per_rank: bytes that a rank needs; available: bytes on this node before the run took any.
    """
    here = platform.node(), os.sched_getaffinity(0), threads_per_rank(), available
    ranks = comm.gather(here)
    if ranks is not None:
        log.info("pgfmd %s, commit %s", __version__, git_commit()[:12])
        log.info("MPI: %s, HDF5 %s", library(), hdf5_slabs.version())
        log.info("%s", ", ".join(versions().split("\n")))
        for level, line in describe(ranks, per_rank):
            log.log(level, "%s", line)


def describe(ranks: list[tuple[str, set[int], int, float]], per_rank: float) -> list[tuple[int, str]]:
    """The lines of the log, each with its level.

    ranks: for each its node, the cores that it may use, its threads, and the bytes available on the node.
    per_rank: bytes that each rank needs.
    """
    count_on = Counter(node for node, *_ in ranks)
    memory = {node: available for node, _, _, available in ranks}
    threads: Counter[str] = Counter()
    cores: dict[str, set[int]] = {node: set() for node in count_on}
    for node, bound, count, _ in ranks:
        threads[node] += count
        cores[node] |= bound
    spread = ", ".join(f"{node}: {count}" for node, count in list(count_on.items())[:8])
    more = f", and {len(count_on) - 8} more" if len(count_on) > 8 else ""
    counts = sorted({count for _, _, count, _ in ranks})
    some = f" (some {counts[0]})" * (len(counts) > 1)
    place = f"{counted(len(ranks), 'rank')} on {counted(len(count_on), 'node')} ({spread}{more})"
    tight = min(count_on, key=lambda node: memory[node] - count_on[node] * per_rank)
    need = count_on[tight] * per_rank
    told = f"{readable(per_rank)} per rank, {readable(need)} on {tight} of {readable(memory[tight])} available"
    lines = [
        (logging.INFO, f"{place} × {counted(counts[-1], 'thread')}{some}"),
        (logging.INFO, f"memory: about {told}"),
    ]
    if need > memory[tight]:
        lines.append((logging.WARNING, f"{tight}: the memory will not suffice; take more nodes, or a smaller grid"))
    crowded = [node for node in count_on if threads[node] > max(len(cores[node]), count_on[node])]
    if crowded:
        node = crowded[0]
        told = f"{threads[node]} threads on {counted(len(cores[node]), 'core')}"
        lines.append((logging.WARNING, f"{node}: {told}; set OMP_NUM_THREADS to cores / ranks"))
    return lines

"""How the solver scales: messages, memory and waiting of a run on many ranks, and from these a model of a big machine.

mpirun -n P python -m mpi4py tools/bench/scaling.py measure OUT.jsonl --n 1024 [--exchanged]  # seconds, messages
mpirun -n P python -m mpi4py tools/bench/scaling.py memory OUT.jsonl --n 1024 [--nodes 2]  # points and bytes held
python tools/bench/scaling.py emulate OUT.jsonl --n 4096 --ranks 512  # one rank's share of a grid
python tools/bench/scaling.py draw OUT.jsonl --output DIR  # model, CSV and picture

All but `draw` append one line to OUT.jsonl.
"""

from __future__ import annotations

import argparse
import json
import os
import threading
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scaling_emulation
import scaling_model

from pgfmd.application.estimate import BASE_BYTES, LIBRARY_BYTES, Plan
from pgfmd.application.job import parse
from pgfmd.grid import transpose
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import SubGrid
from pgfmd.grid.transpose import ExchangedStrips, Strips
from pgfmd.parallel.collectives import Reduction, node_of
from pgfmd.parallel.layout import Exchange
from pgfmd.parallel.mpi import MPI, world
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.active_set.conjugate_gradients import ConjugateGradients
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.nested_iteration import NestedIteration
from pgfmd.surfaces.self_affine import self_affine

SLOPE, PRESSURE = 0.031, 0.0036  # of the problem: H = .8, λ_s = n/64, some 8 % in contact
JOB = """grid.n = {n}
surface = {{kind = "self-affine", hurst = 0.8, lambda_s = {shortest}, rms_slope = {slope}}}
solid = {{lame_lambda = 1.0, lame_mu = 1.0}}
load.pressure = {pressure}
"""  # the same for `pgfmd check`
REPEATS = 3  # of a solve that is measured; the fastest counts, since other programs can only prolong it
SLABS = (2, 4, 8, 16, 32, 64, 128, 256, 512)  # among which contact is counted


class Clock:
    """Processor seconds and counts of a run by (level, phase).  Level 0 is the grid, 1 the next coarser one, and so on;
    a phase is what runs innermost of the methods that are watched, else "other".
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[tuple[int, str], float] = defaultdict(float)
        self.counts: defaultdict[tuple[int, str], int] = defaultdict(int)
        self.level, self.phase, self.last = 0, "other", time.process_time()

    def watch(
        self, kind: type, names: tuple[str, ...], phase: str | None, count: Callable[..., int] = lambda *_: 0
    ) -> None:
        """Those methods of a class are that phase; phase None: they are one level deeper.  count: adds to the counts of
        the phase what it says of a call's arguments, when that is over.
        """
        for name in names:
            setattr(kind, name, self._timed(getattr(kind, name), phase, count))

    def _timed(self, method: Callable, phase: str | None, count: Callable[..., int]) -> Callable:
        def timed(*arguments, **options):
            before = self._turn(), self.level, self.phase
            self.level, self.phase = (self.level + 1, "other") if phase is None else (self.level, phase)
            try:
                return method(*arguments, **options)
            finally:
                self._turn()
                if phase is not None and phase != before[2]:
                    self.counts[max(self.level, 0), phase] += count(*arguments)
                _, self.level, self.phase = before

        return timed

    def _turn(self) -> None:
        now = time.process_time()
        self.seconds[max(self.level, 0), self.phase] += now - self.last
        self.last = now

    def begin(self) -> None:
        """Start counting anew."""
        self.seconds.clear()
        self.counts.clear()
        self.level, self.last = -1, time.process_time()


def problem_of(comm, n: int, shared: bool = True):
    """The contact that is measured."""
    grid = SlabGrid(comm, (n, n), transform="blocked" if shared else "exchanged")
    heights = self_affine(grid, 0.8, n / 64, SLOPE, 1)
    return ContactProblem(grid, heights, Homogeneous(contact_modulus=2.66667), HardWall(), PRESSURE)


def measure(path: Path, n: int, exchanged: bool) -> None:
    """Seconds and messages of a solve by level and phase.  Collective."""
    comm, shared = world(), not exchanged
    solve_hard_wall(problem_of(comm, max(512, comm.size), shared))  # so that nothing is compiled or loaded later
    problem, clock = problem_of(comm, n, shared), Clock()
    grid = problem.grid
    costs = {f"cost of {name}": value for name, value in _costs(grid).items()}
    several = lambda part, *_: part.comm.size > 1  # noqa: E731
    clock.watch(NestedIteration, ("solve",), None)
    clock.watch(ConjugateGradients, ("__init__", "solve"), "contact")
    clock.watch(SlabGrid, ("convolve", "read_spectrum", "make_field"), "transforms")
    clock.watch(Reduction, ("sum", "sums", "max", "min", "dot", "any"), "reductions", several)
    clock.watch(Exchange, ("start",), "halos", lambda exchange: bool(exchange.requests))
    clock.watch(Exchange, ("finish",), "halos")
    clock.watch(Strips, ("meet", "begin"), "all-to-alls")
    clock.watch(ExchangedStrips, ("_exchange",), "all-to-alls", lambda strips, *_: len(strips.node_starts) > 2)
    sent = Clock()  # of bytes
    sent.watch(
        ExchangedStrips, ("_exchange",), "all-to-alls",
        lambda strips, dtype, back: int(strips._layout(dtype.itemsize)[back][0].sum() * strips._blocks[dtype.itemsize])
        * dtype.itemsize,
    )  # fmt: skip
    fastest: dict[str, float] = {"solve": np.inf}
    for _ in range(REPEATS):
        comm.Barrier()
        clock.begin()
        sent.begin()
        began = time.perf_counter()
        solution = solve_hard_wall(problem)
        took = comm.allreduce(time.perf_counter() - began, MPI.MAX)  # so that all take the same solve
        if took < fastest["solve"]:
            fastest = {"solve": took, "bytes": sum(sent.counts.values())}
            for what, each in (("seconds", clock.seconds), ("count", clock.counts)):
                fastest |= {f"{what} {level} {phase}": value for (level, phase), value in each.items()}
    found = {
        "n": n, "ranks": comm.size, "exchanged": exchanged, "threads": grid.threads.count,
        "cores": len(os.sched_getaffinity(0)),
        "transforms": solution.transforms, "iterations": solution.iterations,
        "computed": sum(value for name, value in fastest.items() if name.split()[-1] in scaling_model.COMPUTED),
    } | costs | fastest  # fmt: skip
    _append(comm, path, found)
    mask = comm.gather((solution.pressure > 0).sum(axis=1))
    if comm.rank == 0:
        points = np.concatenate(mask)
        worst = {slabs: _imbalance(points, slabs) for slabs in SLABS if slabs <= n // 4}
        with open(path, "a") as file:
            file.write(json.dumps({"imbalance": n, "area": points.sum() / grid.size} | worst) + "\n")


def _imbalance(points: np.ndarray, slabs: int) -> float:
    """Contact points of the fullest slab of rows over those of the mean one; points: in each row."""
    return float(np.add.reduceat(points, np.arange(slabs) * len(points) // slabs).max() * slabs / points.sum())


def _costs(grid) -> dict[str, float]:
    """Seconds of a reduction, and of an exchange of a row with neighbours, on this machine: the median of some."""
    row = np.zeros((grid.local_shape[0], 16), np.float32)
    works = {"reductions": lambda: grid.reduction.sums(1.0, 2.0), "halos": lambda: grid.neighbours([row])}
    found = {}
    for name, work in works.items():
        times = []
        for _ in range(200 if grid.comm.size > 1 else 1):
            began = time.perf_counter()
            work()
            times.append(time.perf_counter() - began)
        found[name] = float(np.median(times)) if grid.comm.size > 1 else 0.0
    return found


def memory(path: Path, n: int, nodes: int) -> None:
    """Points of all grids over all ranks, the largest array of a rank, and what a rank and a node need at the peak of
    a solve beside what idle ones do, over what `pgfmd check` says.  Collective.

    nodes: so many are emulated; strips are shared only within each.  A rank's resident memory contains all pages of
    its node's strips that it has seen, so that several ranks count them; that of the node counts them once.
    """
    comm = world()
    here = -(-comm.size // nodes)
    node = comm.Split(comm.rank // here)
    if nodes > 1:
        transpose.node_of = lambda part: node if part.size == comm.size else node_of(part)
    solve_hard_wall(problem_of(comm, 512))
    idle, idle_share = _status("VmRSS"), _status("Pss", "smaps_rollup")
    problem = problem_of(comm, n)
    with _Highest(lambda: _status("Pss", "smaps_rollup")) as highest:
        solve_hard_wall(problem)
    share, of_node = n * n / comm.size, node.allreduce(highest.value - idle_share)
    job = parse(JOB.format(n=n, shortest=n / 64, slope=SLOPE, pressure=PRESSURE))
    said = Plan(job).estimate(comm.size, per_node=here)
    empty = LIBRARY_BYTES + here * (BASE_BYTES - LIBRARY_BYTES)
    found = {
        "memory": n, "ranks": comm.size, "nodes": nodes,
        "bytes per point of the share": (_status("VmHWM") - idle) / share,
        "by check": (said.memory - BASE_BYTES) / share,
        "bytes per point of a node": of_node / (share * here),
        "of a node by check": (said.node - empty) / (share * here),
        "allowed array": 1.5 * 8 * share + 2**22,
    }  # fmt: skip

    make, coarser = SubGrid.__init__, NestedIteration.coarser
    held: defaultdict[str, int] = defaultdict(int)

    def made(place, *arguments, **options):
        make(place, *arguments, **options)
        held["points of meshes and blocks"] += int(np.prod(place.local_shape))

    def coarse(nested, problem):
        coarse = coarser(nested, problem)
        points = int(np.prod(coarse.place.local_shape)) if coarse else 0
        held["points of levels"] += points
        held["points of meshes and blocks"] -= points
        return coarse

    def look(*_):
        arrays = tracemalloc.take_snapshot().filter_traces([tracemalloc.DomainFilter(True, 389047)])  # NumPy's
        found["largest array"] = max(found.get("largest array", 0), *(trace.size for trace in arrays.traces))

    SubGrid.__init__, NestedIteration.coarser = made, coarse
    held["points of levels"] = int(np.prod(problem.grid.local_shape))
    tracemalloc.start(1)
    solve_hard_wall(problem, monitor=look)
    _append(comm, path, found | {name: comm.allreduce(value) / n**2 for name, value in held.items()})


def _status(name: str, file: str = "status") -> int:
    """Bytes, from /proc/self."""
    lines = Path("/proc/self", file).read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


class _Highest(threading.Thread):
    """A context manager: the highest `value` of what `look()` returns, twenty times a second."""

    def __init__(self, look: Callable[[], int]) -> None:
        super().__init__(daemon=True)
        self.look, self.value, self.over = look, look(), threading.Event()

    def run(self) -> None:
        while not self.over.wait(0.05):
            self.value = max(self.value, self.look())

    def __enter__(self) -> _Highest:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.join()


def _append(comm, path: Path, found: dict) -> None:
    """Adds a line, of each number the largest over the ranks.  Collective."""
    every = comm.gather(found)
    if comm.rank == 0:
        worst = {name: max(each.get(name, 0) for each in every) for each in every for name in each}
        with open(path, "a") as file:
            file.write(json.dumps(worst) + "\n")
        print(json.dumps(worst, indent=1))


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("measure", "memory", "emulate", "draw"):
        command = commands.add_parser(name)
        command.add_argument("file", type=Path)
        if name == "draw":
            command.add_argument("--output", type=Path, required=True)
        else:
            command.add_argument("--n", type=int, required=True, help="points per side")
        if name == "emulate":
            command.add_argument("--ranks", type=int, required=True)
        if name == "memory":
            command.add_argument("--nodes", type=int, default=1, help="emulated: ranks share strips within each only")
        if name == "measure":
            command.add_argument("--exchanged", action="store_true", help="strips cross in messages, as between nodes")
    options = parser.parse_args(arguments)
    if options.command == "measure":
        measure(options.file, options.n, options.exchanged)
    elif options.command == "memory":
        memory(options.file, options.n, options.nodes)
    elif options.command == "emulate":
        found = scaling_emulation.emulate(options.n, options.ranks)
        with open(options.file, "a") as file:
            file.write(json.dumps(found) + "\n")
        print(json.dumps(found, indent=1))
    else:
        scaling_model.draw([json.loads(line) for line in options.file.read_text().splitlines()], options.output)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

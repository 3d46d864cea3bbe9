"""How the solver scales: measured parts of a run, and from them a model of a big machine.

mpirun -n P python -m mpi4py tools/scaling.py measure OUT.jsonl --n 1024 [--exchanged]      # appends one line
python tools/scaling.py draw OUT.jsonl --output DIR                                         # CSV and pictures
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import time
from pathlib import Path

import numpy as np

from pgfmd.grid.holders import largest_shares

# The machine of the model, assumed: LUMI-C (two 64-core AMD EPYC 7763 per node, one 200 Gb/s HPE Slingshot-11 port).
# Half of the port's bandwidth is what an all-to-all of all nodes gets; a message between two nodes takes 2 µs.
NETWORK = {"name": "LUMI-C, Slingshot-11", "cores": 128, "bandwidth": 0.5 * 25e9, "latency": 2e-6}
MODEL_RANKS = [64, 128, 256, 512, 1024, 2048, 4096]
MODEL_SIZES = [4096, 16384, 65536]
PHASES = ("transforms", "vectors", "coarse grids", "all-to-all", "latency")


def measure(path: Path, n: int, exchanged: bool) -> None:
    """Time the parts of a transform and a solve on all ranks, and append them to `path` as one line.  Collective."""
    from mpi4py import MPI

    from pgfmd.grid.slab_grid import SlabGrid
    from pgfmd.grid.transpose import ExchangedStrips
    from pgfmd.parallel.collectives import Reduction
    from pgfmd.parallel.layout import RowPlan
    from pgfmd.physics.elasticity import Elasticity
    from pgfmd.physics.laws.hard import HardWall
    from pgfmd.physics.problem import ContactProblem
    from pgfmd.solvers.active_set.nested_iteration import solve_hard_wall
    from pgfmd.surfaces.self_affine import self_affine

    comm, solid = MPI.COMM_WORLD, Elasticity(2.66667)
    grid = SlabGrid(comm, (n, n), shared=not exchanged)
    found = {"n": n, "ranks": comm.size, "exchanged": exchanged, "threads": grid.threads.count}
    for kind in (np.float32, np.float64):
        found |= {f"{name} {np.dtype(kind).name}": value for name, value in _transform_parts(grid, kind).items()}
    small = SlabGrid(comm, (64 * comm.size, 64), shared=grid._shared)  # so that nothing is compiled or loaded later
    solve_hard_wall(ContactProblem(small, self_affine(small, 0.8, 8.0, 0.031, 1), solid, HardWall(), 0.0036))
    heights = self_affine(grid, 0.8, n / 64, 0.031, 1)
    reductions = _Counter(Reduction, ("sum", "sums", "max", "min", "dot", "any"))
    halos = _Counter(RowPlan, ("start", "start_back"))
    exchanges = _Counter(ExchangedStrips, ("_alltoall",))
    fine = grid.transforms
    began = time.perf_counter()
    steps = []
    problem = ContactProblem(grid, heights, solid, HardWall(), 0.0036)
    solution = solve_hard_wall(problem, 1e-6, monitor=lambda level, state: steps.append(level))
    found |= {
        "solve": time.perf_counter() - began, "transforms": solution.transforms,
        "fine transforms": grid.transforms - fine, "steps": sum(level is grid for level in steps),
        "reductions": reductions.count, "reducing": reductions.seconds, "halos": halos.count,
        "in halos": halos.seconds, "all-to-alls": exchanges.count, "bytes per solve": exchanges.sent,
        "area": grid.reduction.sum(solution.pressure > 0) / grid.size,
    }  # fmt: skip
    slowest = {name: comm.allreduce(value, MPI.MAX) for name, value in found.items()}
    if comm.rank == 0:
        with open(path, "a") as file:
            file.write(json.dumps(slowest) + "\n")


def _transform_parts(grid, kind, repeats: int = 5) -> dict[str, float]:
    """Seconds of each part of one forward and backward transform, best of some; bytes that this rank sends."""
    transform, comm = grid.transform(kind), grid.comm
    field = np.ones(grid.local_shape, kind)
    parts = {
        "rows": lambda: transform.threads.share(forward, transform.strips.rows, transform.row_block),
        "exchange": lambda: transform.strips.to_columns(transform.complex),
        "columns": lambda: transform.columns(lambda block, first, stop: None),
        "exchange back": lambda: transform.strips.to_rows(transform.complex),
        "rows back": lambda: transform.threads.share(backward, transform.strips.rows, transform.row_block),
    }

    def forward(thread: int, first: int, stop: int):
        worker = transform.workers[thread]
        worker.rows[: stop - first] = field[first:stop]
        worker.rows_forward()
        transform.strips.put(transform.parts, first, worker.padded_half[: stop - first])

    def backward(thread: int, first: int, stop: int):
        worker = transform.workers[thread]
        transform.strips.get(transform.parts, first, worker.padded_half[: stop - first])
        worker.rows_backward()
        field[first:stop] = worker.rows[: stop - first]

    best = dict.fromkeys(parts, math.inf)
    for _ in range(repeats):
        transform.strips.begin()
        for name, part in parts.items():
            comm.Barrier()
            began = time.perf_counter()
            part()
            best[name] = min(best[name], time.perf_counter() - began)
        field /= grid.size
    width = np.dtype(kind).itemsize * 2 * (grid.shape[1] // 2 + 1)
    return best | {"bytes": 2 * grid.local_shape[0] * width * (comm.size - 1) / comm.size}


class _Counter:
    """Counts and times calls of methods that communicate with other ranks, those inside others only once.

    sent: bytes that all-to-alls sent to other ranks.
    """

    def __init__(self, kind, names):
        self.count, self.seconds, self.sent, self.inside = 0, 0.0, 0, False
        for name in names:
            setattr(kind, name, self.wrap(getattr(kind, name)))

    def wrap(self, method):
        def counted(*arguments, **options):
            alone = getattr(arguments[0], "peers", arguments[0].comm).size == 1
            if self.inside or alone or not getattr(arguments[0], "partners", True):
                return method(*arguments, **options)
            if method.__name__ == "_alltoall":
                _, (counts, _), _, kind = arguments
                self.sent += int(counts.sum()) * kind.itemsize
            self.inside, began = True, time.perf_counter()
            try:
                return method(*arguments, **options)
            finally:
                self.inside = False
                self.count += 1
                self.seconds += time.perf_counter() - began

        return counted


def constants(rows: list[dict]) -> dict[str, float]:
    """What the model needs, from the largest grid on one rank and one thread (seconds per point, counts per solve)."""
    one = [row for row in rows if row["ranks"] == 1 and row["threads"] == 1]
    if not one:
        raise SystemExit("scaling: needs a run on one rank with one thread, which times a point")
    big = max(one, key=lambda row: row["n"])
    points = big["n"] ** 2
    pair = sum(big[f"{part} float64"] for part in ("rows", "columns", "rows back"))
    sent = [row for row in rows if row["exchanged"] and row["ranks"] > 1]
    if not sent:
        raise SystemExit("scaling: needs a run with --exchanged on several ranks, in which messages are counted")
    most = max(sent, key=lambda row: (row["n"], row["ranks"]))
    off = most["ranks"] / (most["ranks"] - 1)  # bytes if all went to other ranks, over those that did
    return {
        "n": big["n"],
        "transform": pair / points,
        "transforms": max(row["fine transforms"] for row in one),
        "other": max(0.0, big["solve"] - big["transforms"] * pair) / points,
        "reductions": most["reductions"],
        "halos": most["halos"],
        "all-to-alls": most["all-to-alls"],
        "bytes": off * most["bytes per solve"] * most["ranks"] / most["n"] ** 2,
    }


def model(n: int, ranks: int, known: dict[str, float], network: dict = NETWORK) -> dict:
    """Seconds of the phases of one solve (certified error 1e-6) of n × n points on `ranks` cores.

    Measured here: seconds per point of transforms and of all else on one core; bytes, all-to-alls, reductions and halos
    of a whole solve, counted.  Assumed: the network; that contact is spread evenly; that coarser grids are
    solved in half the transforms, one after the other on as many ranks as `holders` says, of which rank 0 has most.
    All-to-alls send one message to each other node and share its port; reductions take 2 log₂ P messages, halos two.
    """
    phases = dict.fromkeys(PHASES, 0.0)
    for level, share in enumerate(largest_shares((n, n), ranks)):
        part = 1.0 if level == 0 else 0.5
        transforms = part * known["transforms"] * known["transform"] * share
        vectors = part * known["other"] * share
        phases["coarse grids" if level else "transforms"] += transforms
        phases["coarse grids" if level else "vectors"] += vectors
    on_node = min(ranks, network["cores"])
    nodes = -(-ranks // network["cores"])
    port = network["bandwidth"] / on_node
    phases["all-to-all"] = known["bytes"] * n * n / ranks * (1 - on_node / ranks) / port
    steps = 2 * math.log2(ranks) if ranks > 1 else 0
    messages = known["all-to-alls"] * (nodes - 1) + known["reductions"] * steps + 2 * known["halos"]
    phases["latency"] = network["latency"] * messages
    return phases


def draw(rows: list[dict], folder: Path) -> None:
    """Measured scaling and the model, as pictures and CSV files."""
    from plotting import COLOURS, plt

    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / "scaling-measured.csv", rows)
    known = constants(rows)
    table = [
        {"n": n, "ranks": ranks} | model(n, ranks, known) for n in MODEL_SIZES for ranks in MODEL_RANKS
    ]
    for row in table:
        row["total"] = sum(row[name] for name in PHASES)
    _write(folder / "scaling-model.csv", table)
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.7))
    for colour, n in zip(COLOURS, sorted({row["n"] for row in rows}), strict=False):
        for exchanged, style in ((False, "-"), (True, "--")):
            mine = sorted(
                (row["ranks"], row["solve"]) for row in rows if row["n"] == n and row["exchanged"] == exchanged
            )
            if mine:
                label = f"{n}²" + ", messages" * exchanged
                axes[0].loglog(*zip(*mine, strict=True), style, marker="o", color=colour, label=label)
    axes[0].set(xlabel="ranks", ylabel="seconds per solve", title="measured here")
    for axis, n in zip(axes[1:], MODEL_SIZES[1:], strict=True):
        mine = [row for row in table if row["n"] == n]
        for colour, name in zip(COLOURS, PHASES, strict=False):
            axis.loglog(MODEL_RANKS, [max(row[name], 1e-4) for row in mine], color=colour, label=name)
        axis.loglog(MODEL_RANKS, [row["total"] for row in mine], "k", lw=2, label="total")
        axis.set(xlabel="ranks", ylabel="seconds per solve", title=f"model, {n}²")
        axis.set_ylim(1e-2)
    axes[0].set_xticks(counts := sorted({row["ranks"] for row in rows}), counts, minor=False)
    axes[0].set_xticks([], minor=True)
    axes[0].legend()
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower right", ncols=6)
    for kind in ("png", "pdf"):
        figure.savefig(folder / f"scaling.{kind}")
    print(_verdict(table, known))


def _verdict(table: list[dict], known: dict) -> str:
    """Which phase limits, for each size, in words."""
    lines = [
        f"model of {NETWORK['name']}: one rank per core, from {known['n']}² on one core here: "
        f"{known['transform'] * 1e9:.1f} ns per point and transform pair, {known['transforms']:.0f} of them, "
        f"{known['other'] * 1e9:.0f} ns per point for all else, {known['reductions']:.0f} reductions"
    ]
    for row in table:
        phases = {name: row[name] for name in PHASES}
        worst = max(phases, key=phases.get)
        lines.append(
            f"{row['n']:6}²  {row['ranks']:5} ranks: {row['total']:9.3g} s; "
            f"{worst} takes {phases[worst] / row['total']:.0%}"
        )
    return "\n".join(lines)


def _write(path: Path, rows: list[dict]) -> None:
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("measure", help="time one grid on the ranks of this mpirun; append a line")
    one.add_argument("file", type=Path)
    one.add_argument("--n", type=int, required=True, help="points per side")
    one.add_argument("--exchanged", action="store_true", help="strips cross in messages, as between nodes")
    two = commands.add_parser("draw", help="pictures and CSV of what was measured, and the model")
    two.add_argument("file", type=Path)
    two.add_argument("--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    if options.command == "measure":
        measure(options.file, options.n, options.exchanged)
    else:
        draw([json.loads(line) for line in options.file.read_text().splitlines()], options.output)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

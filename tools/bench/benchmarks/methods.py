"""How each solver is run: all with the same heights (peaks positive), contact modulus and mean pressure, from nothing.

A method is a function (case, heights, mean_pressure, recorder, tolerance, threads, **setting) that starts the recorder,
sets up, solves and notes: once at the end (`LADDERS`, run once per tolerance), or once per iteration of one long run
(`STEPS`).  Peers are imported inside, so that each is optional.
"""

import contextlib
from functools import partial

import numpy as np
import peers

from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import ALONE, world
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.gfmd import solve_gfmd
from pgfmd.solvers.solution import pressure_in_place

from .case import CONTACT_MODULUS, Case, hard_contact
from .polonsky_keer import polonsky_keer
from .recorder import EnoughError, Recorder


def pgfmd(case: Case, heights, mean_pressure, recorder: Recorder, tolerance: float, threads: int) -> None:
    """This project's solver; complete runs.  Collective."""
    recorder.start()
    grid = SlabGrid(world(), (case.n, case.n), threads=threads)
    solution = solve_hard_wall(hard_contact(grid, heights, mean_pressure), tolerance)
    recorder.note(solution.pressure, solution.transforms)
    recorder.add_tail()
    grid.free()


def pgfmd_steps(case: Case, heights, mean_pressure, recorder: Recorder, tolerance: float, threads: int) -> None:
    """The same, watched after each outer step on the finest grid.  Collective."""
    coarser = {}

    def monitor(level, state):
        if level is not grid:
            coarser[level.shape] = level.transforms * level.size / grid.size
            return
        pressure = pressure_in_place(grid, state)
        scale = mean_pressure * grid.size / grid.comm.allreduce(float(pressure.sum()))
        recorder.note(pressure, grid.transforms + sum(coarser.values()), scale)

    recorder.start()
    grid = SlabGrid(world(), (case.n, case.n), threads=threads)
    solve_hard_wall(hard_contact(grid, heights, mean_pressure), tolerance, monitor=monitor)
    recorder.add_tail()
    grid.free()


def plain_polonsky_keer(case: Case, heights, mean_pressure, recorder: Recorder, tolerance: float, threads: int) -> None:
    """Polonsky–Keer on this project's transforms, one rank."""
    recorder.start()
    grid = SlabGrid(ALONE, (case.n, case.n), threads=threads)
    with contextlib.suppress(EnoughError):
        polonsky_keer(hard_contact(grid, heights, mean_pressure), partial(recorder.note, may_stop=True))


def gfmd(case: Case, heights, mean_pressure, recorder: Recorder, tolerance: float, threads: int) -> None:
    """Green's function molecular dynamics with a hard wall, noted where it checks its own error; one rank."""
    def watch(_, state):
        recorder.note(state.pressure, grid.transforms, mean_pressure / state.pressure.mean(), may_stop=True)

    recorder.start()
    grid = SlabGrid(ALONE, (case.n, case.n), threads=threads)
    problem = hard_contact(grid, heights, mean_pressure)
    with contextlib.suppress(EnoughError, SolverError):
        solve_gfmd(problem, tolerance=tolerance, max_steps=100_000, monitor=watch)


def aspher(
    case: Case, heights, mean_pressure, recorder: Recorder, tolerance: float, threads: int,
    precision: str = "double", engine: str = "auto",
) -> None:  # fmt: skip
    """ASPHER's nested solver with its periodic operator; OMP_NUM_THREADS is its number of threads."""
    import aspher as peer

    gap = -heights.ravel()
    recorder.start()
    result = peer.solve_nested(
        case.n, gap, mean_pressure, domain_size=float(case.n), E_star=CONTACT_MODULUS, backend="periodic",
        coarsest=min(64, case.n // 2), coarse_tol=1e-4, precision=precision, precond_engine=engine, tol=tolerance,
        light_result=True,
    )  # fmt: skip
    recorder.note(np.asarray(result.pressure).reshape(case.n, case.n), _aspher_transforms(case, result, engine))
    recorder.add_tail()
    if result.status == "stagnated":
        recorder.truncated = True


def _aspher_transforms(case: Case, result, engine: str) -> float:
    """Its kernel applications, and one more per iteration where its preconditioner transforms the full grid."""
    spectral = engine == "fft" or (engine == "auto" and np.mean(np.asarray(result.pressure) > 0) >= 0.4)
    total = 0.0
    for stage in result.stage_stats:
        name, _, rest = stage["name"].partition(":")
        side = int(rest) if rest.isdigit() else case.n
        weight = (side / case.n) ** 2 * (0.5 if stage["precision"] == "float" else 1.0)
        total += weight * (stage["matvec_count"] + (stage["iterations"] if spectral else 0))
    return total


def watched(peer, case: Case, heights, mean_pressure, recorder: Recorder, tolerance: float, threads: int) -> None:
    """A program of `peers`, noted after each iteration of two transform pairs; OMP_NUM_THREADS counts its threads."""
    def watch(field, count, scale):
        recorder.note(field, 2 * count, scale, may_stop=True)

    recorder.start()
    peer(heights, mean_pressure, tolerance, peers.Square(case.n, CONTACT_MODULUS), watch)


LADDERS = {"pgfmd": pgfmd, "ASPHER": aspher}
STEPS = {
    "pgfmd steps": pgfmd_steps,
    "Polonsky-Keer": plain_polonsky_keer,
    "GFMD": gfmd,
    "tamaas": partial(watched, peers.tamaas),
    "ContactMechanics": partial(watched, peers.contact_mechanics),
}
METHODS = LADDERS | STEPS
PEERS = {"ASPHER": "aspher", "tamaas": "tamaas", "ContactMechanics": "ContactMechanics"}  # and their modules

"""A job of an ensemble: one run for each seed, distributed over the ranks."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from pgfmd.application import ensemble, files, machine, restart
from pgfmd.application.estimate import Plan
from pgfmd.application.job import Job, as_toml, differences, parse
from pgfmd.application.progress import STEP
from pgfmd.application.results import Results
from pgfmd.application.stop import Interruptions
from pgfmd.errors import InputError, NoProgress, SolverError, Stopped
from pgfmd.options.text import printable, reason
from pgfmd.parallel.collectives import from_root, raise_together, shared
from pgfmd.parallel.mpi import MPI, library

log = logging.getLogger("pgfmd")
progress = logging.getLogger("pgfmd.ensemble")  # with a level of its own: the first rank of each group logs its seeds

Simulate = Callable[..., None]
"""simulate(job, comm, directory, overwrite=…, restart=…, interruptions=…): runs one surface.  Collective."""
Failures = dict[int, Exception]
"""What went wrong, by seed."""


def run_ensemble(simulate: Simulate, job: Job, comm: MPI.Comm, path: Path, mode: str) -> None:
    """Run every seed of a job into a result folder of its own; groups of ranks take the seeds in turn.  Collective.

    mode: as for `ResultWriter`.  A seed that fails does not stop the others.  Raises Stopped or NoProgress; at the end
    SolverError if some seeds failed, or the first error if all did.
    """
    seeds = job.surface.seeds
    room = machine.room_per_rank(comm)
    groups = from_root(comm, Plan(job).rank_groups, comm.size, room)  # may read the surface's table
    memory = machine.memory_per_rank(job, comm, room)
    machine.refuse_too_large(comm, memory)
    before: bytes | None = None  # ensemble.h5 as it was; rank 0
    with ExitStack() as held:
        with raise_together(comm):
            if comm.rank == 0:
                held.callback(files.OutputFolder(path).release)
                before = _refuse_others(job, path, mode)
        origin = machine.Origin(job.text, as_toml(job), len(job.load.targets))
        about: dict[str, Any] = from_root(comm, machine.gather, comm.size, {"MPI": library()}, origin)
        about |= {"seeds": np.array(seeds)}
        from_root(comm, ensemble.write, path, about, {}, "running")
        machine.report(comm, memory, machine.available_memory())
        if comm.rank == 0:
            log.info("%d seeds, %d at a time", len(seeds), groups)
        failed, stopped = _run_seeds(simulate, job, comm, path, groups, mode)
        if len(failed) == len(seeds) and all(isinstance(error, InputError) for error in failed.values()):
            there = path / files.ENSEMBLE_FILE  # is restored: no seed has written anything
            from_root(comm, lambda: there.unlink() if before is None else files.replace(there, before))
        else:
            reasons = {seed: printable(reason(error), 400) for seed, error in failed.items()}
            status = "stopped" if stopped else "failed" if failed else "complete"
            from_root(comm, ensemble.write, path, about, reasons, status)
    if stopped:
        raise stopped
    if len(failed) == len(seeds):
        raise next(iter(failed.values()))
    if failed:
        why = "; ".join(f"seed {seed}: {reason(error)}" for seed, error in failed.items())
        raise SolverError(f"{len(failed)} of {len(seeds)} seeds failed, the others are written: {why}")


def _refuse_others(job: Job, path: Path, mode: str) -> bytes | None:
    """The bytes of ensemble.h5, None without one.  Raises InputError if the folder holds one surface, or an ensemble
    that `mode` does not allow to change.  Rank 0.
    """
    if (path / files.OBSERVABLES_FILE).exists():
        raise InputError(f"{path}: holds the results of one surface; choose another folder for an ensemble")
    if not (path / files.ENSEMBLE_FILE).exists():
        return None
    if mode == "new":
        raise InputError(f"{path}: holds an ensemble already ({files.ENSEMBLE_FILE}); replace it with --overwrite, "
                         "continue it with --restart, or choose another folder")  # fmt: skip
    if mode == "restart":
        before = parse(ensemble.Ensemble(path).provenance["effective_toml"], "results")
        changed = [text for text in differences(before, job) if not text.startswith("surface.seed:")]
        if changed:
            raise InputError(f"{path}: cannot be continued, the job differs: {'; '.join(changed)}")
    return (path / files.ENSEMBLE_FILE).read_bytes()


def _run_seeds(
    simulate: Simulate, job: Job, comm: MPI.Comm, path: Path, groups: int, mode: str
) -> tuple[Failures, Stopped | NoProgress | None]:
    """Run the seeds, in groups of ranks; returns which failed, and why the run was stopped, if it was.  Collective."""
    failed: Failures = {}
    seeds = job.surface.seeds
    stopped: Stopped | NoProgress | None = None
    own = comm.rank * groups // comm.size  # the number of this rank's group
    group = comm if groups == 1 else comm.Split(own, comm.rank)
    with (
        _quiet(group),
        Interruptions(group, path, job.run.checkpoint_interval, job.run.time_limit) as interruptions,
    ):
        comm.Barrier()  # a stop file that appears from here on is for this run
        for position in range(own, len(seeds), groups):
            seed, began = seeds[position], time.perf_counter()
            try:
                interruptions.between_steps()
                member, folder = job.of_seed(seed), path / files.member_name(seed)
                there = from_root(group, _found, folder, member) if mode == "restart" else ""
                if there == "complete":
                    continue
                anew = mode == "overwrite" or there == "stale"
                goes_on = mode == "restart" and not anew
                simulate(member, group, folder, overwrite=anew, restart=goes_on, interruptions=interruptions)
                progress.info("seed %d (%d of %d)  %.2f s", seed, position + 1, len(seeds),
                              time.perf_counter() - began)  # fmt: skip
            except (Stopped, NoProgress) as interruption:
                stopped = interruption
                if group.rank == 0:
                    with suppress(OSError):
                        interruptions.batch_stop_file.touch()  # for the other groups, which may have got no signal
                break
            except (InputError, SolverError, OSError, MemoryError) as error:
                if not shared(group, error):
                    raise  # the other ranks of the group are blocked: only an abort ends them
                error.__context__ = error.__cause__ = None
                failed[seed] = error.with_traceback(None)  # a traceback would keep the arrays of its frames
                progress.warning("seed %d (%d of %d) failed: %s", seed, position + 1, len(seeds),
                                 reason(error))  # fmt: skip
    outcomes = comm.allgather((failed, stopped))
    if comm.rank == 0:
        interruptions.batch_stop_file.unlink(missing_ok=True)
    if groups > 1:
        group.Free()
    everywhere = {seed: error for each, _ in outcomes for seed, error in each.items()}
    return dict(sorted(everywhere.items())), next((each for _, each in outcomes if each), None)


def _found(folder: Path, job: Job) -> str:
    """What a folder holds: "complete", all that the job asks for, undamaged and by this version; "stale", results of
    another job, left by an interrupted `--overwrite`; "", anything else, on which `simulate` decides.
    """
    with suppress(InputError):
        results = Results(folder)
        if differences(parse(results.provenance["effective_toml"], "results"), job):
            return "stale"
        if results.status != "complete" or job.sources:  # files may have changed since
            return ""
        earlier, loads = restart.read(folder), map(files.load_name, range(len(job.load.targets)))
        needed = {"height", *loads} if "height" in job.output.fields else set(loads)
        whole = needed - {"height"} <= earlier.fields.keys() and not needed & earlier.damaged
        return "complete" if whole else ""
    return ""


@contextmanager
def _quiet(group: MPI.Comm) -> Iterator[None]:
    """Within the block the terminal shows warnings, and one line for each seed; a run's log file gets every line."""
    handlers, before = list(log.handlers), log.level
    for handler in handlers:
        handler.addFilter(_is_shown)
    progress.setLevel(logging.INFO if group.rank == 0 else logging.CRITICAL + 1)
    filtered = handlers and not log.propagate  # no filter reaches handlers of the root logger
    log.setLevel(STEP if filtered and group.rank == 0 else max(before, logging.WARNING))
    try:
        yield
    finally:
        log.setLevel(before)
        for handler in handlers:
            handler.removeFilter(_is_shown)


def _is_shown(record: logging.LogRecord) -> bool:
    return record.name == progress.name or record.levelno >= logging.WARNING

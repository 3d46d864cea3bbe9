"""One job, run by `pgfmd.solve`, by `simulate` or by the command line, and its verdict."""

import math
import re
import subprocess
import sys
import tomllib
import traceback
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import reference

import pgfmd
from campaigns.comparing import compare
from campaigns.judging import IMPOSED, Answer, control_of, judge
from campaigns.random_case import BAD, REFUSED, RIGHT, TRACEBACK, UNCERTIFIED, UNJUDGED, WRONG, Case, toml
from pgfmd.application import job as jobs
from pgfmd.application.simulate import run_job
from pgfmd.errors import InputError, SolverError
from pgfmd.parallel.collectives import slab

HANG = 120.0  # seconds of processor time that a job of at most 24² points may take


def run(case: Case, folder: Path, comm=None) -> tuple[str, str]:
    """(verdict, what is wrong or was refused) of a job, run in `folder`.  Collective over comm."""
    return answered(case, folder, comm)[:2]


def run_beside_one(case: Case, folder: Path, comm) -> tuple[str, str]:
    """The same, on the ranks of comm and on one, whose answers are to agree.  Collective."""
    many = answered(case, folder / "many", comm)
    bad = next((each[:2] for each in comm.allgather(many) if each[0] in BAD), None)
    if bad is not None or comm.rank:
        return bad or many[:2]
    one = answered(case, folder / "one", None)
    if one[0] in BAD:
        return one[:2]
    wrong = compare(one, many, case.document.get("wall"))
    return (WRONG, f"on {comm.size} ranks: {wrong}") if wrong else many[:2]


def answered(case: Case, folder: Path, comm=None) -> tuple[str, str, list[Answer]]:
    """(verdict, what is wrong or was refused, answers on rank 0); fields in single precision on one rank: those of the
    same job in double, rounded.  Collective over comm.
    """
    found, output = _answered(case, folder, comm), case.document.get("output")
    if found[0] != UNJUDGED or output.get("precision") != "float32" or comm is not None and comm.size > 1:
        return found
    document = case.document | {"output": output | {"precision": "float64"}}
    double = _answered(replace(case, document=document), folder / "double", comm)
    if double[0] != RIGHT:
        return double
    for one, two in zip(found[2], double[2], strict=True):
        for name in ("pressure", "gap"):
            if not np.allclose(getattr(one, name), getattr(two, name), rtol=6e-8, atol=1e-44):
                return WRONG, f"{name} in single precision is another one", found[2]
    return double


def _answered(case: Case, folder: Path, comm=None) -> tuple[str, str, list[Answer]]:
    """The same, of the job as it is."""
    from mpi4py import MPI

    comm = MPI.COMM_SELF if comm is None else comm
    if comm.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        if case.heights is not None:
            np.save(folder / "heights.npy", case.heights)
        if case.factor is not None:
            np.save(folder / "factor.npy", case.factor)
        (folder / "job.toml").write_text(toml(case.document), encoding="utf-8")
    comm.Barrier()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            job, heights, answers = WAYS[case.way](case, folder, comm)
    except InputError as error:
        return (*_line(str(error), REFUSED), [])
    except SolverError as error:
        return (*_line(str(error), UNCERTIFIED), [])
    except Exception:
        return TRACEBACK, traceback.format_exc(), []
    leaks = [f"{warning.message} ({Path(warning.filename).name}:{warning.lineno})" for warning in caught]
    if leaks:
        return WRONG, f"warning: {leaks[0]}", []
    if comm.rank:
        return RIGHT, "", []
    try:
        with np.errstate(all="ignore"):
            return (*judge(job, heights, answers, case.factor), answers)
    except reference.Unable as error:
        return UNJUDGED, str(error), answers


def _line(message: str, verdict: str) -> tuple[str, str]:
    """A refusal, if it is one line that can be printed."""
    good = message.isprintable() and 0 < len(message) < 1200
    return (verdict, message) if good else (WRONG, f"message that is not one line: {message!r}")


def _by_solve(case: Case, folder: Path, comm):
    """By `pgfmd.solve`."""
    document = case.document
    solid, wall, solver = document["solid"], document.get("wall", {}), document.get("solver", {})
    shape = case.heights.shape
    spacing = document["grid"].get("spacing") or [
        length / n for length, n in zip(document["grid"]["length"], shape, strict=True)
    ]
    options = {key: solid[key] for key in ("contact_modulus", "thickness", "base", "poisson") if key in solid}
    options |= {key: solver[key] for key in ("tolerance", "method") if key in solver}
    if wall.get("kind") in ("hardness", "formula"):
        options["wall"] = wall
    if wall.get("kind") == "exponential":
        options["zeta"] = wall["zeta"]
    heights = case.heights
    if comm.size > 1:
        heights, options["comm"] = heights[slab(len(heights), comm.size, comm.rank)].copy(), comm
    found = pgfmd.solve(heights, document["load"]["pressure"], spacing=tuple(spacing), threads=1, **options)
    fields = [np.concatenate(comm.allgather(field)) for field in (found.pressure, found.gap)]
    answer = Answer(
        found.mean_pressure, float(np.mean(fields[0] > 0)), found.mean_gap, found.elastic_energy, found.certified_error,
        *fields, target=document["load"]["pressure"],
    )  # fmt: skip
    job = {
        "grid": {"n": list(shape), "spacing": list(spacing)},
        "solid": {"thickness": math.inf, "base": "bonded", "poisson": 0.25} | solid,
        "wall": {"kind": "hard"} | wall,
        "load": {"pressure": [document["load"]["pressure"]]},
        "solver": {"tolerance": 1e-8} | solver,
        "surface": document["surface"],
    }
    return job, case.heights, [answer]


def _by_simulate(case: Case, folder: Path, comm):
    """By `simulate`, from the TOML file to the result files."""
    job = jobs.load(folder / "job.toml")
    run_job(job, comm, folder / "out")
    comm.Barrier()
    if comm.rank:
        return None, None, None
    return _read(folder, jobs.as_toml(job))


def _by_command(case: Case, folder: Path, comm):
    """By the command line, in another process; exit codes 2 and 3 and their line become the error that they report."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "pgfmd", "run", folder / "job.toml", "--output", folder / "out"],
        capture_output=True, text=True, timeout=HANG, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode in (2, 3):
        lines = [line for line in done.stderr.splitlines() if "error:" in line]
        refused = (InputError, SolverError)[done.returncode - 2]
        if done.returncode == 2 and len(done.stderr.splitlines()) > 1:
            lines = [line for line in done.stderr.splitlines() if not re.match(r"\d\d:\d\d:\d\d", line)]
        raise refused(lines[0] if len(lines) == 1 else done.stderr)
    if done.returncode:
        raise RuntimeError(f"exit code {done.returncode}: {done.stderr}")
    return _read(folder, jobs.as_toml(jobs.load(folder / "job.toml")))


WAYS = {"solve": _by_solve, "simulate": _by_simulate, "command": _by_command}


def _read(folder: Path, job: str):
    """(effective job as tables, heights, answers) of a result folder."""
    job = tomllib.loads(job)
    where = sorted((folder / "out").glob("seed_*")) or [folder / "out"]
    results = pgfmd.Results(where[-1])
    control = control_of(job)
    names = ("mean_pressure", "contact_area", "mean_gap", "elastic_energy", "certified_error")
    fields = [name for name in ("pressure", "gap") if name in job["output"]["fields"]]
    heights = results.field("height") if "height" in job["output"]["fields"] else None
    answers, relief = [], float(np.ptp(heights)) if heights is not None and heights.size else 0.0
    steps = len(results.loads["mean_pressure"])
    targets = job["load"][control]
    for index, target in enumerate(targets if steps == len(targets) and control in IMPOSED else [math.nan] * steps):
        row = {name: float(results.loads[name][index]) for name in names}
        arrays = {name: results.field(name, load=index) for name in fields} if len(fields) == 2 else {}
        found = {name: dict(results[index][name]) for name in results[index]}
        columns = {name: column[index] for name, column in results.loads.items()}
        arrays = {"pressure": None, "gap": None} | arrays
        answers.append(Answer(**row, **arrays, target=target, groups=found, columns=columns, relief=relief))
    return job, heights, answers

"""Random jobs over all keys, walls, solids, controls and units, each answer against a slow reference (tests/reference.py).

    python tools/campaign.py --jobs 20000 --seed 1          # counts, and a minimal job of each that went wrong
    python tools/campaign.py --seed 1 --only 4711           # that job alone, as TOML, with its verdict

A job ends right (its true error is within the certified one; pressure, gap, area, mean gap and energy agree with the
reference), or is refused in one line.  Anything else is wrong: an error larger than its bound, a number that does not
fit, a traceback, a warning, a hang.  Jobs run in a process of their own, which is replaced should it hang or crash.
"""  # noqa: E501

from __future__ import annotations

import argparse
import copy
import faulthandler
import json
import math
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import reference  # noqa: E402

HANG = 120.0  # seconds of processor time that a job of at most 24² points may take
ASLEEP = 20  # times that, of wall time: a process that waits for nothing
LARGEST_SIDE = 24
AREA_PIXEL = 1.0  # pixels by which an area may miss, whatever area_tolerance says: README
JUMP = 1e-4  # relative width of the loads across which an area jumps
ROUNDING = 1e-12  # of sums over the grid, relative to their largest terms
FLOOR = 1e-30  # relative energy error of a double's last digit
RIGHT, REFUSED, UNCERTIFIED, WRONG, TRACEBACK, HANGS, UNJUDGED = VERDICTS = (
    "right", "refused", "uncertified", "wrong", "traceback", "hang", "unjudged",
)  # fmt: skip
BAD = (WRONG, TRACEBACK, HANGS)


# ---- drawing jobs ----------------------------------------------------------------------------------------------------


@dataclass
class Case:
    """A job as tables of TOML, heights (nx, ny) for its file, and the way by which it is run."""

    number: int
    document: dict
    heights: np.ndarray | None
    way: str  # "solve" (arrays), "simulate" (in this process) or "command" (in another one)
    spoilt: bool = False  # a value was replaced by another that is probably wrong


def draw(seed: int, number: int) -> Case:
    """The job of that number; the same whatever was drawn before."""
    chance = np.random.default_rng([seed, number])
    shape = [_side(chance), _side(chance)]
    if max(shape) < 2:
        shape[chance.integers(2)] = 2
    if chance.random() < 0.4:
        shape[1] = shape[0] = max(shape)
    length_unit, modulus = 10.0 ** _exponent(chance), 10.0 ** _exponent(chance)
    spacing = length_unit * np.ones(2)
    if chance.random() < 0.3:
        spacing = spacing * 10 ** chance.uniform(-1, 1, 2)
    document = {"grid": _grid(chance, shape, spacing), "solid": _solid(chance, modulus, shape, spacing)}
    steepness = 10 ** (chance.uniform(-3, 1) if chance.random() < 0.9 else chance.uniform(-60, 60))
    size = float(steepness * min(spacing))  # typical height between neighbours
    surface, heights = _surface(chance, shape, spacing, size, steepness)
    document["surface"] = surface
    if heights is not None and heights.size:
        with np.errstate(all="ignore"):
            size = float(np.std(heights) or size)
    law = _wall(chance, size)
    if law:
        document["wall"] = law
    stress = modulus * size / float(min(spacing))
    document["load"] = _load(chance, stress, size, shape, law)
    document["solver"] = _solver(chance, law)
    document["output"] = _output(chance, shape, spacing)
    if chance.random() < 0.2:
        document["run"] = {"checkpoint_interval": [0.0, math.inf, 60.0][chance.integers(3)]}
    for name in [name for name, table in document.items() if not table]:
        del document[name]
    spoilt = bool(chance.random() < 0.12)
    if spoilt:
        spoil(chance, document)
    way = chance.choice(["solve", "simulate", "command"], p=[0.35, 0.645, 0.005])
    if way == "solve" and not _solvable(document, spoilt):
        way = "simulate"
    return Case(number, document, heights, str(way), spoilt)


def _side(chance) -> int:
    return int(chance.integers(*((1, 9), (9, 17), (17, LARGEST_SIDE + 1))[chance.choice(3, p=[0.6, 0.3, 0.1])]))


def _exponent(chance) -> float:
    """Of a unit: often none, often that of SI, at times absurd."""
    return float(chance.choice([0.0, chance.uniform(-12, 12), chance.uniform(-100, 100)], p=[0.4, 0.4, 0.2]))


def _grid(chance, shape, spacing) -> dict:
    table = {"n": shape[0] if shape[0] == shape[1] and chance.random() < 0.5 else shape}
    way = chance.integers(2)
    if way == 0:
        table["spacing"] = [float(value) for value in spacing]
    else:
        table["length"] = [float(n * value) for n, value in zip(shape, spacing, strict=True)]
    return table


def _solid(chance, modulus: float, shape, spacing) -> dict:
    poisson = float(chance.choice([chance.uniform(-0.9, 0.49), 0.25, 0.0, 0.4999], p=[0.5, 0.3, 0.1, 0.1]))
    way = chance.integers(4)
    if way == 0:
        table = {"contact_modulus": modulus, "poisson": poisson}
    elif way == 1:
        table = {"young": modulus * (1 - poisson**2), "poisson": poisson}
    elif way == 2:
        mu = modulus * (1 - poisson) / 2
        table = {"lame_lambda": 2 * mu * poisson / (1 - 2 * poisson), "lame_mu": mu}
    else:
        table = {"contact_modulus": modulus}
    if chance.random() < 0.4:
        cell = float(max(n * value for n, value in zip(shape, spacing, strict=True)))
        power = chance.uniform(-3, 1.5) if chance.random() < 0.8 else chance.uniform(-20, 20)
        table["thickness"] = cell * 10**power
        table["base"] = str(chance.choice(["bonded", "free", "sliding"]))
        if "poisson" not in table and way == 3 and chance.random() < 0.8:
            table["poisson"] = poisson
    return table


def _surface(chance, shape, spacing, size: float, steepness: float) -> tuple[dict, np.ndarray | None]:
    kind = chance.choice(["file", "self-affine", "sinusoid", "paraboloid"], p=[0.45, 0.3, 0.15, 0.1])
    if kind == "self-affine":
        longest = max(n * value for n, value in zip(shape, spacing, strict=True)) / min(spacing)
        table = {
            "kind": "self-affine",
            "hurst": float(chance.uniform(0, 1)),
            "lambda_s": float(chance.choice([1.0, min(2.0, longest), chance.uniform(0.5, longest)])),
            "rms_slope": float(steepness),
        }
        if chance.random() < 0.5:
            table["seed"] = int(chance.integers(0, 2**63 - 1))
        if chance.random() < 0.2:
            table["lambda_l"] = float(chance.uniform(table["lambda_s"], longest))
            if chance.random() < 0.5:
                table["lambda_r"] = float(chance.choice([longest, math.inf]))
        return table, None
    if kind == "sinusoid":
        table = {"kind": "sinusoid", "amplitude": float(size * chance.choice([1, -1]))}
        if chance.random() < 0.5:
            table["waves"] = int(chance.integers(1, max(2, min(shape) // 2 + 1)))
        if chance.random() < 0.5:
            table["two_dimensional"] = bool(chance.random() < 0.7)
        return table, None
    if kind == "paraboloid":
        return {"kind": "paraboloid", "radius": float(min(spacing) / steepness)}, None
    table = {"kind": "file", "path": "heights.npy"}
    heights = draw_heights(chance, shape) * size
    if chance.random() < 0.15:
        table["detrend"] = str(chance.choice(["none", "mean", "plane"]))
    if chance.random() < 0.1:
        table["periodic"] = str(chance.choice(["as-is", "taper"]))
    if chance.random() < 0.15:
        table["height_scale"] = float(chance.choice([-1.0, 2.0, 1e-3]))
    return table, heights


def draw_heights(chance, shape) -> np.ndarray:
    """An odd surface of heights of order 1."""
    noise = chance.standard_normal(shape)
    way = chance.integers(10)
    if way == 0:  # plateaus
        return np.round(noise)
    if way == 1:  # pillars
        return (noise > 0.7).astype(float)
    if way == 2:  # spikes that differ in their last digits
        spikes = np.zeros(shape)
        for _ in range(int(chance.integers(1, 5))):
            spikes[chance.integers(shape[0]), chance.integers(shape[1])] = 1 + 10.0 ** -chance.integers(1, 17)
        return spikes
    if way == 3:  # far from zero
        return noise + 10 ** chance.uniform(0, 9)
    if way == 4:  # heights of all sizes
        return noise * 10 ** chance.uniform(-8, 0, shape)
    if way == 5:  # flat, but for a hole or nothing
        flat = np.zeros(shape)
        flat[chance.integers(shape[0]), chance.integers(shape[1])] = -chance.integers(2)
        return flat
    if way == 6:  # a step
        return np.repeat(np.sign(chance.standard_normal((shape[0], 1))), shape[1], 1)
    if way == 7:  # single precision
        return noise.astype(np.float32).astype(float)
    return noise


def _wall(chance, size: float) -> dict:
    if chance.random() < 0.65:
        return {} if chance.random() < 0.8 else {"kind": "hard"}
    tail = chance.random() < 0.1
    table = {"kind": "exponential", "zeta": size * 10 ** (chance.uniform(-100, 100) if tail else chance.uniform(-4, 3))}
    if chance.random() < 0.3:
        table["sigma_ref"] = 10.0 ** float(chance.uniform(-30, 30))
    return table


def _load(chance, stress: float, size: float, shape, wall: dict) -> dict:
    control = str(chance.choice(["pressure", "contact_area", "mean_gap", "displacement"], p=[0.55, 0.15, 0.15, 0.15]))
    count = int(chance.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))
    targets = []
    for _ in range(count):
        way = chance.random()
        if control == "pressure":
            powers = ((-3, 0.7), (-14, 3), (-100, 20))[0 if way < 0.6 else 1 if way < 0.85 else 2]
            value = stress * 10 ** chance.uniform(*powers)
            if way > 0.97:
                value = float(chance.choice([0.0, 1e-300, 1e300, 1e-100 * stress]))
        elif control == "contact_area":
            value = chance.uniform(0, 1) if way < 0.7 else 10 ** chance.uniform(-6, 0)
            if way > 0.9:
                value = chance.integers(1, shape[0] * shape[1] + 1) / (shape[0] * shape[1]) * (1 - 1e-3)
        else:
            value = size * (chance.uniform(0.01, 3) if way < 0.7 else 10 ** chance.uniform(-8, 1))
            if way > 0.9:
                value *= -1 if chance.random() < 0.5 else 10 ** chance.uniform(0, 40)
        targets.append(float(value))
    table = {control: targets[0] if count == 1 and chance.random() < 0.5 else targets}
    if chance.random() < 0.15:
        name = "area_tolerance" if control == "contact_area" else "gap_tolerance"
        table[name] = 10.0 ** float(chance.uniform(-8, -0.5))
    return table


def _solver(chance, wall: dict) -> dict:
    table = {}
    way = chance.random()
    if way > 0.4:
        table["tolerance"] = 10.0 ** float(chance.uniform(-12, -1) if way < 0.9 else chance.uniform(-17, -12))
    way = chance.random()
    if way > 0.7:
        own = "newton" if wall.get("kind") == "exponential" else "active-set"
        table["method"] = str(chance.choice(["auto", own, "gfmd"], p=[0.3, 0.4, 0.3]))
        if table["method"] == "gfmd" and chance.random() < 0.8:
            table["max_iterations"] = int(10 ** chance.uniform(0, 3.5))
    return table


OBSERVABLES = ("histogram", "spectra", "acf", "patches", "bearing", "lowpass")


def _output(chance, shape, spacing) -> dict:
    table = {"fields": ["height", "pressure", "gap"] + ["displacement", "labels"] * int(chance.random() < 0.15)}
    if chance.random() < 0.05:
        table["precision"] = "float32"
    if chance.random() < 0.25:
        table["observables"] = [str(name) for name in chance.permutation(OBSERVABLES)[: chance.integers(0, 7)]]
        for name in ("spectra", "acf"):
            if chance.random() < 0.3:
                table[name] = {"spacing": str(chance.choice(["log", "linear"])), "bins": int(chance.integers(1, 60))}
        if chance.random() < 0.3:
            table["histogram"] = {"bins": int(chance.integers(1, 300))}
        if chance.random() < 0.3:
            table["patches"] = {"connectivity": int(chance.choice([4, 8]))}
        if chance.random() < 0.3:
            cell = max(n * value for n, value in zip(shape, spacing, strict=True))
            table["lowpass"] = {"q": [float(2 * np.pi / cell * 10 ** chance.uniform(-1, 2))]}
    return table


NASTY = (
    math.nan, math.inf, -math.inf, -1.0, 0.0, -0.0, 1e-300, 1e300, 5e-324, 1, -1, 0, True, False, "", "x", "\u202e", [],
    [1.0, 2.0, 3.0], [[1.0]], {}, {"a": 1}, 2**40, -(2**70), 2**64, 1.5, "hard", "exponential", "gfmd", "nan",
)  # fmt: skip


def spoil(chance, document: dict) -> None:
    """Change a job in place: a value replaced, a key lost, doubled or misspelt."""
    for _ in range(int(chance.integers(1, 3))):
        section = str(chance.choice(sorted(document)))
        table = document[section]
        if not isinstance(table, dict) or not table:
            continue
        name = str(chance.choice(sorted(table)))
        way = chance.integers(6)
        if way <= 3:
            table[name] = copy.deepcopy(NASTY[chance.integers(len(NASTY))])
        elif way == 4:
            del table[name]
        else:
            table[name + "x"] = table.pop(name)
    try:  # too large to be tried on a small machine, too small to be refused
        points = np.prod(np.atleast_1d(document["grid"]["n"]).astype(float))
        if 1e5 < points < 1e15:
            document["grid"]["n"] = 4
    except (KeyError, TypeError, ValueError):
        pass


def _solvable(document: dict, spoilt: bool) -> bool:
    """Whether `pgfmd.solve` knows all that the job says."""
    load, wall = document.get("load"), document.get("wall", {})
    return (
        not spoilt
        and document["surface"].get("kind") == "file"
        and not set(document["surface"]) & {"detrend", "periodic", "height_scale"}
        and isinstance(load.get("pressure"), float)
        and "sigma_ref" not in wall
        and "contact_modulus" in document["solid"]
    )


def toml(document: dict) -> str:
    """The tables as TOML."""
    lines = []

    def write(prefix: str, table: dict):
        tables = {}
        for name, value in table.items():
            if isinstance(value, dict) and value and not prefix.count("."):
                tables[name] = value
            else:
                lines.append(f"{name} = {_literal(value)}")
        for name, value in tables.items():
            lines.append(f"[{prefix}.{name}]")
            write(f"{prefix}.{name}", value)

    for section, table in document.items():
        if isinstance(table, dict):
            lines.append(f"[{section}]")
            write(section, table)
        else:
            lines.insert(0, f"{section} = {_literal(table)}")
    return "\n".join(lines) + "\n"


def _literal(value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {_literal(entry)}" for name, entry in value.items()) + "}"
    return "[" + ", ".join(map(_literal, value)) + "]"


# ---- running them ----------------------------------------------------------------------------------------------------


@dataclass
class Answer:
    """One load as pgfmd answers it; fields (nx, ny)."""

    mean_pressure: float
    contact_area: float
    mean_gap: float
    elastic_energy: float
    certified_error: float
    pressure: np.ndarray
    gap: np.ndarray
    target: float | None = None


def run(case: Case, folder: Path, comm=None) -> tuple[str, str]:
    """(verdict, what is wrong or was refused) of a job, run in `folder`.  Collective over comm."""
    from mpi4py import MPI

    from pgfmd.errors import InputError, SolverError

    comm = MPI.COMM_SELF if comm is None else comm
    if comm.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        if case.heights is not None:
            np.save(folder / "heights.npy", case.heights)
        (folder / "job.toml").write_text(toml(case.document), encoding="utf-8")
    comm.Barrier()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            job, heights, answers = WAYS[case.way](case, folder, comm)
    except InputError as error:
        return _line(str(error), REFUSED)
    except SolverError as error:
        return _line(str(error), UNCERTIFIED)
    except Exception:
        return TRACEBACK, traceback.format_exc()
    leaks = [f"{warning.message} ({Path(warning.filename).name}:{warning.lineno})" for warning in caught]
    if leaks:
        return WRONG, f"warning: {leaks[0]}"
    if comm.rank:
        return RIGHT, ""
    try:
        with np.errstate(all="ignore"):
            return judge(job, heights, answers)
    except reference.Unable as error:
        return UNJUDGED, str(error)


def _line(message: str, verdict: str) -> tuple[str, str]:
    """A refusal, if it is one line that can be printed."""
    good = message.isprintable() and 0 < len(message) < 1200
    return (verdict, message) if good else (WRONG, f"message that is not one line: {message!r}")


def _by_solve(case: Case, folder: Path, comm):
    """By `pgfmd.solve`."""
    import pgfmd

    document = case.document
    solid, wall, solver = document["solid"], document.get("wall", {}), document.get("solver", {})
    shape = case.heights.shape
    spacing = document["grid"].get("spacing") or [
        length / n for length, n in zip(document["grid"]["length"], shape, strict=True)
    ]
    options = {key: solid[key] for key in ("contact_modulus", "thickness", "base", "poisson") if key in solid}
    options |= {key: solver[key] for key in ("tolerance", "method") if key in solver}
    if wall.get("kind") == "exponential":
        options["zeta"] = wall["zeta"]
    heights = case.heights
    if comm.size > 1:
        from pgfmd.parallel.collectives import slab

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
    from pgfmd.job import job as jobs
    from pgfmd.simulate import simulate

    job = jobs.load(folder / "job.toml")
    simulate(job, comm, folder / "out")
    comm.Barrier()
    if comm.rank:
        return None, None, None
    return _read(folder, jobs.as_toml(job))


def _by_command(case: Case, folder: Path, comm):
    """By the command line, in another process; its exit code and its one line become the errors that they say."""
    from pgfmd.errors import InputError, SolverError
    from pgfmd.job import job as jobs

    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "pgfmd", "run", folder / "job.toml", "--output", folder / "out"],
        capture_output=True, text=True, timeout=HANG, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode in (2, 3):
        lines = [line for line in done.stderr.splitlines() if "error" in line]
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
    import pgfmd

    job = tomllib.loads(job)
    results = pgfmd.Results(folder / "out")
    control = next(name for name in reference.CONTROLS if name in job["load"])
    names = ("mean_pressure", "contact_area", "mean_gap", "elastic_energy", "certified_error")
    fields = [name for name in ("pressure", "gap") if name in job["output"]["fields"]]
    answers = []
    for index, target in enumerate(job["load"][control]):
        row = {name: float(results.loads[name][index]) for name in names}
        arrays = {name: results.field(name, load=index) for name in fields} if len(fields) == 2 else {}
        answers.append(Answer(**row, **({"pressure": None, "gap": None} | arrays), target=target))
    heights = results.field("height") if "height" in job["output"]["fields"] else None
    return job, heights, answers


# ---- judging them ----------------------------------------------------------------------------------------------------


def judge(job: dict, heights: np.ndarray | None, answers: list[Answer]) -> tuple[str, str]:
    """(verdict, what is wrong) of the answers to an effective job."""
    control = next(name for name in reference.CONTROLS if name in job["load"])
    if heights is None or answers[0].pressure is None or job.get("output", {}).get("precision") == "float32":
        for answer in answers:
            values = [getattr(answer, name) for name in ("mean_pressure", "mean_gap", "elastic_energy")]
            if not all(map(math.isfinite, values)) or not 0 <= answer.certified_error <= job["solver"]["tolerance"]:
                return WRONG, f"numbers {values}, certified {answer.certified_error}"
        return UNJUDGED, "fields that are needed were not asked for"
    if wrong := wrong_heights(job, heights):
        return WRONG, wrong
    solid = job["solid"]
    n = job["grid"]["n"]
    steps = job["grid"].get("spacing") or [a / count for a, count in zip(job["grid"].get("length", n), n, strict=True)]
    slab = reference.Solid(solid["contact_modulus"], solid["thickness"], solid["base"], solid.get("poisson", 0.25))
    contact = reference.Contact(heights, tuple(steps), slab)
    for answer in answers:
        if wrong := wrong_answer(contact, job, control, answer):
            return WRONG, f"{control} = {answer.target:g}: {wrong}"
    return RIGHT, ""


def wrong_heights(job: dict, heights: np.ndarray) -> str:
    """What is wrong with heights of the kinds that have a formula."""
    surface, n = job["surface"], job["grid"]["n"]
    x, y = (np.arange(count)[:, None] / count for count in n)
    if surface["kind"] == "sinusoid":
        waves = surface.get("waves", 1)
        expected = surface["amplitude"] * np.cos(2 * np.pi * waves * x) * np.ones(n[1])
        if surface.get("two_dimensional"):
            expected = expected * np.cos(2 * np.pi * waves * y.T)
    elif surface["kind"] == "paraboloid":
        lengths = job["grid"].get("length") or [
            a * count for a, count in zip(job["grid"].get("spacing", (1, 1)), n, strict=True)
        ]
        expected = -((lengths[0] * (x - 0.5)) ** 2 + (lengths[1] * (y.T - 0.5)) ** 2) / (2 * surface["radius"])
    else:
        return ""
    size = np.abs(expected).max()
    apart = np.abs(heights - expected).max()
    return f"heights are {apart / size:.1e} off" if apart > 1e-13 * size else ""


def wrong_answer(contact: reference.Contact, job: dict, control: str, answer: Answer) -> str:
    """What is wrong with one answer; empty if nothing is."""
    pressure, gap, load = answer.pressure, answer.gap, answer.mean_pressure
    zeta = job["wall"].get("zeta")
    numbers = (load, answer.mean_gap, answer.elastic_energy, answer.certified_error)
    if not (np.isfinite(pressure).all() and np.isfinite(gap).all() and all(map(math.isfinite, numbers))):
        return f"not finite: {numbers}"
    if not 0 <= answer.certified_error <= job["solver"]["tolerance"]:
        return f"certified error {answer.certified_error:.3g} for a tolerance of {job['solver']['tolerance']:.3g}"
    if pressure.min() < 0 or abs(float(np.mean(pressure.astype(reference.Real)) / (load or 1) - (load > 0))) > ROUNDING:
        return "the load is not carried, or there is tension"
    if zeta is None and (gap.min() < 0 or np.any(gap[pressure > 0])):
        return "a gap in contact, or overlap"
    if zeta is None and abs(answer.contact_area - np.mean(pressure > 0)) > 1e-14:
        return f"contact area {answer.contact_area}, of the field {np.mean(pressure > 0)}"
    if control == "pressure" and abs(load / (answer.target or 1) - (answer.target != 0)) > 1e-15:
        return f"mean pressure {load!r} instead of {answer.target!r}"
    if load == 0:
        wrong = np.abs(gap.ravel() + contact.heights).max() / (np.ptp(contact.heights) or 1)
        return f"gap without load is {float(wrong):.1e} off" if wrong > 1e-14 else ""
    try:
        exact = contact.at(load, zeta, job["wall"].get("sigma_ref"))
    except reference.Unable:
        if contact.bound_of(pressure, zeta) > answer.certified_error * (1 + 1e-6) + FLOOR:
            raise
        return ""
    return wrong_energy(exact, answer) or wrong_gap(exact, answer, zeta) or wrong_control(exact, job, control, answer)


def wrong_energy(exact: reference.Solved, answer: Answer) -> str:
    """The true error, and the energy."""
    error = exact.error_of(answer.pressure)
    if answer.elastic_energy > 0:  # which it counts in, as reported
        error *= exact.work / 2 / answer.elastic_energy
    unsure = exact.bound + 2 * np.sqrt(abs(error) * exact.bound)
    if error > answer.certified_error + unsure + FLOOR:
        return f"certified {answer.certified_error:.3g}, true error {float(error):.3g}"
    room = 2 * np.sqrt(2 * reference.Real(answer.certified_error)) + 2 * answer.certified_error + ROUNDING
    energy = exact.work / 2
    if abs(answer.elastic_energy - energy) > room * energy + 1e-323:
        return f"elastic energy {answer.elastic_energy:.17g} instead of {float(energy):.17g}"
    return ""


def wrong_gap(exact: reference.Solved, answer: Answer, zeta) -> str:
    """Gap and mean gap: a pressure that is wrong by d moves u = Gp anywhere by at most √(G₀₀) ‖d‖, ‖d‖² ≤ 2D, and the
    level of contact, ⟨p, g⟩/P, by (D + ‖p‖ ‖d‖ + ‖d‖²)/P."""
    contact, count = exact.contact, exact.contact.count
    work = exact.scaled_work
    bound = work * (reference.Real(answer.certified_error) + exact.bound)
    apart = np.sqrt(2 * bound)
    level = (bound + np.sqrt(work) * apart + 2 * bound) / count if zeta is None else apart
    size = max(np.ptp(contact.heights), np.abs(exact.gap).max() if zeta else 0)
    room = 1.5 * (apart + level) * exact.unit + 1e-13 * size + 4e-16 * (zeta or 0)  # a digit of p̄ moves gaps by ζ
    largest = np.abs(answer.gap.ravel() - exact.gap).max()
    if largest > room + (np.sqrt(2 * bound) * exact.unit if zeta is None else 0):
        return f"gap off by {float(largest / size):.1e} of the height, allowed {float(room / size):.1e}"
    if abs(answer.mean_gap - exact.mean_gap) > room:
        off = abs(answer.mean_gap - exact.mean_gap)
        return f"mean gap off by {float(off / size):.1e} of the height, allowed {float(room / size):.1e}"
    if abs(answer.mean_gap - answer.gap.astype(reference.Real).mean()) > room:
        return f"mean gap {answer.mean_gap!r}, mean of the gap {answer.gap.mean()!r}"
    return ""


def wrong_control(exact: reference.Solved, job: dict, control: str, answer: Answer) -> str:
    """Whether what was imposed was reached, to the tolerance that is stated."""
    if control == "pressure":
        return ""
    contact = exact.contact
    if control == "contact_area":
        room = max(job["load"].get("area_tolerance", 0.005) * answer.target, AREA_PIXEL / contact.count) * (1 + 1e-9)
        if abs(answer.contact_area - answer.target) <= room:
            return ""
        sides = [contact.hard(answer.mean_pressure * (1 + sign * 3 * JUMP)) for sign in (-1, 1)]
        low, high = (contact.measure(control, side) for side in sides)
        if low <= answer.target <= high:
            return ""
        return f"area {answer.contact_area:.6g}; {low:.6g} and {high:.6g} at neighbouring loads"
    measure = contact.measure(control, exact)
    # load.gap_tolerance is relative to the approach from first contact or, if less, to the mean gap (or ζ, if more).
    zeta = job["wall"].get("zeta", 0)
    approach = abs(-contact.heights.mean() - exact.mean_gap)
    if control == "displacement":
        approach = abs(answer.target)
    bounded = not zeta and (control == "mean_gap" or not contact.solid.mean_compliance)
    size = max(min(approach, exact.mean_gap) if bounded else approach, zeta)
    room = job["load"]["gap_tolerance"] * size * (1 + 1e-6) + 1e-13 * np.ptp(contact.heights)
    if abs(measure - answer.target) > room:
        return f"reached {float(measure):.9g}, {float((measure - answer.target) / contact.rms):.1e} rms heights off"
    return ""


# ---- smaller ones ----------------------------------------------------------------------------------------------------


def shrink(case: Case, verdict: str, detail: str, folder: Path, tries: int = 60) -> tuple[Case, str]:
    """A smaller job that goes wrong in the same way; greedy."""
    wanted, best, said = kind(verdict, detail), case, detail
    folders = (folder / f"s{number}" for number in range(10**6))

    def attempt(document, heights) -> bool:
        nonlocal best, said, tries
        if tries == 0:
            return False
        tries -= 1
        smaller = Case(case.number, document, heights, best.way, best.spoilt)
        place = next(folders)
        found = run(smaller, place)
        shutil.rmtree(place, ignore_errors=True)
        if kind(*found) == wanted:
            best, said = smaller, found[1]
            return True
        return False

    for control in reference.CONTROLS:
        targets = best.document.get("load", {}).get(control)
        for target in targets if isinstance(targets, list) and len(targets) > 1 else ():
            document = copy.deepcopy(best.document)
            document["load"][control] = [target]
            if attempt(document, best.heights):
                break
    for section in ("run", "output", "wall", "solver", "solid"):
        for name in [None, *best.document.get(section, {})]:
            document = copy.deepcopy(best.document)
            if section not in document or (name is not None and name not in document[section]):
                continue
            if name is None:
                del document[section]
                if section == "output":
                    document["output"] = {"fields": ["height", "pressure", "gap"]}
            else:
                del document[section][name]
            attempt(document, best.heights)
    while best.heights is not None and best.heights.ndim == 2 and tries:
        for axis in (0, 1):
            heights = np.delete(best.heights, -1, axis)
            document = copy.deepcopy(best.document)
            if max(heights.shape) < 2 or 0 in heights.shape or "length" in document["grid"]:
                continue
            document["grid"]["n"] = list(heights.shape)
            if attempt(document, heights):
                break
        else:
            break
    return best, said


def kind(verdict: str, detail: str) -> str:
    """A verdict without its numbers; of a traceback the last lines."""
    if verdict == TRACEBACK:
        detail = " ".join(detail.strip().splitlines()[-3:])
    detail = re.sub(r"\S*/job\.toml", "job.toml", detail)
    return verdict + " " + re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?|\binf\b|\bnan\b", "#", detail)[:160]


def show(case: Case, detail: str) -> str:
    """A job that went wrong, to be copied into a file."""
    heights = ""
    if case.heights is not None:
        values = np.array2string(case.heights, separator=", ", threshold=10**6, floatmode="unique", max_line_width=118)
        heights = f"# heights.npy = np.array({values})\n" if case.heights.size <= 100 else "# heights.npy is drawn\n"
    return f"# job {case.number} by {case.way}: {detail}\n{toml(case.document)}{heights}"


# ---- many of them ----------------------------------------------------------------------------------------------------


def work(seed: int, first: int, count: int) -> None:
    """Run jobs in this process; one line of JSON each."""
    faulthandler.register(signal.SIGUSR1)
    seen = set()  # one minimal job of each kind is enough
    with tempfile.TemporaryDirectory(prefix="pgfmd-campaign-") as folder:
        for number in range(first, first + count):
            print(json.dumps({"begun": number}), flush=True)
            began = time.perf_counter()
            case = draw(seed, number)
            place = Path(folder) / str(number)
            verdict, detail = run(case, place)
            seconds = time.perf_counter() - began
            minimal = ""
            if verdict in BAD and (like := kind(verdict, detail)) not in seen:
                seen.add(like)
                shrunk, said = shrink(case, verdict, detail, place)
                minimal = show(shrunk, said)
            shutil.rmtree(place, ignore_errors=True)
            found = {"number": number, "verdict": verdict, "detail": detail, "seconds": seconds, "minimal": minimal}
            print(json.dumps(found), flush=True)


def _clocks(process: int) -> tuple[float, float]:
    """Seconds of processor time of a process (of wall time, where the system does not tell), and of wall time."""
    wall = time.monotonic()
    try:
        times = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
        return sum(map(int, times)) / os.sysconf("SC_CLK_TCK"), wall
    except (OSError, ValueError):
        return wall, wall


def supervise(seed: int, first: int, count: int):
    """Results of jobs, run in another process, which is replaced when it hangs or dies."""
    number, stop = first, first + count
    while number < stop:
        command = [sys.executable, __file__, "--seed", str(seed), "--work", str(number), str(stop - number)]
        with tempfile.TemporaryFile("w+") as errors:
            worker = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, stdin=subprocess.DEVNULL)
            verdict, buffer, since, patience = None, b"", _clocks(worker.pid), 4 * HANG
            while number < stop:
                ready, _, _ = select.select([worker.stdout], [], [], 1.0)
                chunk = os.read(worker.stdout.fileno(), 1 << 16) if ready else b""
                buffer += chunk
                *lines, buffer = buffer.split(b"\n")
                for line in map(json.loads, lines):
                    since, patience = _clocks(worker.pid), HANG
                    if "verdict" in line:
                        number = line["number"] + 1
                        patience = 4 * HANG
                        yield line
                if ready and not chunk:
                    verdict = TRACEBACK  # it died
                    break
                busy, wall = np.subtract(_clocks(worker.pid), since)
                if busy > patience or wall > ASLEEP * patience:
                    verdict = HANGS
                    worker.send_signal(signal.SIGUSR1)  # says where it is
                    time.sleep(1)
                    break
            worker.kill()
            worker.wait()
            if verdict is not None:
                errors.seek(0)
                detail = f"the process ended: {errors.read()[-2000:]}"
                yield {"number": number, "verdict": verdict, "detail": detail, "seconds": HANG,
                       "minimal": show(draw(seed, number), "")}  # fmt: skip
                number += 1


def report(seed: int, first: int, count: int, log=None) -> int:
    """Run jobs, print what goes wrong and the counts; 0 if nothing did."""
    verdicts, kinds, began = Counter(), Counter(), time.perf_counter()
    for found in supervise(seed, first, count):
        verdicts[found["verdict"]] += 1
        if found["verdict"] != RIGHT:
            kinds[kind(found["verdict"], found["detail"])] += 1
        if found["minimal"]:
            print(f"--- seed {seed}, {found['verdict']}: {found['detail']}\n{found['minimal']}", flush=True)
        if log is not None:
            log.write(json.dumps(found) + "\n")
    print(*(f"{number:6}  {name}" for name, number in kinds.most_common()), sep="\n")
    total = ", ".join(f"{verdicts[name]} {name}" for name in VERDICTS)
    print(f"seed {seed}: {sum(verdicts.values())} jobs: {total}; {time.perf_counter() - began:.0f} s")
    return int(any(verdicts[name] for name in BAD))


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=300, help="how many")
    parser.add_argument("--seed", type=int, default=1, help="of all of them")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--only", type=int, help="show the job of that number and its verdict")
    parser.add_argument("--log", type=Path, help="file for every verdict, a line of JSON each")
    parser.add_argument("--work", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.work:
        work(options.seed, *options.work)
        return 0
    if options.only is not None:
        case = draw(options.seed, options.only)
        with tempfile.TemporaryDirectory(prefix="pgfmd-campaign-") as folder:
            verdict, detail = run(case, Path(folder) / "case")
        print(f"{show(case, '')}{verdict}: {detail}")
        return int(verdict in BAD)
    if options.log is None:
        return report(options.seed, options.first, options.jobs)
    with options.log.open("w") as log:
        return report(options.seed, options.first, options.jobs, log)


if __name__ == "__main__":
    raise SystemExit(main())

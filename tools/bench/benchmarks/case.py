"""A benchmark case: one self-affine surface at one load, and the solution that errors are measured against; how
modules of this folder are run in processes of their own, on so many ranks and threads.
"""

import dataclasses
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import erfinv

from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import ALONE
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.surfaces.self_affine import self_affine

ROOT = Path(__file__).resolve().parents[3]
CONTACT_MODULUS = 8 / 3  # Lamé constants 1
RMS_SLOPE = 0.031
SEED = 1
LIKELY_FACTOR = 1.4  # real areas at small load exceed Persson's by about this much
REFERENCE_ERRORS = (1e-22, 1e-20, 1e-18)  # certified; the first that can be reached


@dataclass(frozen=True)
class Case:
    """n × n points of spacing 1; Hurst exponent; shortest wavelength λ_s; the relative contact area aimed at."""

    n: int
    hurst: float
    lambda_s: float
    area: float

    @property
    def name(self) -> str:
        return f"n{self.n}-H{self.hurst:g}-ls{self.lambda_s:g}-fc{self.area:g}"

    def heights(self, folder: Path, rows: slice = slice(None)) -> np.ndarray:
        """Heights (rows, n) in grid spacings."""
        return np.array(np.load(_surface_file(self, folder), mmap_mode="r")[rows])

    def reference(self, folder: Path, rows: slice = slice(None)) -> np.ndarray:
        """The pressure (rows, n) that errors refer to."""
        return np.array(np.load(folder / f"{self.name}.npy", mmap_mode="r")[rows])

    def facts(self, folder: Path) -> dict:
        """mean_pressure, area (reached), certified_error of the reference."""
        return json.loads((folder / f"{self.name}.json").read_text())

    def prepared(self, folder: Path) -> bool:
        return (folder / f"{self.name}.json").exists() and _surface_file(self, folder).exists()


def _surface_file(case: Case, folder: Path) -> Path:
    return folder / f"surface-n{case.n}-H{case.hurst:g}-ls{case.lambda_s:g}.npy"


def surface_of(case: Case, seed: int = SEED) -> np.ndarray:
    """Heights (n, n) in grid spacings; one seed is one surface on any grid.  Serial."""
    return self_affine(SlabGrid(ALONE, (case.n, case.n)), case.hurst, case.lambda_s, RMS_SLOPE, seed)


def hard_contact(grid: SlabGrid, heights: np.ndarray, pressure: float) -> ContactProblem:
    """The contact of a half-space with rigid heights (rows, n) at a mean pressure."""
    return ContactProblem(grid, heights, Homogeneous(contact_modulus=CONTACT_MODULUS), HardWall(), pressure)


def prepare(case: Case, folder: Path) -> None:
    """Write surface, load and reference into `folder`.  Serial; takes a few solves of our own."""
    grid = SlabGrid(ALONE, (case.n, case.n))
    path = _surface_file(case, folder)
    if path.exists():
        heights = np.load(path)
    else:
        heights = surface_of(case)
        np.save(path, heights)

    def solve(pressure: float, tolerance: float):
        return solve_hard_wall(hard_contact(grid, heights, pressure), tolerance)

    pressure = _load_for(case.area, lambda p: float(np.mean(solve(p, 1e-3).pressure > 0)))
    for tolerance in REFERENCE_ERRORS:
        try:
            solution = solve(pressure, tolerance)
            break
        except SolverError:
            if tolerance == REFERENCE_ERRORS[-1]:
                raise
    np.save(folder / f"{case.name}.npy", solution.pressure)
    facts = dataclasses.asdict(case) | {
        "mean_pressure": pressure,
        "area": float(np.mean(solution.pressure > 0)),
        "certified_error": solution.certified_error,
    }
    (folder / f"{case.name}.json").write_text(json.dumps(facts, indent=1))


def _load_for(area: float, measure) -> float:
    """The mean pressure that gives the contact area to 1 %: Persson's law with one factor fitted anew at each try."""
    factor = LIKELY_FACTOR
    for _ in range(5):
        pressure = likely_pressure(area, factor)
        found = measure(pressure)
        if abs(found - area) <= 0.01 * min(area, 1 - area):
            break
        factor *= erfinv(min(found, 1 - 1e-9)) / erfinv(area)
    return pressure


def likely_pressure(area: float, factor: float = LIKELY_FACTOR) -> float:
    """The mean pressure that gives about that contact area: Persson's law with a factor."""
    return float(erfinv(area)) / factor * CONTACT_MODULUS * RMS_SLOPE / math.sqrt(2)


def launch(module: str, arguments: list[str], ranks: int, threads: int) -> subprocess.Popen:
    """Start `python -m benchmarks.<module> arguments`; its output goes to pipes, as text."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, str(threads))
    folders = [str(ROOT / "tools" / "bench"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(folders)
    command = [sys.executable, "-m", "mpi4py", "-m", f"benchmarks.{module}", *arguments]
    if ranks > 1:
        command = ["mpirun", "-n", str(ranks), *command]
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )

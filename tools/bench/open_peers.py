"""Open patches by this program and its peers: equal pressures, areas, and processor time on one core.

    python tools/bench/open_peers.py equal --n 512 1024  # pressures, with the peers' coefficients in ours
    python tools/bench/open_peers.py slip --n 128 512  # friction .3 at ν = 0, half of the sliding load, against ASPHER
    python tools/bench/open_peers.py area --n 512 1024 2048 4096  # area, approach and mean gap against finer grids
    python tools/bench/open_peers.py speed --n 2048 --programs pgfmd ASPHER  # to a pressure error of 1e-4

Rows are appended to jobs/benchmark/open.csv (--csv); one that is there is not measured again.  Surfaces: `rough:H:λ_s`
with λ_s in units of 1/512 of the side, or (`rough:.8:=16`) in spacings; `tip:H:λ_s`, the same on a paraboloid, so that
contact ends before the border; `sphere:a`, of contact radius a sides; `punch`.  The rms slope is .1, E' = 1; errors are
relative 2-norms, against a certified solution of the same equations: ours with the influence coefficients of the
program.
"""

import argparse
import contextlib
import math
import sys
import time
from pathlib import Path

import csv_rows
import numpy as np
import peers
from benchmarks.recorder import EnoughError
from peers import love
from scipy.special import erfinv

import pgfmd
from pgfmd.observables.contact import Contact
from pgfmd.observables.partial_slip import PartialSlip
from pgfmd.observables.rough_surface import RoughSurface
from pgfmd.physics.solids.homogeneous import Homogeneous

SIDE, SLOPE, ENOUGH = 512.0, 0.1, 1e-4
COLUMNS = "part n surface load program setting cpu work pressure_error area corrected_area approach mean_gap".split()


def heights_of(surface: str, n: int) -> np.ndarray:
    """Heights (n, n) of the side 512, points in the middle of pixels."""
    kind, *values = surface.split(":")
    x = (np.arange(n) + 0.5) * SIDE / n - SIDE / 2
    r2 = x[:, None] ** 2 + x**2
    if kind == "sphere":
        return -r2 / (8 * SIDE)
    if kind == "punch":
        return np.where(r2 <= (0.3 * SIDE) ** 2, 0.0, -SIDE)
    hurst, length = values
    table = {"kind": "self-affine", "hurst": float(hurst), "rms_slope": SLOPE, "seed": 3}
    table["lambda_s"] = float(length.lstrip("="))  # in spacings of the grid on which it is made
    count = n if length[0] == "=" else 512
    rough = pgfmd.surface({"grid": {"n": count, "length": SIDE}, "surface": table, "solid": {"contact_modulus": 1.0}})
    rough = rough if count == n else _finer(rough, n)
    return rough - r2 / (2 * SIDE) if kind == "tip" else rough


def _finer(field: np.ndarray, n: int) -> np.ndarray:
    """A band-limited periodic field (m, m) in the middle of n × n pixels, where it was in that of m × m."""
    m, half = len(field), len(field) // 2
    phase = np.exp(-1j * math.pi * (1 - m / n) * np.fft.fftfreq(m))
    modes, finer = np.fft.rfft2(field) * phase[:, None] * phase[: half + 1], np.zeros((n, n // 2 + 1), complex)
    finer[:half, : half + 1], finer[-half:, : half + 1] = modes[:half], modes[half:]
    return np.fft.irfft2(finer, s=(n, n)) * (n / m) ** 2


def load_of(surface: str, area: float) -> float:
    """The mean pressure for about that contact area."""
    kind, *values = surface.split(":")
    if kind == "sphere":
        return 4 * (float(values[0]) * SIDE) ** 3 / (3 * 4 * SIDE) / SIDE**2
    return 0.01 if kind == "punch" else float(erfinv(area)) * SLOPE / math.sqrt(2) / 1.3


def ours(heights: np.ndarray, load: float, tolerance: float):
    """Our solution of one load."""
    spacing = SIDE / len(heights)
    return pgfmd.solve(heights, load, spacing=spacing, boundary="open", contact_modulus=1.0, tolerance=tolerance,
                       threads=1)  # fmt: skip


def aspher(heights: np.ndarray, load: float, tolerance: float, setting: str):
    """(pressure, iterations on all grids weighted by their size) by ASPHER's nested solver."""
    import aspher as peer

    n, (backend, engine, precision) = len(heights), setting.split()
    found = peer.solve_nested(
        n, -heights.ravel(), load, domain_size=SIDE, E_star=1.0, backend=backend, precision=precision,
        precond_engine=engine, tol=tolerance, light_result=True,
    )  # fmt: skip
    sides = [(s["name"].partition(":")[2], s["iterations"]) for s in found.stage_stats]
    work = sum(count * ((int(side) if side.isdigit() else n) / n) ** 2 for side, count in sides)
    return np.asarray(found.pressure).reshape(n, n), work


WATCHED = {"ContactMechanics": peers.contact_mechanics, "tamaas": peers.tamaas}
SQUARE = peers.Square(SIDE, 1.0, open=True)


def error_of(pressure: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(pressure - reference) / np.linalg.norm(reference))


def equal(case: dict, heights: np.ndarray, program: str) -> dict:
    """How far a peer's pressure is from ours with its coefficients."""
    with love():
        known = ours(heights, case["load"], 1e-16).pressure
    if program == "ASPHER":
        found, _ = aspher(heights, case["load"], 1e-11, "fft auto double")
    else:
        found, _ = WATCHED[program](heights, case["load"], 1e-11, SQUARE)
    return {"pressure_error": error_of(found, known), "area": float(np.mean(found > 0))}


def slip(case: dict, heights: np.ndarray, program: str) -> dict:
    """Processor time for the contact and its partial slip, with the peer's coefficients; how far its traction is
    from ours, over ours, and its tangential shift (column `approach`).
    """
    n, solid, began = len(heights), Homogeneous(contact_modulus=1.0, poisson=0.0), time.process_time()
    with love():
        found = pgfmd.solve(heights, case["load"], spacing=SIDE / n, boundary="open", solid=solid, tolerance=1e-12,
                            threads=1)  # fmt: skip
        contact = Contact.of(RoughSurface(found.problem, [PartialSlip(friction=0.3)], fields=["traction"]), found)
        numbers = contact.measure()["loads"]
    traction, cpu = contact.fields(("traction",), 8)["traction"], time.process_time() - began
    if program == "pgfmd":
        return {"cpu": cpu, "area": float(numbers["stick_area"]), "approach": float(numbers["tangential_shift"])}
    import aspher as peer

    began = time.process_time()
    solver = peer.FrictionSolver(n, SIDE, 1.0, 0.0, peer.CoulombFriction(0.3))
    solver.set_gap(-heights)
    step = solver.step(p_bar=case["load"], q_bar=(0.15 * case["load"], 0.0), tol_normal=1e-10, tol_tangential=1e-7)
    row = {"cpu": time.process_time() - began, "work": step.normal_iters + step.tangential_iters}
    row |= {"area": step.n_stick / n**2, "approach": float(step.delta_t[0])}
    return row | {"pressure_error": error_of(np.asarray(step.qx).reshape(n, n), traction)}


def area(case: dict, heights: np.ndarray, program: str) -> dict:
    """Raw and corrected area, approach and mean gap, with our coefficients or (program "Love") that of the peers."""
    with love() if program == "Love" else contextlib.nullcontext():
        found = ours(heights, case["load"], 1e-10)
        row = {"area": found.contact_area, "approach": found.displacement, "mean_gap": found.mean_gap}
        return row | ({} if program == "Love" else {"corrected_area": found.contact_area_corrected})


def speed(case: dict, heights: np.ndarray, program: str, setting: str, budget: float) -> dict:
    """Processor time until the error of the pressure is `ENOUGH`."""
    with contextlib.nullcontext() if program == "pgfmd" else love():
        known = ours(heights, case["load"], 1e-14).pressure
    row: dict = {}
    if program in WATCHED:
        spent = [0.0]

        def watch(field, _, scale) -> None:
            now = time.process_time()
            row["pressure_error"] = error_of(field * scale, known)
            spent[0] += time.process_time() - now
            if row["pressure_error"] <= ENOUGH or now - began - spent[0] > budget:
                raise EnoughError

        began = time.process_time()
        _, row["work"] = WATCHED[program](heights, case["load"], 1e-14, SQUARE, watch)
        return row | {"cpu": time.process_time() - began - spent[0]}
    for tolerance in (10.0 ** (-0.5 * k) for k in range(4 if program == "pgfmd" else 10, 24)):
        began = time.process_time()
        if program == "pgfmd":
            solution = ours(heights, case["load"], tolerance)
            pressure, work = solution.pressure, solution.transforms
        else:
            pressure, work = aspher(heights, case["load"], tolerance, setting)
        row = {"cpu": time.process_time() - began, "work": work, "pressure_error": error_of(pressure, known)}
        if row["pressure_error"] <= ENOUGH or row["cpu"] > budget:
            break
    return row


PARTS = {"equal": equal, "slip": slip, "area": area, "speed": speed}
PROGRAMS = {"equal": ["ASPHER", *WATCHED], "slip": ["pgfmd", "ASPHER"], "area": ["pgfmd", "Love"]}
PROGRAMS["speed"] = ["pgfmd", *PROGRAMS["equal"]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--n", type=int, nargs="+", default=[512])
    parser.add_argument("--surfaces", nargs="+", default=["rough:.8:=16"])
    parser.add_argument("--area", type=float, nargs="+", default=[0.02], help="contact areas of rough surfaces, about")
    parser.add_argument("--programs", nargs="+", help="all of the part by default; Love: ours, peers' coefficients")
    parser.add_argument("--settings", nargs="+", default=["fft auto float"], help="of ASPHER: backend engine precision")
    parser.add_argument("--budget", type=float, default=600.0, help="seconds of processor time of one solution")
    parser.add_argument("--csv", type=Path, default=Path(__file__).parents[2] / "jobs" / "benchmark" / "open.csv")
    options = parser.parse_args()
    keys = COLUMNS[:6]
    old = [tuple(row[key] for key in keys) for row in csv_rows.read(options.csv)]
    for surface in options.surfaces:
        for wanted in options.area if surface.split(":")[0] in ("rough", "tip") else [0.0]:
            for n in options.n:
                heights = None
                for program in options.programs or PROGRAMS[options.part]:
                    for setting in options.settings if (options.part, program) == ("speed", "ASPHER") else [""]:
                        case = {"part": options.part, "n": n, "surface": surface, "load": load_of(surface, wanted)}
                        case |= {"program": program, "setting": setting}
                        if tuple(csv_rows.shown(case[key], 7) for key in keys) in old:
                            continue
                        heights = heights_of(surface, n) if heights is None else heights
                        if options.part == "speed":
                            small = heights_of(surface, 128)
                            speed(case, small, program, setting, 60.0)  # loads libraries and compiled loops
                            row = speed(case, heights, program, setting, options.budget)
                        else:
                            row = PARTS[options.part](case, heights, program)
                        row = case | row
                        csv_rows.append(options.csv, COLUMNS, [row], digits=7)
                        print(*(f"{name}={csv_rows.shown(value, 7)}" for name, value in row.items()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The reference set from its runs: a table with errors, a check of these on finer grids, and what decides the area.

    python tools/bench/reference_table.py RUNS --output FOLDER      # RUNS: the folder of jobs/reference.sh

Writes into FOLDER:

    reference.csv   one row per kind of surface and load: means over surfaces, their error by solver and grid, and the
                    standard error of the mean
    reference.json  what each column is, and the checksum of the table
    reference.html  the curves, for a browser
    fine.csv        each number that was solved again on the finer grid, beside its stated error
    decision.csv    κ at low load against Nayak's parameter and H

Runs that are not complete are left out.
"""

import argparse
import hashlib
import json
import math
import re
import sys
from collections import defaultdict
from pathlib import Path

import csv_rows
import numpy as np
from scipy import stats

from pgfmd.application.results import Results
from pgfmd.theory.surface import SelfAffineSpectrum

SLOPE, SHORTEST = 0.1, 8.0
"""g, and λ_s in grid spacings, of jobs/reference.toml."""
NAME = re.compile(r"h(?P<hurst>[\d.]+)-l(?P<rolloff>\d+)-r(?P<scales>\d+)-s(?P<seed>\d+)(?P<fine>-fine)?")
SURFACE = ("hurst", "rolloff", "scales")
NUMBERS = ("area", "kappa", "gap", "energy", "square_pressure")
MEANING = {
    "hurst": "H of the surface", "rolloff": "λ_l/λ_r, with λ_l the side of the cell", "scales": "λ_r/λ_s",
    "nayak": "Nayak's parameter α = m₀m₄/m₂² of the ideal surface", "seeds": "number of surfaces",
    "pressure": "p̄/(E'g), g the rms slope", "area": "relative contact area inside the contact line",
    "kappa": "area/pressure", "gap": "mean gap over g λ_l", "energy": "elastic energy per area over E'g²λ_l",
    "square_pressure": "⟨p²⟩ over (E'g)²",
    "certified": "largest certified energy error of the solutions, over 2 E_el",
    "_error": "error by grid and solver, the mean of the estimates of the surfaces",
    "_scatter": "standard error of the mean over the surfaces",
}  # fmt: skip


def numbers(results: Results, index: int) -> dict[str, float]:
    """The numbers of a load and their errors by grid and solver, without units."""
    row, groups = results.load(index).numbers, results.load(index)["discretisation"]
    length = results.lengths[0]
    square = {"": "mean_square_pressure", "_error": "mean_square_pressure_error"}
    pressure = row["mean_pressure"] / SLOPE
    found = {"pressure": pressure, "certified": row["certified_error"]}
    for end in ("", "_error"):
        found |= {
            f"area{end}": row[f"contact_area_corrected{end}"],
            f"kappa{end}": row[f"contact_area_corrected{end}"] / pressure,
            f"gap{end}": row[f"mean_gap{end}"] / (SLOPE * length),
            f"energy{end}": row[f"elastic_energy{end}"] / (SLOPE**2 * length),
            f"square_pressure{end}": float(groups[square[end]]) / SLOPE**2,
        }
    return found


def read(folder: Path) -> dict[tuple, dict[str, list[dict[str, float]]]]:
    """(surface, load) → "runs" and "fine": the numbers of each seed."""
    found: dict[tuple, dict[str, list]] = defaultdict(lambda: {"runs": [], "fine": []})
    for path in sorted(folder.iterdir()):
        match = NAME.fullmatch(path.name)
        if not match or not (path / "observables.h5").is_file() or Results(path).status != "complete":
            continue
        results = Results(path)
        surface = (float(match["hurst"]), int(match["rolloff"]), int(match["scales"]))
        for index in range(len(results)):
            kind = "fine" if match["fine"] else "runs"
            found[surface + (index,)][kind].append(numbers(results, index) | {"seed": int(match["seed"])})
    return found


def nayak(hurst: float, rolloff: int, scales: int) -> float:
    """α of the ideal surface."""
    longest = SHORTEST * scales * rolloff
    return SelfAffineSpectrum(hurst, SHORTEST, longest, SLOPE, SHORTEST * scales).moments().alpha


def table(found: dict) -> list[dict[str, float]]:
    """One row per surface and load."""
    rows = []
    for key, kinds in sorted(found.items()):
        runs = kinds["runs"]
        if not runs:
            continue
        row = dict(zip(SURFACE, key, strict=False)) | {"nayak": nayak(*key[:3]), "seeds": len(runs)}
        row["pressure"] = runs[0]["pressure"]
        for name in NUMBERS:
            values = [run[name] for run in runs]
            row[name] = float(np.mean(values))
            row[f"{name}_error"] = float(np.mean([run[f"{name}_error"] for run in runs]))
            row[f"{name}_scatter"] = float(stats.sem(values)) if len(values) > 1 else math.nan
        rows.append(row | {"certified": max(run["certified"] for run in runs)})
    return rows


def check(found: dict) -> list[dict[str, float]]:
    """Each number that was solved again on the finer grid: difference and stated error."""
    rows = []
    for key, kinds in sorted(found.items()):
        coarse = {run["seed"]: run for run in kinds["runs"]}
        for fine in kinds["fine"]:
            run = coarse.get(fine["seed"])
            for name in NUMBERS if run else ():
                row = dict(zip(SURFACE, key, strict=False)) | {"pressure": run["pressure"], "number": name}
                row |= {"value": run[name], "difference": fine[name] - run[name], "error": run[f"{name}_error"]}
                rows.append(row)
    return rows


def decision(rows: list[dict[str, float]]) -> list[dict[str, float]]:
    """κ of surfaces with λ_l ≥ 4 λ_r, at areas from .005 to .03, fitted by c₀ + c₁ ln α + c₂ H + c₃ ln(p̄/E'g):
    the coefficients with 95 % intervals, which take in the scatter of the surfaces.
    """
    low = [row for row in rows if 0.005 < row["area"] < 0.03 and row["rolloff"] > 1]
    if len(low) < 8:
        return []
    design = np.array([[1, math.log(row["nayak"]), row["hurst"], math.log(row["pressure"])] for row in low])
    weights = 1 / np.array([math.hypot(row["kappa_scatter"], row["kappa_error"]) for row in low])
    matrix, target = design * weights[:, None], np.array([row["kappa"] for row in low]) * weights
    fit, *_ = np.linalg.lstsq(matrix, target, rcond=None)
    left = max(1.0, float(np.sum((target - matrix @ fit) ** 2)) / (len(low) - 4))  # χ² per degree of freedom
    errors = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)) * left)
    student = float(stats.t.ppf(0.975, len(low) - 4))
    names = ("at α = 1, H = 0, p̄ = E'g", "d κ/d ln α at fixed H", "d κ/d H at fixed α", "d κ/d ln p̄")
    return [{"quantity": name, "value": float(value), "interval": float(student * error), "rows": len(low)}
            for name, value, error in zip(names, fit, errors, strict=True)]  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """The command line; 0, or 2 if there are no runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, metavar="RUNS")
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER")
    options = parser.parse_args(arguments)
    found = read(options.runs) if options.runs.is_dir() else {}
    rows = table(found)
    if not rows:
        print(f"reference_table.py: error: {options.runs}: no complete runs of jobs/reference.sh", file=sys.stderr)
        return 2
    options.output.mkdir(parents=True, exist_ok=True)
    csv_rows.write(options.output / "reference.csv", rows, digits=6)
    digest = hashlib.sha256((options.output / "reference.csv").read_bytes()).hexdigest()
    about = {"columns": MEANING, "sha256": digest, "slope": SLOPE, "lambda_s": SHORTEST}
    text = json.dumps(about, ensure_ascii=False, indent=1) + "\n"
    (options.output / "reference.json").write_text(text, encoding="utf-8")
    page = Path(__file__).with_name("reference_table.html").read_text(encoding="utf-8")
    entries = json.dumps([{key: None if value != value else value for key, value in row.items()} for row in rows])
    (options.output / "reference.html").write_text(page.replace("/*ROWS*/[]", entries), encoding="utf-8")
    checked = check(found)
    csv_rows.write(options.output / "fine.csv", checked, digits=6)
    for name in NUMBERS:
        largest = max(row[f"{name}_error"] / abs(row[name]) for row in rows)
        both = [row for row in checked if row["number"] == name]
        held = np.mean([abs(row["difference"]) <= row["error"] for row in both]) if both else math.nan
        print(f"{name}: stated error at most {largest:.2%}; it held in {held:.0%} of {len(both)} finer solutions")
    decided = decision(rows)
    csv_rows.write(options.output / "decision.csv", decided, digits=6)
    for row in decided:
        print(f"κ: {row['quantity']}: {row['value']:.3f} ± {row['interval']:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

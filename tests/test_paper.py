"""The numbers of the figures, computed anew from their CSVs.

Shares no code with the tools: files are read with the csv module, fits are NumPy's.  Figures are drawn from small runs.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.breadth
JOB = """
[grid]
n = 128
[surface]
kind = "self-affine"
hurst = 0.5
lambda_s = 4.0
rms_slope = 0.031
seed = {seed}
[wall]
{wall}
[solid]
lame_lambda = 1
lame_mu = 1
[load]
pressure = [0.003, 0.02]
[output]
fields = ["height"]
observables = ["histogram", "spectra", "acf", "patches", "bearing"]
"""
WALLS = {"hard": 'kind = "hard"', "soft": 'kind = "exponential"\nzeta = 0.25'}
CALLS = {
    "area_load": ("hard", ["--area", "0.2"]),
    "exponents": ("hard", ["--window", "2", "12"]),
    "bearing_area": ("hard", ["--window", "2", "12"]),
    "autocorrelations": ("hard", []),
    "stress_contact_spectra": ("hard", []),
    "pressure_distribution": ("hard", []),
    "contact_patches": ("hard", ["--smallest", "4"]),
    "persson_spectrum": ("hard", []),
    "field_theory": ("soft", []),
    "dependence": ("hard", ["--of", "q_star", "m2", "bearing_tail", "--on", "contact_area", "--level", "1.3"]),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Every figure of three surfaces under a hard wall, two under an exponential one."""
    from mpi4py import MPI

    from pgfmd.application import job
    from pgfmd.application.simulate import simulate

    root = tmp_path_factory.mktemp("paper")
    runs = defaultdict(list)
    for wall, seeds in (("hard", (1, 2, 3)), ("soft", (1, 2))):
        for seed in seeds:
            path = root / f"{wall}-{seed}"
            simulate(job.parse(JOB.format(seed=seed, wall=WALLS[wall])), MPI.COMM_SELF, path)
            runs[wall].append(str(path))
    calls = [[figure, *runs[wall], *options, "--output", str(root)] for figure, (wall, options) in CALLS.items()]
    script = f"import sys\nsys.path.insert(0, {str(ROOT / 'tools' / 'plots')!r})\nimport figures\n"
    script += f"for words in {calls!r}:\n    assert figures.main(words) == 0, words\n"
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, timeout=900)
    return root


def table(folder: Path, name: str) -> list[dict]:
    """Rows of a CSV, numbers as floats where they are."""
    with open(folder / f"{name}.csv", encoding="utf-8") as file:
        return [{key: number(value) for key, value in row.items()} for row in csv.DictReader(file)]


def number(text: str):
    """A float if it is one; NaN for nothing."""
    try:
        return float(text) if text else float("nan")
    except ValueError:
        return text


def found(folder: Path, figure: str) -> dict:
    """Numbers that the figure found."""
    return json.loads((folder / f"{figure}.json").read_text(encoding="utf-8"))["numbers"]


def split(rows: list[dict], *keys: str) -> dict[tuple, dict[str, np.ndarray]]:
    """Rows by the values of keys, as columns."""
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row[key] for key in keys)].append(row)
    return {key: {name: np.array([row[name] for row in group]) for name in group[0]} for key, group in groups.items()}


def same(finding: dict, values) -> None:
    """Mean and standard error of the values are those of the finding; 1e-6 is asked for, ten digits are in the CSV."""
    values = np.atleast_1d(values)
    assert finding["value"] == pytest.approx(np.mean(values), rel=1e-6, abs=1e-9)
    if len(values) > 1:
        assert finding["seeds"] == pytest.approx(np.std(values, ddof=1) / np.sqrt(len(values)), rel=1e-5, abs=1e-9)


def slopes(x, columns) -> float:
    """One slope for several columns in logarithms, each with an offset of its own: a linear system."""
    design = np.zeros((len(columns) * len(x), len(columns) + 1))
    for index in range(len(columns)):
        design[index * len(x) : (index + 1) * len(x), 0] = np.log(x)
        design[index * len(x) : (index + 1) * len(x), index + 1] = 1
    return np.linalg.lstsq(design, np.log(np.concatenate(columns)), rcond=None)[0][0]


def test_kappa(folder):
    """κ = f_c E' g/p̄ of each surface, between its two loads linearly in ln f_c, and its mean and error."""
    values = defaultdict(list)
    for run in split(table(folder, "area_load_loads"), "seed").values():
        for kind in ("area", "area_corrected"):
            kappa = run[kind] * run["modulus"] * run["rms_slope"] / run["mean_pressure"]
            share = (np.log(0.2) - np.log(run[kind][0])) / np.log(run[kind][1] / run[kind][0])
            values[kind].append(kappa[0] + share * (kappa[1] - kappa[0]))
    same(found(folder, "area_load")["κ at f_c = 0.2, raw, simulation"], values["area"])
    same(found(folder, "area_load")["κ at f_c = 0.2, corrected, simulation"], values["area_corrected"])


def test_moments_and_widths(folder):
    """m₂, κ and the fitted width of each load, over the seeds."""
    for (setting,), loads in split(table(folder, "pressure_distribution_loads"), "setting").items():
        numbers = found(folder, "pressure_distribution")
        same(numbers[f"m₂ = ⟨σ²⟩_c/σ_c², {setting}"], loads["m2"])
        factor = loads["modulus"] * loads["rms_slope"]
        same(numbers[f"κ, raw area, {setting}"], loads["area"] * factor / loads["mean_pressure"])
        same(numbers[f"fitted width over E'g/2, {setting}"], 2 * loads["fitted_width"] / factor)


def test_exponents(folder):
    """Joint and separate exponents of each surface by a linear system, and the spread over the five fit ranges."""
    low, high = 2, 12
    ranges = [(low, high), (low / 2, high / 2), (2 * low, 2 * high), (2 * low, high), (low, high / 2)]
    results = defaultdict(list)
    for limits in ranges:
        for run in {row["run"] for row in table(folder, "exponents_data")}:
            columns = defaultdict(list)
            for (_, _), load in split(
                [r for r in table(folder, "exponents_data") if r["run"] == run], "load", "run"
            ).items():
                inside = (load["q_over_q_l"] >= limits[0]) & (load["q_over_q_l"] <= limits[1])
                for kind in ("stress", "contact"):
                    columns[kind].append(load[kind][inside])
                x = load["q_over_q_l"][inside]
            results["joint", limits].append(-slopes(x, columns["stress"] + columns["contact"]))
            results["contact", limits].append(-slopes(x, columns["contact"]))
            difference = slopes(x, columns["stress"]) - slopes(x, columns["contact"])
            results["scaled difference", limits].append(difference * np.log(limits[1] / limits[0]))
    names = {"joint": "μ joint", "contact": "μ contact", "scaled difference": "(μ_c − μ_σ) ln(window)"}
    for kind, name in names.items():
        finding = found(folder, "exponents")[f"{name}, simulation"]
        same(finding, results[kind, ranges[0]])
        middle = np.mean(results[kind, ranges[0]])
        spread = max(abs(np.mean(results[kind, limits]) - middle) for limits in ranges[1:])
        assert finding["choices"] == pytest.approx(spread, rel=1e-6)


def test_local_exponents(folder):
    """The joint exponent of each octave, of each surface."""
    rows = table(folder, "exponents_data")
    for low in (2, 4, 8):
        values = []
        for run in sorted({row["run"] for row in rows}):
            loads = split([r for r in rows if r["run"] == run and low <= r["q_over_q_l"] <= 2 * low], "load").values()
            x = next(iter(loads))["q_over_q_l"]
            values.append(-slopes(x, [load[kind] for load in loads for kind in ("stress", "contact")]))
        same(found(folder, "exponents")[f"local μ joint, {low} … {2 * low} q_l, simulation"], values)


def test_bearing_exponents(folder):
    """μ_c of elastic contact and of the bearing area."""
    title = {"contact": "elastic contact", "bearing": "bearing area"}
    values = defaultdict(list)
    for (setting, kind, _), run in split(table(folder, "bearing_area_data"), "setting", "kind", "seed").items():
        inside = (run["q_over_q_l"] >= 2) & (run["q_over_q_l"] <= 12)
        values[f"μ_c {title[kind]}, {setting}"].append(-slopes(run["q_over_q_l"][inside], [run["spectrum"][inside]]))
    assert len(values) == 4
    for name, each in values.items():
        same(found(folder, "bearing_area")[name], each)


def test_bounds_of_the_correlations(folder):
    """Smallest and largest C_σ/(σ_c² C_c), m₂, and the ratio at λ_s by linear interpolation."""
    values = defaultdict(list)
    for run in split(table(folder, "autocorrelations_data"), "seed").values():
        ratio = run["stress"] / run["contact"]
        values["smallest ratio"].append(ratio.min())
        values["largest ratio over m₂"].append(ratio.max() / ratio[0])
        after = int(np.argmax(run["r_over_lambda_s"] > 1))
        near, far = run["r_over_lambda_s"][after - 1 : after + 1]
        at = ratio[after - 1] + (1 - near) / (far - near) * (ratio[after] - ratio[after - 1])
        values["C_σ/(σ_c² C_c) at 1 λ_s"].append(at)
    for name, each in values.items():
        same(found(folder, "autocorrelations")[name], each)


def test_spectral_ratio(folder):
    """Ratio of the sums over modes at the longest waves, of each surface."""
    for (setting,), rows in split(table(folder, "stress_contact_spectra_data"), "setting").items():
        values = []
        for seed in np.unique(rows["seed"]):
            part = (rows["seed"] == seed) & (rows["q_over_q_l"] < 8.5)
            values.append(np.dot(rows["modes"], part * rows["stress"]) / np.dot(rows["modes"], part * rows["contact"]))
        same(found(folder, "stress_contact_spectra")[f"ratio at the longest waves (q ≤ 8 q_l), {setting}"], values)


def test_bands_of_field_theory(folder):
    """Σ stress/Σ theory over the modes of each band, of each surface."""
    for (setting,), rows in split(table(folder, "field_theory_data"), "setting").items():
        for low, high in ((1, 1), (2, 3), (4, 7), (8, 15)):
            values = []
            for seed in np.unique(rows["seed"]):
                part = (
                    (rows["seed"] == seed)
                    & (np.round(rows["q_over_q_l"]) >= low)
                    & (np.round(rows["q_over_q_l"]) <= high)
                )
                weight = rows["modes"] * part
                values.append(np.dot(weight, rows["stress"]) / np.dot(weight, rows["field_theory"]))
            same(found(folder, "field_theory")[f"ratio to field theory, {setting}, k = {low}–{high}"], values)


def test_ratio_to_full_contact(folder):
    """Σ stress/Σ full contact over the modes from 4 q_l to q_s/2 (16 q_l here: λ_s = 4 a of 128)."""
    for (setting,), rows in split(table(folder, "persson_spectrum_data"), "setting").items():
        values = []
        for seed in np.unique(rows["seed"]):
            part = (rows["seed"] == seed) & (rows["q_over_q_l"] >= 4) & (rows["q_over_q_l"] <= 16)
            weight = rows["modes"] * part
            values.append(np.dot(weight, rows["stress"]) / np.dot(weight, rows["full_contact"]))
        same(found(folder, "persson_spectrum")[f"ratio to full contact, {setting}"], values)


def test_ratio_to_f(folder):
    """Geometric mean over bins of stress/(full contact · f), from 4 q_l to q_s/2 (16 q_l), of each surface."""
    for (setting,), rows in split(table(folder, "persson_spectrum_data"), "setting").items():
        ratios = []
        for seed in np.unique(rows["seed"]):
            part = (rows["seed"] == seed) & (rows["q_over_q_l"] >= 4) & (rows["q_over_q_l"] <= 16)
            ratio = rows["stress"] / rows["full_contact"] / rows["f_persson"]
            ratios.append(np.exp(np.mean(np.log(ratio[part]))))
        same(found(folder, "persson_spectrum")[f"ratio/f_Persson, {setting}"], ratios)


def test_where_full_contact_ends(folder):
    """q* of each surface and load, by linear interpolation in ln q; m₂ as another figure has it."""
    kept = split(table(folder, "dependence_data"), "of", "setting", "seed")
    for (setting, seed), run in split(table(folder, "persson_spectrum_data"), "setting", "seed").items():
        x, ratio = run["q_over_q_l"], run["stress"] / run["full_contact"]
        first = int(np.argmax(ratio < 0.9))
        around = slice(max(first - 1, 0), first + 1)
        place = np.exp(np.interp(-0.9, -ratio[around], np.log(x[around])))
        if np.any(ratio < 0.9):
            assert kept["q_star", setting, seed]["value"][0] == pytest.approx(place, rel=1e-6)
    for (setting,), loads in split(table(folder, "pressure_distribution_loads"), "setting").items():
        same(found(folder, "dependence")[f"m2, {setting}"], loads["m2"])
    assert {key[0] for key in kept} == {"q_star", "m2", "bearing_tail"}


def test_largest_spectral_ratio(folder):
    """Largest ratio in bins of 100 modes and more, and where it lies."""
    for (setting,), rows in split(table(folder, "stress_contact_spectra_data"), "setting").items():
        each = split([dict(zip(rows, values, strict=True)) for values in zip(*rows.values(), strict=True)], "seed")
        stress, contact = (np.array([seed[kind] for seed in each.values()]) for kind in ("stress", "contact"))
        first = next(iter(each.values()))
        ratio = stress.sum(axis=0) / contact.sum(axis=0)
        top = int(np.argmax(np.where(first["modes"] >= 100, ratio, 0)))
        numbers = found(folder, "stress_contact_spectra")
        same(numbers[f"largest ratio (bins of 100 modes and more), {setting}"], stress[:, top] / contact[:, top])
        same(numbers[f"q/q_l of the largest ratio, {setting}"], first["q_over_q_l"][top])


def test_patch_law(folder):
    """τ = 1 + n/Σ ln(a/a_min) of the patches from λ_s² on, and the exponent of the load from medians in bins."""
    rows = [row for row in table(folder, "contact_patches_data") if row["kind"] == "elastic"]
    area, load = (np.array([row[name] for row in rows]) for name in ("area", "load"))
    large = area >= 1 - 1e-9
    tau = 1 + np.count_nonzero(large) / np.log(area[large]).sum()
    same(found(folder, "contact_patches")["τ of large patches (from λ_s²), elastic"], tau)
    sizes, medians = [], []
    for decade in np.unique(np.floor(6 * np.log10(area[large]) + 1e-9)):
        chosen = large & (np.floor(6 * np.log10(area) + 1e-9) == decade)
        if np.count_nonzero(chosen) >= 5:
            sizes.append(np.median(area[chosen]))
            medians.append(np.median(load[chosen]))
    slope = np.polyfit(np.log(sizes), np.log(medians), 1)[0]
    same(found(folder, "contact_patches")["slope of large patches (from λ_s²)"], slope)

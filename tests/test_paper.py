"""The numbers of the figures, computed anew from their tables: of small runs, and of the committed report with all
of its claims and results.

Shares no code with the tools: files are read with the csv module, fits are NumPy's.
"""

import csv
import json
import math
import re
import tomllib
from collections import defaultdict
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, python
from job_texts import rough_job

import pgfmd
from pgfmd.application.job import parse

RESULTS = ROOT / "jobs" / "paper" / "results"
pytestmark = pytest.mark.breadth
ROUGH, KEPT = {"hurst": 0.5, "lambda_s": 4.0, "rms_slope": 0.031}, ["histogram", "spectra", "acf", "patches", "bearing"]
JOB = {"load": {"pressure": [0.003, 0.02]}, "output": {"fields": ["height"], "observables": KEPT}}
WALLS = {"hard": {"kind": "hard"}, "soft": {"kind": "exponential", "zeta": 0.25}}
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
# Numbers of which the tables do not hold what they are computed from: histograms of the pressure, sums over the bins of
# a run, contact areas of the loads, Persson's f(q) under an exponential wall; and a test by random samples.
ELSEWHERE = r"P (over|in the first)|sum rule|contact area|ratio to Persson|goodness"
CELL = {"T1l": 2048, "LT": 8192, "L4": 8192, "L4w": 8192, "F67": 4096, "LF": 2048}  # λ_l where settings do not say it
SHORTEST = {"F67": 8, "LF": 8, "L4b": 32}  # λ_s, where they do not


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Every figure of three surfaces under a hard wall, two under an exponential one."""
    root = tmp_path_factory.mktemp("paper")
    runs = defaultdict(list)
    for wall, seeds in (("hard", (1, 2, 3)), ("soft", (1, 2))):
        for seed in seeds:
            path = root / f"{wall}-{seed}"
            pgfmd.run(parse(rough_job(128, ROUGH | {"seed": seed}, wall=WALLS[wall], **JOB)), path)
            runs[wall].append(str(path))
    calls = [[figure, *runs[wall], *options, "--output", str(root)] for figure, (wall, options) in CALLS.items()]
    script = f"import sys\nsys.path.insert(0, {str(ROOT / 'tools' / 'plots')!r})\nimport figures\n"
    script += f"for words in {calls!r}:\n    assert figures.main(words) == 0, words\n"
    done = python(script)
    assert done.returncode == 0, done.stderr
    return root


class Figure:
    """The tables of one figure, and what it found."""

    def __init__(self, folder: Path, picture: str, tool: str, options: dict, key: str = ""):
        self.folder, self.picture, self.tool, self.options, self.key = folder, picture, tool, options, key
        self.found = json.loads((folder / f"{picture}.json").read_text(encoding="utf-8"))["numbers"]

    @cache  # noqa: B019
    def table(self, name: str, *keys: str) -> dict[tuple, dict[str, np.ndarray]]:
        """Rows of a table by the values of keys, as columns."""
        groups = defaultdict(list)
        with open(self.folder / f"{self.picture}_{name}.csv", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                groups[tuple(row[key] for key in keys)].append({name: number(text) for name, text in row.items()})
        return {key: {each: np.array([row[each] for row in rows]) for each in rows[0]} for key, rows in groups.items()}

    def of_setting(self, name: str, table: str, *keys: str) -> tuple[str, str, dict[tuple, dict[str, np.ndarray]]]:
        """The name of a number without its setting, the setting, and its rows of a table by the values of keys."""
        data = self.table(table, "setting", *keys)
        settings = [key[0] for key in data]
        setting = next((each for each in settings if name.endswith(f", {each}")), settings[0])
        mine = {key[1:]: rows for key, rows in data.items() if key[0] == setting}
        return name.removesuffix(f", {setting}"), setting, mine

    def window(self, setting: str) -> tuple[float, float]:
        """The fit range in q/q_l: from 8 to q_s/16, to q_s/2 where that leaves less than a factor of 4."""
        if "window" in self.options:
            return tuple(self.options["window"])
        said = dict(part.split(" = ") for part in setting.split(", ") if " = " in part)
        top = float(said.get("n", CELL.get(self.key, 2048))) / float(said.get("λ_s", SHORTEST.get(self.key, 1)))
        return (8.0, top / 16) if top / 16 >= 32 else (min(8.0, top / 16), top / 2)

    def computed(self, name: str):
        """The number anew: values of the seeds, or a pair of value and error; None if the tables do not hold it."""
        return HANDLERS[self.tool](self, name)

    def check(self, name: str):
        """The number, and its error over seeds, are those that the tables give."""
        values, known = self.computed(name), self.found[name]
        if isinstance(values, tuple):
            value, error = values
        else:
            values = np.atleast_1d(values)
            values = values[np.isfinite(values)]
            value, error = np.mean(values), np.std(values, ddof=1) / math.sqrt(len(values)) if len(values) > 1 else None
        assert known["value"] == pytest.approx(value, rel=1e-6, abs=1e-8), (self.picture, name)
        if error is not None:
            assert known["seeds"] == pytest.approx(error, rel=1e-5, abs=1e-8), (self.picture, name)


def number(text: str):
    """A float if it is one; NaN for nothing."""
    try:
        return float(text) if text else float("nan")
    except ValueError:
        return text


def slopes(x, columns) -> float:
    """One slope for several columns in logarithms, each with an offset of its own: a linear system."""
    design = np.zeros((len(columns) * len(x), len(columns) + 1))
    for index in range(len(columns)):
        design[index * len(x) : (index + 1) * len(x), 0] = np.log(x)
        design[index * len(x) : (index + 1) * len(x), index + 1] = 1
    return np.linalg.lstsq(design, np.log(np.concatenate(columns)), rcond=None)[0][0]


def inside(x, low: float, high: float) -> np.ndarray:
    """Mask of the x in a range, its ends included."""
    return (x >= low * (1 - 1e-9)) & (x <= high * (1 + 1e-9))


def left_out(samples: list, estimate) -> tuple[float, float | None]:
    """An estimate of all samples, and its error by leaving one out at a time."""
    rest = np.array([estimate(samples[:i] + samples[i + 1 :]) for i in range(len(samples))]) if len(samples) > 1 else []
    rest = np.array([each for each in rest if math.isfinite(each)])
    error = math.sqrt((len(rest) - 1) / len(rest) * np.sum((rest - rest.mean()) ** 2)) if len(rest) > 1 else None
    return estimate(samples), error


def falls_below(x, y, level: float) -> float:
    """Where y falls below the level for the first time, between points linearly in ln x."""
    if not np.any(y < level):
        return float("nan")
    first = int(np.argmax(y < level))
    if first == 0:
        return x[0]
    return np.exp(np.interp(-level, [-y[first - 1], -y[first]], np.log([x[first - 1], x[first]])))


def area_load(figure: Figure, name: str):
    """κ = f_c E' g/p̄ of each surface, between its loads linearly in ln f_c, and the way to BGT's."""
    kind, _, runs = figure.of_setting(name, "loads", "seed")
    values = []
    for run in runs.values():
        area = run["area" if "raw" in kind else "area_corrected"][np.argsort(run["mean_pressure"])]
        kappa = area * (run["modulus"] * run["rms_slope"] / run["mean_pressure"])[np.argsort(run["mean_pressure"])]
        at = re.search(r"f_c = ([0-9.]+)", kind)
        known = at is None or 0.9 * area[0] <= float(at[1]) <= 1.1 * area[-1]
        values.append(np.interp(math.log(float(at[1])), np.log(area), kappa) if at and known else
                      kappa[0] if known else np.nan)  # fmt: skip
    low, high = math.sqrt(8 / math.pi), math.sqrt(2 * math.pi)
    return (np.array(values) - low) / (high - low) if kind.startswith("way") else values


def pressure_distribution(figure: Figure, name: str):
    """Moments, κ and the fitted width of each load; those of two Gaussians by quadrature."""
    kind, _, tables = figure.of_setting(name, "loads")
    (loads,) = tables.values()
    std, load = loads["modulus"] * loads["rms_slope"] / 2, loads["mean_pressure"]
    if "Persson" in kind:
        sigma = np.linspace(0, 12, 200_001)[:, None] * std
        density = (np.exp(-((sigma - load) ** 2) / 2 / std**2) - np.exp(-((sigma + load) ** 2) / 2 / std**2)) / std
        area, _, square = (np.trapezoid(density * sigma**k, sigma, axis=0) / math.sqrt(2 * math.pi) for k in (0, 1, 2))
        return square / area / (load / area) ** 2 if kind.startswith("m₂") else area * 2 * std / load
    return {
        "m₂ = ⟨σ²⟩_c/σ_c²": loads["m2"],
        "κ, raw area": loads["area"] * 2 * std / load,
        "κ, corrected area": loads["area_corrected"] * 2 * std / load,
        "fitted width over E'g/2": loads["fitted_width"] / std,
    }[kind]


def exponents(figure: Figure, name: str):
    """Joint and separate exponents of each surface by a linear system; ratios of two loads in octaves."""
    kind, setting, data = figure.of_setting(name, "data", "run", "load")
    runs = defaultdict(dict)
    for (run, load), columns in data.items():
        runs[run][float(load)] = columns
    low, high = figure.window(setting)
    if octave := re.search(r"local μ joint, ([0-9]+)", kind):
        low, high = float(octave[1]), 2 * float(octave[1])
    loads = sorted(next(iter(runs.values())))
    if "farthest octave" in kind:
        which = kind.split()[0]
        above, below = (np.array([run[load][which] for run in runs.values()]) for load in (loads[-1], loads[0]))
        x = next(iter(runs.values()))[loads[0]]["q_over_q_l"]
        octave = np.floor(np.log2(x) + 1e-9)
        weight = 1 / below.mean(axis=0)
        found = []
        for level in np.unique(octave[octave >= 2 if "q ≥ 4" in kind else octave < 2]):
            sums = [list(np.sum((each * weight)[:, octave == level], axis=1)) for each in (above, below)]
            found.append(left_out(list(zip(*sums, strict=True)), lambda pairs: np.divide(*np.sum(pairs, axis=0))))
        return max(found, key=lambda pair: abs(math.log(pair[0])))

    def mu(run, *kinds):
        part = inside(run[loads[0]]["q_over_q_l"], low, high)
        chosen = loads[:1] if "smallest load" in kind else loads
        return -slopes(run[loads[0]]["q_over_q_l"][part], [run[load][each][part] for load in chosen for each in kinds])

    differ = [mu(run, "contact") - mu(run, "stress") for run in runs.values()]
    if "ln(window)" in kind:
        return np.array(differ) * math.log(high / low)
    if "difference" in kind:
        return differ
    kinds = [each for each in ("stress", "contact") if each in kind] or ["stress", "contact"]
    return [mu(run, *kinds) for run in runs.values()]


def bearing_area(figure: Figure, name: str):
    """μ_c of elastic contact and of the bearing area."""
    kind, setting, data = figure.of_setting(name, "data", "kind", "seed")
    if kind.startswith("theory"):
        return 2.5 if not figure.key else 2 + float(re.search("H = ([0-9.]+)", setting)[1])
    low, high = figure.window(setting)
    values = []
    for (which, _), run in data.items():
        if which == ("contact" if "elastic" in kind else "bearing"):
            part = inside(run["q_over_q_l"], low, high)
            values.append(-slopes(run["q_over_q_l"][part], [run["spectrum"][part]]))
    return values


def autocorrelations(figure: Figure, name: str):
    """C_σ/(σ_c² C_c) against its bounds; at a distance by linear interpolation."""
    values = []
    for run in figure.table("data", "seed").values():
        x, ratio, m2 = run["r_over_lambda_s"], run["stress"] / run["contact"], run["stress"][0] / run["contact"][0]
        near = x <= 1 / 8 * (1 + 1e-9)
        at = re.search(r"at ([0-9.]+) λ_s", name)
        values.append(
            np.interp(float(at[1]), x, ratio) if at
            else run["contact"][0] if name == "C_σ(0)/⟨σ²⟩_c"
            else 0.0 if name.endswith("− 1")  # f_c is C_c(0): the table holds no other
            else (ratio[near] / (m2 if "m₂" in name else 2)).min() if name.startswith("share")
            else ratio[x <= 4].min() if name == "smallest ratio up to 4 λ_s"
            else ratio.min() if name == "smallest ratio"
            else ratio.max() / m2 if name == "largest ratio over m₂"
            else ratio.max() if name == "largest ratio"
            else x[np.flatnonzero(ratio > m2 * (1 + 1e-9))[-1]] if np.any(ratio > m2 * (1 + 1e-9)) and "Δr" in name
            else 0.0 if "Δr" in name else m2
        )  # fmt: skip
    return values


def stress_contact_spectra(figure: Figure, name: str):
    """Ratios of the spectra: of the sums over modes at the longest waves, of the shortest waves, and the largest."""
    kind, setting, data = figure.of_setting(name, "data", "seed")
    runs = list(data.values())
    stress, contact = (np.array([run[each] for run in runs]) for each in ("stress", "contact"))
    x, modes = runs[0]["q_over_q_l"], runs[0]["modes"]
    top = int(np.argmax(np.where(modes >= 100, stress.sum(axis=0) / contact.sum(axis=0), 0)))
    if kind.startswith("share"):
        m2 = figure.found[f"m₂, {setting}"]["values"] if "m₂" in kind else [2.0] * len(runs)
        return [np.sum((modes * s)[s / c > b]) / np.sum(modes * s) for s, c, b in zip(stress, contact, m2, strict=True)]
    long = x < 8.5
    return {
        "ratio at the longest waves (q ≤ 8 q_l)": stress @ (long * modes) / (contact @ (long * modes)),
        "ratio at the shortest waves": stress[:, -1] / contact[:, -1],
        "largest ratio (bins of 100 modes and more)": stress[:, top] / contact[:, top],
        "q/q_l of the largest ratio": x[top],
    }.get(kind)  # fmt: skip


def correlation_decay(figure: Figure, name: str):
    """ν of the mean over the seeds from 4 to 64 λ_s; less that of q^−(1+H) summed over the modes of this cell."""
    kind, setting, data = figure.of_setting(name, "data", "seed")
    runs = list(data.values())
    x = runs[0]["r_over_lambda_s"]
    part, hurst = inside(x, 4, 64), float(re.search("H = ([0-9.]+)", setting)[1])

    def nu(rows):
        return -slopes(x[part], [np.mean(rows, axis=0)[part]])

    value, error = left_out([run["decay"] for run in runs], nu)
    less = nu([law(2048, hurst, x)]) if "less" in kind else 0
    return value - less + (hurst if "+ H" in kind else 0), error


@cache
def waves(n: int) -> np.ndarray:
    """|q|/q_l of the modes of an n × n grid, half of them."""
    return np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.rfftfreq(n, 1 / n)[None, :])


def law(n: int, hurst: float, x: np.ndarray) -> np.ndarray:
    """The correlation of a spectrum q^−(1+H) on an n × n grid, averaged over rings of one pixel, at distances x."""
    q = waves(n)
    field = np.fft.irfft2(np.where(q > 0, np.maximum(q, 1e-9) ** -(1 + hurst), 0), (n, n))
    distance = np.hypot(*np.meshgrid(*(np.minimum(np.arange(n), n - np.arange(n)),) * 2, indexing="ij")).ravel()
    ring = np.round(distance).astype(int)
    count = np.bincount(ring)
    return np.interp(x, np.bincount(ring, distance) / count, np.bincount(ring, field.ravel()) / count)


def persson_spectrum(figure: Figure, name: str):
    """Ratios to full contact and to both f(q), slopes, and where full contact ends."""
    kind, _, data = figure.of_setting(name, "data", "seed")
    top = CELL[figure.key] / SHORTEST[figure.key] if figure.key else 32
    values = []
    for run in data.values():
        x, ratio = run["q_over_q_l"], run["stress"] / run["full_contact"]
        f = run["f_solved" if "solved" in kind else "f_persson"]
        middle, line = (x >= 4) & (x <= top / 2), f if "f_" in kind else ratio
        part = (x >= top / 16) & (x <= top / 2) if "large q" in kind else (x >= 4) & (x <= top / 4)
        values.append(
            np.abs(ratio - 1).max() if kind.startswith("largest")
            else -slopes(x[part], [1 / line[part]]) if kind.startswith("slope")
            else falls_below(x, line, 0.9) if kind.startswith("q*")
            else math.log(falls_below(x, ratio, 0.9)) if kind.startswith("ln")
            else np.dot(run["modes"], middle * run["stress"]) / np.dot(run["modes"], middle * run["full_contact"])
            if kind == "ratio to full contact" else np.exp(np.mean(np.log((ratio / f)[middle])))
        )  # fmt: skip
    return values


def field_theory(figure: Figure, name: str):
    """Sums over the modes of each band."""
    kind, setting, band = re.fullmatch(r"(.*?), (ζ = .*|simulation|p̄ = .*), k = (.*)", name).groups()
    low, high = map(float, band.split("–"))
    above, below = ("stress", "field_theory") if kind == "ratio to field theory" else ("field_theory", "full_contact")
    values = []
    for (mine, _), run in figure.table("data", "setting", "seed").items():
        if mine == setting:
            weight = run["modes"] * inside(np.round(run["q_over_q_l"]), low, high)
            values.append(np.dot(weight, run[above]) / np.dot(weight, run[below]))
    return values


def contact_patches(figure: Figure, name: str):
    """Laws of the patches of all surfaces, errors by leaving one surface out."""
    data = figure.table("data", "run", "kind")
    kind = "bearing" if name.endswith("bearing") else "elastic"
    samples = [np.array([run["area"], run["load"]]) for key, run in data.items() if key[1] == kind]
    pixels = {"F9": 16 / 64**2, "I3": 16, "I8": 16}.get(figure.key, 4 / 4**2)
    merged = np.concatenate(samples, axis=1)
    if name.startswith("patches"):
        return np.count_nonzero(merged[0] >= (0 if name == "patches" else pixels if "fits" in name else 1))
    if name.startswith("τ = "):
        return figure.found[name]["value"]
    low, high = (pixels, 0.3) if "small" in name else (max(1, pixels) if "large" in name else pixels, math.inf)
    if name.startswith("slope"):
        high = 0.1 if "small" in name else high

    if high < 2 * low:  # no range
        return None

    def estimate(parts):
        area, load = np.concatenate(parts, axis=1)
        part = (area >= low) & (area <= high)
        if name.startswith("mean pressure"):
            return load[area >= 1].sum() / area[area >= 1].sum()
        if name.startswith("τ"):
            return maximum_likelihood(area[part], low, high) if np.count_nonzero(part) >= 10 else math.nan
        x, y = medians(area[part], load[part])
        if not name.startswith("slope"):
            return meeting(np.log(x), np.log(y))
        return slopes(x, [y]) if len(x) >= 3 else math.nan

    return left_out(samples, estimate)


def maximum_likelihood(area: np.ndarray, low: float, high: float) -> float:
    """τ of a power law between two ends: without an upper one by its formula, else from the mean of ln a."""
    mean = np.log(area / low).mean()
    if math.isinf(high):
        return 1 + 1 / mean
    from scipy.optimize import brentq

    span = math.log(high / low)

    def excess(rate):
        return (1 / rate - span / math.expm1(rate * span) if abs(rate) > 1e-9 else span / 2) - mean

    return 1 + brentq(excess, -60, 60.1)


def medians(area: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Medians in bins, six to a decade, of five patches and more."""
    bins = np.floor(6 * np.log10(area) + 1e-9)
    chosen = [bins == each for each in np.unique(bins) if np.count_nonzero(bins == each) >= 5]
    return np.array([np.median(area[part]) for part in chosen]), np.array([np.median(load[part]) for part in chosen])


def meeting(x: np.ndarray, y: np.ndarray) -> float:
    """Where two lines meet that fit best: over 201 places from the third to the third-last point."""

    def misfit(knot):
        design = np.array([np.ones_like(x), x, np.abs(x - knot)]).T
        return np.linalg.lstsq(design, y, rcond=None)[1].sum()

    return math.exp(min(np.linspace(x[2], x[-3], 201), key=misfit)) if len(x) >= 7 else float("nan")


def dependence(figure: Figure, name: str):
    """Means over seeds of what the table holds; where a curve reaches a level, and its exponent over a range."""
    data = figure.table("data", "of", "setting")
    for (what, setting), rows in data.items():
        if name == f"{what}, {setting}":
            return rows["value"]
    on = [column for column in next(iter(data.values())) if column.startswith("mean ")][0].removeprefix("mean ")
    what = re.search(r"(?:where|of) (\S+) (?:reaches|against)", name)[1]
    curve = name.partition(", ")[2]
    runs = defaultdict(list)
    for (mine, _), rows in data.items():
        if mine == what and rows["curve"][0] in (curve, "" if not curve else curve) or mine == what and not curve:
            for seed, place, value in zip(rows["seed"], rows[on], rows["value"], strict=True):
                runs[seed].append((place, value))
    runs = [np.array(sorted(run)).T for run in runs.values()]
    if "reaches" in name:
        level = float(re.search(r"reaches ([0-9.]+)", name)[1])
        return [falls_below(x, y, level) if y[0] > level else falls_below(x, -y, -level) for x, y in runs]

    def exponent(chosen):
        x, y = np.mean(chosen, axis=0)
        part = inside(x, *figure.options["fit"])
        return slopes(x[part], [np.abs(y[part])])

    return left_out([run for run in runs if run.shape == runs[0].shape], exponent)


HANDLERS = {handler.__name__: handler for handler in (
    area_load, pressure_distribution, exponents, bearing_area, autocorrelations, stress_contact_spectra,
    correlation_decay, persson_spectrum, field_theory, contact_patches, dependence)}  # fmt: skip


@pytest.mark.parametrize("tool", CALLS)
def test_figures(folder, tool):
    """Every number of a figure of small runs."""
    options = {"window": (2, 12)} if "--window" in CALLS[tool][1] else {}
    figure = Figure(folder, tool, tool, options)
    names = [name for name in figure.found if not re.match(ELSEWHERE, name) and " upper" not in name]
    checked = [name for name in names if figure.computed(name) is not None]
    for name in checked:
        figure.check(name)
    assert len(checked) >= 2


def test_choices(folder):
    """The spread over the five fit ranges."""
    figure = Figure(folder, "exponents", "exponents", {})
    means = []
    for limits in ((2, 12), (1, 6), (4, 24), (4, 12), (2, 6)):
        figure.options["window"] = limits
        means.append(np.mean(figure.computed("μ joint, simulation")))
    spread = max(abs(each - means[0]) for each in means[1:])
    assert figure.found["μ joint, simulation"]["choices"] == pytest.approx(spread, rel=1e-6)


@pytest.fixture(scope="module")
def report() -> tuple[dict, dict[str, Figure]]:
    """The claims, and the committed figures that they refer to."""
    content = tomllib.loads((ROOT / "tools" / "paper" / "claims.toml").read_text(encoding="utf-8"))
    plan = {each["key"]: each for each in content["figure"]}
    return content, {key: Figure(RESULTS, f"{key}_{each['tool']}", each["tool"], each.get("options", {}), key)
                     for key, each in plan.items()}  # fmt: skip


def test_numbers_of_the_report(report):
    """Every number of the claims and of the results, of their limits too, is what the committed tables give."""
    content, figures = report
    parts = [part for each in (*content["claim"], *content["new"]) for part in each["parts"]]
    names = {part[key] for part in parts for key in ("finding", "over", "minus") if key in part}
    elsewhere = set()
    for name in sorted(names):
        key, _, number_of = name.partition(": ")
        if re.match(ELSEWHERE, number_of):
            elsewhere.add(name)
        else:
            figures[key].check(number_of)
    assert len(names) > 200 and len(elsewhere) <= 30, (len(names), sorted(elsewhere))


def test_table_of_the_report(report):
    """Each row of report.csv is the number itself, a quotient or a difference, with its error."""
    content, figures = report
    parts = [part for claim in content["claim"] for part in claim["parts"]]
    with open(RESULTS / "report.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(parts)
    for row, part in zip(rows, parts, strict=True):
        first = look_up(figures, part["finding"])
        other = look_up(figures, part.get("over", part.get("minus", "")))
        value, error = first["value"], first["seeds"]
        if other and part.get("paired"):
            values = np.subtract(first["values"], other["values"])
            value, error = values.mean(), values.std(ddof=1) / math.sqrt(len(values))
        elif other:
            value = value / other["value"] if "over" in part else value - other["value"]
            scales = (1 / other["value"], value / other["value"]) if "over" in part else (1, 1)
            error = math.hypot(first["seeds"] * scales[0], other["seeds"] * scales[1])
        assert float(row["measured"]) == pytest.approx(value, rel=1e-6, abs=1e-9), row
        if row["seeds"] and error is not None:
            assert float(row["seeds"]) == pytest.approx(error, rel=1e-6, abs=1e-9), row


def look_up(figures: dict[str, Figure], name: str) -> dict | None:
    """What a figure found, by the name "KEY: number"."""
    key, _, number_of = name.partition(": ")
    return figures[key].found[number_of] if key else None

"""The curves and the table of loads on the overview page.  No MPI."""

import math
import re
from collections.abc import Sequence

import numpy as np
from plotting import BLACK, BLUE, RED
from reading import Load

from pgfmd.observables.schema import LOADS, is_error
from pgfmd.options.text import printable
from pgfmd.theory import persson

NAMES = {"contact_area_corrected": "corrected", "kappa": "κ", "certified_error": "certified error"}
MOST_CURVES = 30  # loads whose distributions and spectra are shown
COLUMNS = ("target", "mean_pressure", "contact_area", "contact_area_corrected", "kappa", "mean_gap",
           "mean_plastic_depth", "displacement", "elastic_energy", "certified_error", "iterations", "transforms",
           "seconds")  # fmt: skip


def some(loads: Sequence[Load], most: int) -> list[Load]:
    """At most that many loads, evenly spread, the first and the last included."""
    places = np.unique(np.rint(np.linspace(0, len(loads) - 1, most)).astype(int)) if loads else []
    return [loads[place] for place in places]


FOLLOWING = {
    "Flow factors of the gap": {"flow_factor_x": "along x", "flow_factor_y": "along y"},
    "Stiffness of the interface": {"stiffness": "at fixed contact", "tangential_stiffness": "tangential"},
    "Conductance of the interface": {"conductance": "conductance"},
}  # charts of what follows from a contact: title, columns and their names

DIGITS = {"certified_error": 2, "transforms": 3, "seconds": 3}  # of numbers in the table; of others 5


def table(loads: Sequence[Load]) -> dict[str, list]:
    """Columns and rows of the table of loads, with error bars."""
    results = loads[0].results
    names = [name for name in COLUMNS if name in results.loads]
    names += [name for name in results.loads if name not in LOADS and not is_error(name, results.loads)]
    if loads[0].law != "hardness":
        names = [name for name in names if name != "mean_plastic_depth"]
    columns = [{"name": "load", "unit": "", "about": "number of the load"}]
    columns += [{"name": NAMES.get(name, name.replace("_", " ")), "unit": _plain(results.units[name], loads[0]),
                 "about": results.columns[name].description} for name in names]  # fmt: skip
    rows = []
    for load in loads:
        row, numbers = [str(load.index)], load.groups.numbers
        for name in names:
            bar = numbers.get(f"{name}_error", math.nan)
            error = f" ± {bar:.1g}" if math.isfinite(bar) else ""
            value = load.number(name)
            row.append(f"{value:.{DIGITS.get(name, 5)}g}{error}" if math.isfinite(value) else "–")
        rows.append([load.index, row])
    return {"columns": columns, "rows": rows}


def _plain(unit: object, load: Load) -> str:
    """A unit as text, with those of the job in place of "length" and "pressure"; none where it is 1 or not known."""
    text = printable(str(unit), 40)
    for name in ("length", "pressure"):
        if re.search(rf"\b{name}\b", text) and not load.unit(name):
            return ""
        text = re.sub(rf"\b{name}\b", lambda _, name=name: load.unit(name), text)
    return "" if text in ("1", "as asked") else re.sub(r"\((\w+)\)", r"\1", text).replace("*", "·")


def charts(loads: Sequence[Load], notes: list[str]) -> list[dict]:
    """Curves of all loads."""
    found = [_area_load(loads)] if len(loads) > 1 else []
    found += [_columns(loads, title, names) for title, names in FOLLOWING.items() if len(loads) > 1]
    kept = {"histogram": _distributions(some(loads, MOST_CURVES)), "spectra": _spectra(some(loads, MOST_CURVES))}
    found += kept.values()
    for chart in found:
        chart["curves"] = [curve for curve in chart["curves"] if curve["x"]]  # no entry of a legend without a curve
    for lacking, chart in kept.items():
        if not chart["curves"]:
            notes.append(f'{chart["title"]} is not shown: the run kept no observable "{lacking}"')
    if len(loads) > MOST_CURVES:
        notes.append(f"distributions and spectra are those of {MOST_CURVES} of the {len(loads)} loads")
    return [chart for chart in found if chart["curves"]]


def distribution(load: Load) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """P(σ) over the whole surface: σ and P as measured, where P > 0, and σ and P of Persson's theory, (m,) each."""
    histogram, std = load.groups["pressure_histogram"], load.full_contact_std
    middle = (histogram["edges"][1:] + histogram["edges"][:-1]) / 2
    density = (load.area if load.area > 0 else 1.0) * histogram["density"]
    shown = density > 0
    if not np.any(shown) or not std > 0:
        return (np.array([]),) * 4
    sigma = np.linspace(0, middle[shown].max(), 400)[1:]
    theory = persson.pressure_density(sigma, load.mean_pressure, std)
    visible = theory > 0.3 * density[shown].min()
    return middle[shown], density[shown], sigma[visible], theory[visible]


def scaled_spectra(load: Load) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Name, q/q_l and spectrum of stress and (in partial contact) contact, such that both tend to one curve where
    they are alike.
    """
    f, found = load.area, []
    partial = 0 < f < 1
    for name, square in [("stress", load.mean_pressure**2)] + [("contact", f**2)] * partial:
        q, value, _ = load.spectrum(name)
        found.append((name, q / load.q_unit, (f / (1 - f) if partial else 1.0) * value / square))
    return found


def _curve(x: np.ndarray, y: np.ndarray, name: str, **style: object) -> dict:
    """A curve of finite points, five digits each."""
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    keep = np.isfinite(x) & np.isfinite(y)
    digits = [[float(f"{value:.5g}") for value in values[keep]] for values in (x, y)]
    return {"name": name, "x": digits[0], "y": digits[1], **style}


def _area_load(loads: Sequence[Load]) -> dict:
    """Contact area, or without a contact the mean gap, against the mean pressure."""
    x, area = (np.array([getattr(load, name) for load in loads]) for name in ("mean_pressure", "corrected_area"))
    unit = loads[0].unit("pressure")
    label = "mean pressure" + (f" / {unit}" if unit else "")
    touched = (x > 0) & (area > 0)
    if not np.any(touched):
        gap = np.array([load.number("mean_gap") for load in loads])
        curve = _curve(x, gap, "", colour=BLUE, dots=True, loads=[load.index for load in loads])
        return {"title": "Mean gap", "xlabel": label, "curves": [curve] if curve["x"] else [], "xlog": True}
    used = [load for load, keep in zip(loads, touched, strict=True) if keep]
    errors = [load.area_error if math.isfinite(load.area_error) else 0.0 for load in used]
    curves = [_curve(x[touched], area[touched], "simulation", colour=BLUE, dots=True, error=errors,
                     loads=[load.index for load in used])]  # fmt: skip
    if loads[0].full_contact_std > 0 and loads[0].law == "hard":
        p = np.geomspace(x[touched].min(), x[touched].max(), 60)
        theory = persson.contact_fraction(p, loads[0].full_contact_std)
        curves.append(_curve(p, theory, "Persson's theory", colour=BLACK))
    return {"title": "Contact area against load", "xlabel": label, "xlog": True, "ylog": True, "curves": curves}


def _columns(loads: Sequence[Load], title: str, names: dict[str, str]) -> dict:
    """Columns of the table of loads against the mean pressure, where they are above 0."""
    unit, curves = loads[0].unit("pressure"), []
    for (column, name), colour in zip(names.items(), (BLUE, RED), strict=False):
        used = [load for load in loads if load.mean_pressure > 0 and load.number(column) > 0]
        bars = [load.number(f"{column}_error") for load in used]
        curves.append(_curve([load.mean_pressure for load in used], [load.number(column) for load in used], name,
                             colour=colour, dots=True, error=[bar if math.isfinite(bar) else 0.0 for bar in bars],
                             loads=[load.index for load in used]))  # fmt: skip
    label, of_column = "mean pressure" + (f" / {unit}" if unit else ""), loads[0].results.units.get(next(iter(names)))
    if of_column and (text := _plain(of_column, loads[0])):
        title += f" / ({text})"
    return {"title": title, "xlabel": label, "xlog": True, "ylog": True, "curves": curves}


def _distributions(loads: Sequence[Load]) -> dict:
    """P(σ) over the whole surface, with Persson's prediction, which has no free parameter."""
    curves = []
    for load in loads:
        if "pressure_histogram" not in load.kept or not load.full_contact_std > 0:
            continue
        std = load.full_contact_std
        x, y, smooth, theory = distribution(load)
        curves.append(_curve(x / std, y * std, "simulation", colour=BLUE, dots=True, load=load.index))
        curves.append(_curve(smooth / std, theory * std, "Persson's theory", colour=BLACK, load=load.index, alone=True))
    label = "pressure over its standard deviation in full contact, σ / (E′ḡ/2)"
    return {"title": "Distribution of pressures, P(σ) E′ḡ/2", "xlabel": label, "ylog": True, "curves": curves}


def _spectra(loads: Sequence[Load]) -> dict:
    """Spectra of stress and contact, f_c|f̃|²/((1 − f_c)|f̃(0)|²), which coincide where both are alike."""
    curves = []
    for load in loads:
        if "stress_spectrum" not in load.kept:
            continue
        for (name, q, value), colour, dash in zip(scaled_spectra(load), (RED, BLUE), ("", "6 3"), strict=False):
            curves.append(_curve(q, value, name, colour=colour, dash=dash, load=load.index))
    limits = loads[0].q_limits
    return {"title": "Spectra of stress and contact, scaled", "xlabel": "wave number q / q_l",
            "xlog": True, "ylog": True, "curves": curves, "mark": [limits[1] / limits[0], "q_s"]}  # fmt: skip

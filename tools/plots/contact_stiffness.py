"""Stiffness of the interface against load, at fixed contact and between neighbouring loads.

K = −dp̄/dū (ū: mean gap).  The observable "stiffness" gives it at fixed contact, with its error.  Between two loads of a
run the change of p̄ over that of ḡ lies between the K of both, as the contact grows with the load.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from area_load import reduced
from plotting import Sheet, limited, standard_error, style
from reading import Load
from samples import Ensemble, by_run, ensembles

from pgfmd.errors import InputError

CAPTION = """(a) Contact stiffness K over E′q_l against the mean pressure. (b) K times the rms height over the mean
pressure, constant where the mean gap falls with the logarithm of the load. Full symbols: at fixed contact; open:
between neighbouring loads. Bars: standard error over seeds; of one seed, the error that its run estimated."""
NEEDS = ("load", "roughness")
MEANS = ("setting", "kind", "reduced_pressure", "stiffness", "error", "seeds")


def draw(loads: list[Load]) -> Sheet:
    """K/(E′q_l) against p̄/(E′ḡ), and K h_rms/p̄ where the spectrum of the heights is known, for each setting."""
    sheet = Sheet(1, 2)
    for number, group in enumerate(limited(ensembles(loads, by_load=False), sheet)):
        height = rms_height(group.loads[0])
        for kind, points in (("fixed contact", column(group, "stiffness")), ("between loads", secants(group))):
            rows = sorted(means(points))
            if not rows:
                continue
            x, value, error, seeds = np.array(rows).T
            look = style(number, filled=kind == "fixed contact") | {"ls": "none"}
            unit = group.modulus * group.q_unit
            sheet.curve(0, x, value / unit, f"{group.name}, {kind}", error=error / unit, **look)
            for row in zip(x, value, error, seeds.astype(int), strict=True):
                sheet.keep("means", MEANS, (group.name, kind, *row))
            if math.isfinite(height):
                scale = height / (x * group.modulus * group.rms_slope)
                sheet.curve(1, x, value * scale, f"{group.name}, {kind}", error=error * scale, **look)
                sheet.findings.add(f"K h_rms/p̄ at the lowest load, {kind}, {group.name}", (value * scale)[0])
    if not sheet.panels[0].has_data():
        raise InputError('contact_stiffness needs the observable "stiffness", or two loads of a run')
    sheet.label(0, r"$\bar p\,/\,(E'\bar g)$", r"$K\,/\,(E'q_l)$", scale="log", columns=4, legend="figure")
    sheet.label(1, r"$\bar p\,/\,(E'\bar g)$", r"$K h_\mathrm{rms}\,/\,\bar p$", scale="semilogx", legend=False)
    if not sheet.panels[1].has_data():
        sheet.drop(1, "no spectrum of the heights was kept")
    return sheet


Points = Iterable[tuple[object, float, float, float]]
"""What tells the load, p̄/(E′ḡ), a value and its error, of each seed."""


def column(group: Ensemble, name: str) -> Points:
    """A column of the table of loads with its error, where it is finite."""
    for load in group:
        if math.isfinite(value := load.number(name)):
            yield load.target, reduced(load), value, load.number(f"{name}_error")


def secants(group: Ensemble) -> Points:
    """−Δp̄/Δḡ between neighbouring loads of each run, at the geometric mean of their pressures."""
    for run in by_run(group).values():
        for low, high in pairwise(sorted(run, key=lambda load: load.mean_pressure)):
            closing = low.number("mean_gap") - high.number("mean_gap")
            if closing > 0:
                value = (high.mean_pressure - low.mean_pressure) / closing
                yield (low.target, high.target), math.sqrt(reduced(low) * reduced(high)), value, 0.0


def means(points: Points) -> Iterator[tuple[float, float, float, int]]:
    """p̄/(E′ḡ), the mean value, its error, and number of seeds, of each load."""
    same: dict[object, list[tuple[float, ...]]] = {}
    for key, *values in points:
        same.setdefault(key, []).append(tuple(values))
    for values in same.values():
        x, found, own = np.array(values).T
        bar = float(own[0]) if len(found) == 1 else float(standard_error(found))
        yield float(x.mean()), float(found.mean()), bar if math.isfinite(bar) else 0.0, len(found)


def rms_height(load: Load) -> float:
    """√⟨(h − ⟨h⟩)²⟩ from the spectrum of the heights; NaN if neither it nor the heights were kept."""
    if "height_spectrum" not in load.kept and "height" not in load.fields:
        return math.nan
    _, power, count = load.spectrum("height")
    return float(np.sqrt(np.sum(power * count)))

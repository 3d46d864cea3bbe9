"""One number of each load against another: a column of the table of loads, a moment, an exponent, a crossover.

    pgfmd plot dependence DIR… [--of q_star] [--on contact_area] [--fit FROM TO] [--level 2]

Runs that differ by the seed alone are averaged.  A curve holds the loads that differ by nothing but the seed and what
is on the horizontal axis.  `--fit` fits a power law to the absolute means in a range of that axis; `--level` says where
each curve reaches a value.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import contact_patches
import field_theory
import figures
import numpy as np
import persson_spectrum
from estimators import band_ratio, broken_power_law, crossing, fit_power_law, tail_exponent
from plotting import BLACK, MOST, Finding, Sheet, standard_error, style
from reading import Load
from samples import Ensemble, ensembles, imposed, named_differences, setting

from pgfmd.errors import InputError

CAPTION = """Means over seeds with standard errors. Lines join loads that differ by nothing but what is on the
horizontal axis; dashed: a power law, drawn over the range of its fit, or the level asked for."""
NEEDS = ()
OPTIONS = {
    "--of": {"nargs": "+", "help": "what is drawn: columns of the table of loads, or m2, q_star, q_star_persson, "
                                   "field_theory_K_K (K: first and last q/q_l), patch_slope, patch_crossover, "
                                   "patch_tail, bearing_tail (default mean_gap)"},
    "--on": {"help": "horizontal axis: a column, or one of lambda_s (in grid spacings), waves (λ_l/λ_s), zeta, "
                     "gap_over_range (rms gap about its mean, over ζ) (default mean_pressure)"},
    "--fit": {"type": float, "nargs": 2, "metavar": ("FROM", "TO"), "help": "range of a power law on that axis"},
    "--level": {"type": float, "help": "value that curves reach: where they do is reported"},
}  # fmt: skip
LEVEL = 0.9  # stress spectrum over that of full contact that defines q*: there the ratio falls below this
LEAST = 16  # pixels of the smallest patch that is fitted


@dataclass(frozen=True)
class Quantity:
    """A number of a load: the label of its axis, its value, the keys of a job that set it, its word in legends."""

    axis: str
    value: Callable[[Load], float]
    keys: tuple[str, ...] = ()
    of_setting: bool = False  # the same for all loads of a run
    word: str = ""


def m2(load: Load) -> float:
    """⟨σ²⟩_c/σ_c²."""
    return load.normalised_second_moment


def q_star(load: Load) -> float:
    """q*/q_l: where the stress spectrum over that of full contact falls below LEVEL; NaN if it never does."""
    q, stress, full, _ = persson_spectrum.ratio(load)
    return crossing(q / load.q_unit, stress / full, LEVEL)


def q_star_persson(load: Load) -> float:
    """The same for f(q), which Persson's theory has in place of that ratio."""
    q = persson_spectrum.ratio(load)[0]
    return crossing(q / load.q_unit, persson_spectrum.theory(load, q), LEVEL)


def departure(low: int, high: int) -> Callable[[Load], float]:
    """Stress spectrum over field theory − 1 in a band of q/q_l, summed mode by mode."""

    def value(load: Load) -> float:
        q, stress, count = load.spectrum("stress")
        ratio = band_ratio([(low, high)], np.round(q / load.q_unit), count, stress, field_theory.summed(load))
        return float(ratio[0]) - 1

    return value


def gap_over_range(load: Load) -> float:
    """Rms value of the gap about its mean, over ζ."""
    count, total, squares = 0, 0.0, 0.0
    for _, gap in load.results.blocks("gap", load.index):
        count, total, squares = count + gap.size, total + float(gap.sum()), squares + float(np.sum(gap**2))
    return math.sqrt(squares / count - (total / count) ** 2) / (load.zeta or math.nan)


def _patches(estimate: Callable, table: str = "patches") -> Callable[[Load], float]:
    def value(load: Load) -> float:
        sample = contact_patches.patches(load, table)
        resolved = LEAST * float(np.prod(load.spacings)) / load.wavelengths[0] ** 2
        return float(estimate(sample, resolved)) if len(sample[0]) else math.nan

    return value


def _crossover(sample: contact_patches.Sample, resolved: float) -> float:
    return broken_power_law(*contact_patches.medians_between(sample, resolved, math.inf))[2]


QUANTITIES = {
    "m2": Quantity(r"$m_2 = \langle\sigma^2\rangle_c\,/\,\sigma_c^2$", m2),
    "q_star": Quantity(r"$q^*/\,q_l$", q_star, word="simulation"),
    "q_star_persson": Quantity(r"$q^*/\,q_l$", q_star_persson, word="Persson"),
    "patch_slope": Quantity(
        r"exponent of $l_c(a_c)$, $a_c \leq 0.1\,\lambda_s^2$",
        _patches(lambda sample, least: contact_patches.slope(sample, least, contact_patches.SMALL)),
        word="exponent",
    ),
    "patch_crossover": Quantity(r"crossover $a_c\,/\,\lambda_s^2$", _patches(_crossover), word="crossover"),
    "patch_tail": Quantity(
        r"$\tau$ of patches above $\lambda_s^2$",
        _patches(lambda sample, least: tail_exponent(sample[0], max(contact_patches.LARGE, least))[0]),
    ),
    "bearing_tail": Quantity(
        r"$\tau$ of patches of the bearing area",
        _patches(lambda sample, least: tail_exponent(sample[0], least)[0], "bearing_patches"),
    ),
    "lambda_s": Quantity(
        r"$\lambda_s\,/\,a$", lambda load: load.wavelengths[0] / min(load.spacings), ("surface.lambda_s",), True
    ),
    "waves": Quantity(
        r"$\lambda_l\,/\,\lambda_s$", lambda load: load.wavelengths[1] / load.wavelengths[0],
        ("surface.lambda_s", "grid."), True,
    ),
    "zeta": Quantity(r"$\zeta$", lambda load: load.zeta or math.nan, ("wall.zeta",), True),
    "gap_over_range": Quantity(r"rms gap $/\,\zeta$", gap_over_range, ("wall.zeta",)),
}  # fmt: skip


def quantity(name: str, loads: list[Load]) -> Quantity:
    """The number of that name.  Raises InputError if it is neither in QUANTITIES nor a column of the loads."""
    if name.startswith("field_theory_"):
        ends = name.removeprefix("field_theory_").split("_")
        if len(ends) == 2 and all(end.isdigit() for end in ends):
            band = "–".join(ends)
            return Quantity("ratio to field theory $-$ 1", departure(*map(int, ends)), word=f"$q/q_l$ = {band}")
    if name in QUANTITIES:
        return QUANTITIES[name]
    columns = sorted({column for load in loads for column in load.results.loads})
    if name not in columns:
        raise InputError(f"{name!r} is no column of these loads; it is one of {', '.join([*QUANTITIES, *columns])}")
    return Quantity(name.replace("_", " "), lambda load: load.number(name))


def draw(
    loads: list[Load], of: Sequence[str] = ("mean_gap",), on: str = "mean_pressure",
    fit: tuple[float, float] | None = None, level: float | None = None,
) -> Sheet:  # fmt: skip
    """The numbers `of` against the number `on`, one curve for each setting (and load, if `on` is of the setting)."""
    sheet, horizontal, drawn = Sheet(), quantity(on, loads), 0
    x = cache(horizontal.value)
    for what in of:
        vertical = quantity(what, loads)
        y = cache(vertical.value)
        known = [load for load in loads if math.isfinite(y(load))]
        if len(known) < len(loads):
            sheet.notes.append(f"{len(loads) - len(known)} of {len(loads)} loads have no {what}")
        for name, groups in _curves(known, horizontal).items():
            title = ", ".join(filter(None, ([vertical.word or vertical.axis, name] if len(of) > 1 else [name])))
            points = sorted(((float(np.mean([x(load) for load in group])), group) for group in groups), key=_place)
            for place, group in points:
                sheet.findings.add(f"{what}, {group.name}", [y(load) for load in group])
                rows = ((what, name, group.name, load.seed, x(load), place, y(load)) for load in group)
                sheet.keep("data", ("of", "curve", "setting", "seed", on, f"mean {on}", "value"), *rows)
            if drawn < MOST:
                _draw(sheet, drawn, title or what, points, y)
            seeds: dict[object, list[tuple[float, float]]] = {}
            for load in (load for _, group in points for load in group):
                seeds.setdefault(load.seed, []).append((x(load), y(load)))
            after = f", {name}" if name else ""
            if level is not None:
                places = [reached(*np.array(each).T, level) for each in seeds.values()]
                sheet.findings.add(f"{on} where {what} reaches {level:g}{after}", places)
            if fit:
                _fit(sheet, f"exponent of {what} against {on}{after}", list(seeds.values()), fit, drawn)
            drawn += 1
    if not drawn:
        raise InputError(f"dependence needs a load whose {' or '.join(of)} is known")
    if drawn > MOST:
        sheet.notes.append(f"{drawn} curves; the first {MOST} are drawn, all are in the tables")
    if level is not None:
        sheet.panels[0].axhline(level, color=BLACK, ls="--", lw=0.7)
    positive = all(row[column] > 0 for row in sheet._table for column in (2, 3))
    axes = list(dict.fromkeys(quantity(what, loads).axis for what in of))
    sheet.label(0, horizontal.axis, axes[0] if len(axes) == 1 else "", scale=SCALES[positive])
    return sheet


SCALES = {True: "log", False: "semilogx"}


def _place(point: tuple[float, Ensemble]) -> float:
    return point[0]


def _curves(loads: list[Load], horizontal: Quantity) -> dict[str, list[Ensemble]]:
    """Loads that differ by nothing but what is on the horizontal axis and the seed: name of the curve → its points."""
    groups: dict[tuple, list[Ensemble]] = {}
    settings: dict[tuple, dict] = {}
    for group in ensembles(loads):
        first = group.loads[0]
        varied = [key for key in setting(first) if horizontal.keys and key.startswith(horizontal.keys)]
        fixed = {key: value for key, value in setting(first).items() if key not in varied}
        key = (*((key, str(value)) for key, value in fixed.items()), imposed(first) * horizontal.of_setting)
        groups.setdefault(key, []).append(group)
        settings[key] = fixed
    titles = [", ".join(words) for words in named_differences(list(settings.values()))]
    several = len({key[-1] for key in groups}) > 1
    names = [", ".join(filter(None, (title, key[-1] * several))) for title, key in zip(titles, groups, strict=True)]
    return dict(zip(names, groups.values(), strict=True))


def _draw(sheet: Sheet, number: int, name: str, points: list, y: Callable):
    values = [[y(load) for load in group] for _, group in points]
    errors = [standard_error(each) for each in values]
    known = None if any(error is None for error in errors) else np.array(errors, float)
    means = np.array([np.mean(each) for each in values])
    sheet.curve(0, [place for place, _ in points], means, name, error=known, lw=0.7, **style(number))


def reached(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """The first x (ascending) at which y passes the level, from below or above; NaN if it does not."""
    return crossing(x, y, level) if y[0] > level else crossing(x, -y, -level)


def _fit(sheet: Sheet, name: str, seeds: list[list[tuple[float, float]]], limits: tuple[float, float], number: int):
    """The exponent of |mean over the seeds that have all loads| between limits; its error by leaving one out."""

    def exponent(chosen: list) -> tuple[float, float, np.ndarray, float]:
        x, y = np.mean(np.array(chosen), axis=0).T
        part = (x >= limits[0]) & (x <= limits[1]) & (y != 0)
        if np.count_nonzero(part) < 3:
            return math.nan, math.nan, x[part], 1.0
        slope, (offset,) = fit_power_law(x[part], np.abs(y[part]))
        return slope, offset, x[part], float(np.sign(y[part].sum()))

    longest = max(map(len, seeds))
    whole = [each for each in seeds if len(each) == longest]
    slope, offset, x, sign = exponent(whole)
    sheet.findings.add(name, slope)
    if name not in sheet.findings:
        return
    if len(whole) > 2:
        rest = np.array([exponent(whole[:i] + whole[i + 1 :])[0] for i in range(len(whole))])
        error = float(np.sqrt((len(rest) - 1) / len(rest) * np.sum((rest - rest.mean()) ** 2)))
        sheet.findings[name] = Finding(slope, error, None, len(whole))
    along = np.geomspace(x[0], x[-1], 40)
    sheet.curve(0, along, sign * np.exp(offset) * along**slope, name, label=False, color=style(number)["color"],
                ls="--", lw=0.9)  # fmt: skip


if __name__ == "__main__":
    sys.exit(figures.main(["dependence", *sys.argv[1:]]))

"""The exponent μ of stress and contact spectra, C̃ ∝ q^−μ, with errors of seeds and of fit ranges.

The joint fit has one μ for stress and contact at every load, and free prefactors.  The fit range in q/q_l is by default
from 8 to q_s/(16 q_l), or q_s/(2 q_l) where that leaves less than a factor of 4; its neighbours (moved by 2 either way,
halved at each end) give the spread over choices.
"""

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
from choosing import AREAS, WINDOW, near
from estimators import fit_power_law, windows, within
from plotting import BLACK, COLOURS, GREY, Finding, Sheet, style
from reading import Load
from samples import Ensemble, by_run, common_bins, ensembles
from stress_contact_spectra import ratio_of_means

CAPTION = """(a) Stress (filled symbols) and contact spectra (open), scaled so that the sum of the contact's over all
q ≠ 0 is one, at the largest load; settings are moved apart by the factors named; lines: joint fits over the range that
they span, drawn a factor of 1.6 above the data. (b) The ratio of the scaled spectra at the largest and the smallest
load in octaves of q, with standard errors. (c) Exponents of the joint fit against the Hurst exponent with both
errors, with 1 + H and published ones."""
NEEDS = ("spectra", "partial contact")
OPTIONS = AREAS | WINDOW
KINDS = ("joint", "stress", "contact", "difference")
DRAWN = 4  # settings in the first two panels

Curves = dict[float, dict[str, np.ndarray]]
"""Load target → kind → scaled spectra of each seed, (seeds, m)."""


def draw(
    loads: list[Load],
    areas: tuple[float, ...] = (),
    window: tuple[float, float] | None = None,
    reference: Sequence[tuple[float, float, float]] = (),
) -> Sheet:
    """Spectra with joint fits, the ratio between loads, and μ against H; beside published ones: (H, μ, error) each."""
    groups = ensembles(near(loads, areas), by_load=False)
    sheet = Sheet(1, 3, height=2.9)
    largest = max(max(group.results.shape) for group in groups)
    shown = [group for group in groups if max(group.results.shape) == largest][:DRAWN]
    if len(shown) < len(groups):
        sheet.notes.append(f"(a) and (b) show {len(shown)} of {len(groups)} settings, those of the largest grid")
    points = []
    shared = set.intersection(*(set(group.name.split(", ")) for group in shown))
    for group in groups:
        group = of_common_loads(group, sheet)
        x, curves = scaled(group)
        limits = tuple(window) if window else default_window(group)
        name = group.name
        spread = report(sheet, group, name, (x, curves), limits)
        points.append((group, spread))
        if group in shown:
            title = ", ".join(part for part in name.split(", ") if part not in shared) or name
            number = shown.index(group)
            _draw(sheet, number, title, (x, curves), limits, (100.0 if len(shown) == 2 else 10.0) ** -number)
    for kind in ("contact", "stress"):
        sheet.findings.add(f"sum rule, {kind}, largest residual", worst_sum(loads, kind))
    _draw_exponents(sheet, points, largest)
    if reference:
        hurst, exponents, errors = np.array(reference).T
        sheet.curve(2, hurst + 0.03, exponents, "paper", error=errors, color=BLACK, marker="*", mfc="white", ls="none")
    sheet.panels[1].axhline(1, color=BLACK, lw=0.7)
    scaled_name = r"$f_c\,\tilde C(q)\,/\,[(1-f_c)\,\tilde C(0)]$"
    sheet.label(0, r"$q\,/\,q_l$", scaled_name, scale="log", columns=1)
    sheet.label(1, r"$q\,/\,q_l$", "spectra, largest over smallest load", scale="semilogx", columns=1)
    sheet.label(2, "Hurst exponent $H$", r"exponent $\mu$, joint fit")
    return sheet


def default_window(group: Ensemble) -> tuple[float, float]:
    """From 8 q_l to q_s/16, or to q_s/2 where that leaves less than a factor of 4; without a cut-off, q_s is 2π/a."""
    shortest, longest = group.wavelengths
    top = longest / max(shortest, max(group.spacings))
    return (8.0, top / 16) if top / 16 >= 32 else (min(8.0, top / 16), top / 2)


def of_common_loads(group: Ensemble, sheet: Sheet) -> Ensemble:
    """The runs of a setting that have the most frequent list of loads, and of those all; others are named in a note."""
    targets = {folder: tuple(load.target for load in run) for folder, run in by_run(group).items()}
    frequent = Counter(targets.values()).most_common(1)[0][0]
    kept = tuple(load for load in group if targets[load.results.directory] == frequent)
    left = sorted({load.folder for load in group} - {load.folder for load in kept})
    if left:
        sheet.notes.append(f"left out, as their loads are others than those of {kept[0].folder}: {', '.join(left)}")
    return Ensemble(kept, group.label, group.name)


def scaled(group: Ensemble) -> tuple[np.ndarray, Curves]:
    """q/q_l (m,), and f_c C̃/((1−f_c) C̃(0)) of stress and contact of every seed at every load."""
    curves, x = {}, None
    for target in sorted({load.target for load in group}, key=lambda target: target[1]):
        same = sorted((load for load in group if load.target == target), key=lambda load: load.results.directory)
        kinds = {}
        for kind in ("stress", "contact"):
            q, power = common_bins([load.spectrum(kind)[:2] for load in same])
            f = np.array([load.area for load in same])[:, None]
            zero = np.array([load.mean_pressure if kind == "stress" else load.area for load in same])[:, None] ** 2
            kinds[kind] = f * power / ((1 - f) * zero)
        curves[target[1]], x = kinds, q / group.q_unit
    # a regular surface leaves bins empty up to rounding
    seen = np.all([(c > c.max() * 1e-20).all(axis=0) for kinds in curves.values() for c in kinds.values()], axis=0)
    return x[seen], {load: {kind: c[:, seen] for kind, c in kinds.items()} for load, kinds in curves.items()}


def exponent(x: np.ndarray, curves: Curves, kind: str, seed: int, limits: tuple[float, float]) -> float:
    """μ of one seed over a range of q/q_l: of one kind of spectrum, of both ("joint") at all loads, or the "difference"
    contact − stress; NaN where fewer than three bins lie in the range.
    """
    if kind == "difference":
        return exponent(x, curves, "contact", seed, limits) - exponent(x, curves, "stress", seed, limits)
    kinds = ("stress", "contact") if kind == "joint" else (kind,)
    inside = within(x, limits)
    lines = [spectra[name][seed][inside] for spectra in curves.values() for name in kinds]
    if np.count_nonzero(inside) < 3 or not np.all(np.asarray(lines) > 0):
        return float("nan")
    return -fit_power_law(x[inside], *lines)[0]


def report(sheet: Sheet, group: Ensemble, name: str, data: tuple, limits: tuple[float, float]) -> str:
    """Record μ of each of KINDS: over every fit range in a table, over `limits` as findings.  Returns the name of the
    joint fit's finding.
    """
    x, curves = data
    seeds = len(next(iter(curves.values()))["stress"])
    for kind in KINDS:
        values = [[exponent(x, curves, kind, seed, each) for seed in range(seeds)] for each in windows(limits)]
        sheet.findings.add(f"μ {kind}, {name}", values[0], values[1:])
        for (low, high), each in zip(windows(limits), values, strict=True):
            error = np.std(each, ddof=1) / np.sqrt(seeds) if seeds > 1 else None
            sheet.keep("table", ("setting", "hurst", "from", "to", "fit", "mu", "standard_error", "seeds"),
                       (name, group.hurst, low, high, kind, float(np.mean(each)), error, seeds))  # fmt: skip
    smallest = {min(curves): curves[min(curves)]}
    alone = [[exponent(x, smallest, "joint", seed, each) for seed in range(seeds)] for each in windows(limits)]
    sheet.findings.add(f"μ at the smallest load, {name}", alone[0], alone[1:])
    # the difference falls as 1/ln(window) if one decay differs from the other by a factor over the window
    scaled_difference = [[math.log(high / low) * exponent(x, curves, "difference", seed, (low, high))
                          for seed in range(seeds)] for low, high in windows(limits)]  # fmt: skip
    sheet.findings.add(f"(μ_c − μ_σ) ln(window), {name}", scaled_difference[0], scaled_difference[1:])
    for octave in 2.0 ** np.arange(1, math.floor(math.log2(x[-1]))):
        local = [exponent(x, curves, "joint", seed, (octave, 2 * octave)) for seed in range(seeds)]
        sheet.findings.add(f"local μ joint, {octave:g} … {2 * octave:g} q_l, {name}", local)
    runs = sorted({load.results.directory for load in group})
    for target, kinds in curves.items():
        for seed, run in enumerate(runs):
            rows = zip(x, kinds["stress"][seed], kinds["contact"][seed], strict=True)
            sheet.keep("data", ("setting", "load", "run", "q_over_q_l", "stress", "contact"),
                       *((name, target, run.name, *row) for row in rows))  # fmt: skip
    _compare_loads(sheet, name, x, curves)
    return f"μ joint, {name}"


def _compare_loads(sheet: Sheet, name: str, x: np.ndarray, curves: Curves):
    """How far apart the scaled spectra of the largest and the smallest load lie: the farthest octaves."""
    if len(curves) < 2:
        return
    low, high = list(curves)[0], list(curves)[-1]
    for kind in ("stress", "contact"):
        middle, ratio, error = octaves(x, curves[high][kind], curves[low][kind])
        for title, part in (("q ≥ 4 q_l", middle > 4), ("q < 4 q_l", middle < 4)):
            if np.any(part):
                worst = np.flatnonzero(part)[int(np.argmax(np.abs(np.log(ratio[part]))))]
                found = Finding(float(ratio[worst]), float(error[worst]) if np.isfinite(error[worst]) else None,
                                count=len(curves[high][kind]))  # fmt: skip
                sheet.findings[f"{kind} spectra, largest over smallest load, farthest octave of {title}, {name}"] = (
                    found
                )


def octaves(x: np.ndarray, above: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle of each octave of x, and the ratio of two spectra (seeds, m) there, bins weighed alike, with its error."""
    octave = np.floor(np.log2(x) + 1e-9).astype(int)
    levels = np.unique(octave)
    # each bin over its mean, so that the first ones of a steep spectrum do not decide alone
    norm = below.mean(axis=0)
    sums = [
        np.array([(values / norm)[:, octave == level].sum(axis=1) for level in levels]).T for values in (above, below)
    ]
    return 2.0 ** (levels + 0.4), *ratio_of_means(*sums)


def worst_sum(group: list[Load], kind: str) -> float:
    """The largest residual of Σ_{q≠0} |f̃|² = ⟨f²⟩ − ⟨f⟩², relative to ⟨f²⟩, of loads whose bins hold every mode.

    NaN if no load has such bins (and, for the stress, its second moment).
    """
    residuals = []
    for load in group:
        _, power, count = load.spectrum(kind)
        if round(count.sum()) == np.prod(load.results.shape) - 1:
            square = load.area
            if kind == "stress":
                square = load.normalised_second_moment * load.contact_pressure * load.mean_pressure
            mean = load.area if kind == "contact" else load.mean_pressure
            residuals.append(float(np.sum(power * count) + mean**2) / square - 1)
    return max(residuals, key=abs, default=float("nan"))


def _draw(sheet: Sheet, number: int, name: str, data: tuple, limits: tuple[float, float], shift: float):
    x, curves = data
    colour, marker = COLOURS[number], "os^D"[number]
    low, high = list(curves)[0], list(curves)[-1]
    for kind, fill in (("stress", colour), ("contact", "white")):
        mean = curves[high][kind].mean(axis=0)
        moved = f" (× {shift:g})" if number else ""
        sheet.curve(0, x, shift * mean, f"{kind}, {name}{moved}", color=colour, marker=marker, mfc=fill, ls="none",
                    ms=2.2, label=kind == "stress" and name + moved)  # fmt: skip
        if low != high:
            middle, ratio, error = octaves(x, curves[high][kind], curves[low][kind])
            place = middle * (1 + 0.07 * (2 * number + (kind == "contact")))
            sheet.curve(1, place, ratio, f"{kind}, {name}", error=error, color=colour, marker=marker, mfc=fill, lw=0.5,
                        label=False)  # fmt: skip
    inside = within(x, limits)
    if np.count_nonzero(inside) >= 3:
        lines = [curves[high][kind].mean(axis=0)[inside] for kind in ("stress", "contact")]
        power, offsets = fit_power_law(x[inside], *lines)
        ends = x[inside][[0, -1]]
        sheet.curve(0, ends, 1.6 * shift * np.exp(max(offsets)) * ends**power, f"joint fit, $\\mu$ = {-power:.2f}",
                    label=False, color=BLACK, lw=1.0, zorder=5)  # fmt: skip


def _draw_exponents(sheet: Sheet, points: list[tuple[Ensemble, str]], largest: int):
    """μ against H, with errors of seeds and choices together: filled for the largest grid, open for smaller ones."""
    with_hurst = [(group, name) for group, name in points if group.hurst is not None]
    if not with_hurst:
        sheet.panels[2].text(0.5, 0.5, "no self-affine surface", transform=sheet.panels[2].transAxes, ha="center")
        return
    hursts = np.array([group.hurst for group, _ in with_hurst])
    ends = np.array([max(hursts.min() - 0.05, 0.0), min(hursts.max() + 0.05, 1.0)])  # also of a single H
    sheet.curve(2, ends, 1 + ends, "$1 + H$", color=GREY)
    series: dict[str, list] = {}
    for group, name in with_hurst:
        parts = [part for part in group.name.split(", ") if not part.startswith("H = ")]
        series.setdefault(", ".join(parts) or f"n = {max(group.results.shape)}", []).append((group, name))
    for number, (title, members) in enumerate(series.items()):
        chosen = [(group, sheet.findings[name]) for group, name in members if name in sheet.findings]
        if chosen:
            x = np.array([group.hurst for group, _ in chosen]) + 0.012 * (number - (len(series) - 1) / 2)
            look = style(number, filled=max(chosen[0][0].results.shape) == largest)
            sheet.curve(2, x, [found.value for _, found in chosen], title,
                        error=[found.error or 0.0 for _, found in chosen], ls="none", **look)  # fmt: skip

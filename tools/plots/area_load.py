"""Contact area against load, raw and corrected for the pixels, with the theories of Persson and Bush–Gibson–Thomas.

Loads of runs that differ by the seed alone are averaged; `--area` is where κ = f_c E' g/p̄ is reported, by
interpolation in the logarithm of the area.
"""

import math
from collections.abc import Sequence

import numpy as np
from choosing import NEEDS as TESTS
from plotting import BLACK, GREY, Sheet, limited, standard_error, style
from reading import Load
from samples import Ensemble, by_run, ensembles

from pgfmd.theory import asperity, persson
from pgfmd.theory.surface import SpectralMoments

CAPTION = """(a) Relative contact area, corrected for the pixels, against the mean pressure. (b) Their ratio κ; open
symbols, of up to three settings: with the raw area; star: a published value. Black line: Persson's theory; dash-dotted,
in the colour of the setting: that of Bush, Gibson and Thomas (BGT), which depends on the surface; dashed: their limits
at low load. Bars: standard error over seeds; of one seed, the error that its run estimated."""
NEEDS = ("area", "load", "roughness")
OPTIONS = {"--area": {"type": float, "nargs": "+", "help": "contact areas at which κ is reported (default 0.08)"}}

MEANS = ("setting", "reduced_pressure", "area", "area_corrected", "area_error", "kappa", "kappa_error", "seeds")
AREAS = {
    "raw": lambda load: load.area,
    "corrected": lambda load: load.corrected_area,
    "upper": lambda load: load.corrected_area + load.area_error,  # NaN unless the run estimated the error of its grid
}


def draw(
    loads: list[Load], area: tuple[float, ...] = (0.08,), reference: Sequence[tuple[float, float, float]] = ()
) -> Sheet:
    """f_c against p̄/(E'g), and κ against f_c, for each setting; beside published values: (f_c, κ, error) each."""
    sheet = Sheet(1, 2)
    shown = limited(ensembles(loads, by_load=False), sheet)
    for number, group in enumerate(shown):
        name = group.name
        load, raw, corrected, bar, kappa, error, seeds = columns(group)
        filled, bare = style(number), style(number, filled=False)
        sheet.curve(0, load, corrected, name, error=bar, ls="none", **filled)
        sheet.curve(1, corrected, kappa, name, error=error, lw=0.5, **filled)
        if len(shown) < 4:
            sheet.curve(1, raw, raw / load, f"{name}, raw", label=False, ls="none", **bare)
        for row in zip(load, raw, corrected, bar, kappa, error, seeds.astype(int), strict=True):
            sheet.keep("means", MEANS, (name, *row))
        report(sheet, group, area, name)
    _draw_theory(sheet, loads, shown)
    if len(shown) < 4:
        sheet.panels[1].plot([], [], ls="none", color=BLACK, marker="o", mfc="white", label="raw pixels")
    if reference:
        areas, kappas, errors = np.array(reference).T
        look = {"color": BLACK, "marker": "*", "mfc": "white", "ms": 6, "ls": "none", "zorder": 6}
        sheet.curve(1, areas, kappas, "paper", error=errors, **look)
    sheet.label(0, r"$\bar p\,/\,(E'\bar g)$", "contact area $f_c$", scale="log", legend=False)
    sheet.label(
        1, "contact area $f_c$", r"$\kappa = f_c E'\bar g\,/\,\bar p$", scale="semilogx", columns=5, legend="figure"
    )
    return sheet


def reduced(load: Load) -> float:
    """p̄/(E'g)."""
    return load.mean_pressure / (load.modulus * load.rms_slope)


def columns(group: Ensemble) -> tuple[np.ndarray, ...]:
    """Means over the seeds at each load: p̄/(E'g), f_c raw and corrected, the error of this, κ corrected and its
    error, number of seeds.  Errors: standard errors; of one seed those that its run estimated, 0 if it did not.
    """
    rows, targets = [], sorted({load.target for load in group})
    for target in targets:
        same = [load for load in group if load.target == target]
        kappas = [load.corrected_area / reduced(load) for load in same]
        own = same[0].area_error if math.isfinite(same[0].area_error) else 0.0
        errors = (standard_error([load.corrected_area for load in same]), standard_error(kappas))
        bar, error = (own, own / reduced(same[0])) if len(same) == 1 else map(float, errors)
        means = [np.mean([value(load) for load in same]) for value in
                 (reduced, lambda load: load.area, lambda load: load.corrected_area)]  # fmt: skip
        rows.append((*means, bar, np.mean(kappas), error, len(same)))
    return tuple(np.array(sorted(rows)).T)


def report(sheet: Sheet, group: Ensemble, areas: tuple[float, ...], name: str):
    """κ at each of the areas, interpolated for each seed; at the lowest load; and a table of all loads."""
    runs = by_run(group)
    for load in group:
        sheet.keep("loads", ("setting", "seed", "mean_pressure", "modulus", "rms_slope", "area", "area_corrected"),
                   (name, load.seed, load.mean_pressure, load.modulus, load.rms_slope, load.area,
                    load.corrected_area))  # fmt: skip
    for area in areas:
        kappas = {kind: [kappa_at(run, area, kind) for run in runs.values()] for kind in AREAS}
        sheet.findings.add(f"κ at f_c = {area:g}, raw, {name}", kappas["raw"])
        _add(sheet, f"at f_c = {area:g}", name, kappas["corrected"], kappas["upper"])
    lowest = [min(run, key=lambda load: load.mean_pressure) for run in runs.values()]
    ends = ([_kappa(load, kind) for load in lowest] for kind in ("corrected", "upper"))
    _add(sheet, "at the lowest load", name, *ends)


def _add(sheet: Sheet, where: str, name: str, kappas: list[float], upper: list[float]):
    """κ of each seed with the error of its grid, and how far it lies from Persson's limit towards that of BGT."""
    low, high = persson.LOW_LOAD_KAPPA, asperity.LOW_LOAD_KAPPA_BGT
    others = _choice(upper)
    sheet.findings.add(f"κ {where}, corrected, {name}", kappas, others)
    ways = None if others is None else [(other - low) / (high - low) for other in others]
    sheet.findings.add(
        f"way from Persson's κ to that of BGT {where}, {name}", (np.array(kappas) - low) / (high - low), ways
    )


def _choice(values: list[float]) -> list[float] | None:
    """The mean of values as the only alternative of a finding; None if a value is not known."""
    return [float(np.mean(values))] if np.all(np.isfinite(values)) else None


def kappa_at(run: list[Load], area: float, kind: str) -> float:
    """κ of one run at a contact area, with one of AREAS; NaN beyond its loads."""
    run = sorted(run, key=lambda load: load.mean_pressure)
    areas = np.array([AREAS[kind](load) for load in run])
    if len(run) == 1:
        return _kappa(run[0], kind) if abs(areas[0] / area - 1) < 0.1 else math.nan
    if not areas[0] * 0.9 <= area <= areas[-1] * 1.1:
        return math.nan
    return float(np.interp(np.log(area), np.log(areas), [_kappa(load, kind) for load in run]))


def _kappa(load: Load, kind: str) -> float:
    return AREAS[kind](load) / reduced(load)


def _draw_theory(sheet: Sheet, loads: list[Load], groups: Sequence[Ensemble]):
    """Persson depends on p̄/(E'g) alone; BGT also on the bandwidth: that of a setting's first surface whose spectrum is
    kept.
    """
    seen = [reduced(load) for load in loads]
    load = np.geomspace(min(seen) / 1.5, max(seen) * 1.2, 200)
    fraction = persson.contact_fraction(load, 0.5)
    sheet.curve(0, load, fraction, "Persson", color=BLACK)
    sheet.curve(1, fraction, fraction / load, "Persson", color=BLACK)
    ends = np.array([fraction[0], fraction[-1]])
    for name, kappa, colour in (("Persson, low load", persson.LOW_LOAD_KAPPA, BLACK),
                                ("BGT, low load", asperity.LOW_LOAD_KAPPA_BGT, GREY)):  # fmt: skip
        sheet.curve(1, ends, [kappa, kappa], name, color=colour, ls="--", lw=0.8)
    reasons = set()
    for number, group in enumerate(groups):
        case = next((each for each in group if TESTS["spectra"][0](each)), None)
        if case is None:
            reasons.add("no spectrum of the heights was kept")
            continue
        moments = SpectralMoments.from_spectrum(*case.spectrum("height"))
        if moments.alpha < 1.5:
            reasons.add("the surface is not isotropic and Gaussian")
            continue
        separation = np.sqrt(moments.m0) * np.linspace(0.3, 5, 48)
        area, pressure = asperity.bush_gibson_thomas(separation, moments, case.modulus)
        low = pressure / (case.modulus * moments.rms_slope)
        seen = (low >= load[0]) & (low <= load[-1])
        look = {"color": style(number)["color"], "ls": "-.", "lw": 0.8, "label": False}
        sheet.curve(0, low[seen], area[seen], f"BGT, {group.name}", **look)
        sheet.curve(1, area[seen], (area / low)[seen], f"BGT, {group.name}", **look)
    sheet.notes += [f"no curve of Bush, Gibson and Thomas: {reason}" for reason in sorted(reasons)]
    if not reasons:
        sheet.panels[1].plot([], [], color=GREY, ls="-.", lw=0.8, label="BGT")

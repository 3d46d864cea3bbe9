"""What a first run shows: the surface with its contact patches, P(σ) with Persson's curve, stress and contact spectra.

    python tools/quickstart_figures.py results/quickstart

Needs a run that kept the fields height and pressure, and the observables histogram and spectra.  Draws the last load.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotting
from matplotlib.colors import LightSource, ListedColormap
from plotting import BLACK, BLUE, GREY, RED, Findings, Sheet
from reading import Case, cases

from pgfmd.theory import persson

PIXELS = 1024  # a larger field is thinned to about this many points per side


def thinned(case: Case, name: str, load: int | None) -> np.ndarray:
    """The field on every k-th point, read in row blocks: float array of at most about PIXELS × PIXELS."""
    step = max(1, max(case.results.shape) // PIXELS)
    parts = []
    for rows, values in case.results.blocks(name, load):
        parts.append(values[-rows.start % step :: step, ::step])
    return np.concatenate(parts)


def draw_surface(axes, case: Case):
    """The heights, lit from the side, with the contact on top; x to the right, y upwards."""
    height, pressure = thinned(case, "height", None).T, thinned(case, "pressure", case.index).T
    lx, ly = case.results.lengths
    light = LightSource(azdeg=135, altdeg=40)
    span = np.ptp(height) or 1.0
    shaded = 0.6 * (height - height.min()) / span + 0.4 * light.hillshade(height, vert_exag=60 / span)
    axes.imshow(shaded, cmap="gray", vmin=-0.1, vmax=1, origin="lower", extent=(0, lx, 0, ly))
    contact = np.ma.masked_where(pressure <= 0, pressure)
    top = float(np.quantile(pressure[pressure > 0], 0.99)) if np.any(pressure > 0) else 1.0
    image = axes.imshow(contact, cmap=contact_colours(), vmin=0, vmax=top, origin="lower", extent=(0, lx, 0, ly),
                        interpolation="nearest")  # fmt: skip
    unit = case.config.output.length_unit
    name = "grid spacings" if unit == "length" and max(case.config.grid.steps) == 1 else unit
    axes.set(xlabel=f"x / {name}", ylabel=f"y / {name}", title=f"contact on {100 * case.area:.2g} % of the surface")
    axes.grid(False)
    pressure_unit = case.config.output.pressure_unit
    label = "pressure" + (f" / {pressure_unit}" if pressure_unit != "pressure" else "")
    axes.figure.colorbar(image, ax=axes, label=label, shrink=0.85, extend="max")


def contact_colours() -> ListedColormap:
    """The bright part of inferno: every contact stands out against the grey surface."""
    import matplotlib

    return ListedColormap(matplotlib.colormaps["inferno"](np.linspace(0.35, 1, 256)))


def draw_distribution(sheet: Sheet, panel: int, case: Case):
    """P(σ) over the whole surface in units of the full-contact pressure, with Persson's prediction at the same load."""
    histogram, std = case.groups["pressure_histogram"], case.full_contact_std
    middle = (histogram["edges"][1:] + histogram["edges"][:-1]) / 2
    density = case.area * histogram["density"] * std
    shown = density > 0
    sheet.curve(panel, middle[shown] / std, density[shown], "simulation", color=BLUE, marker="o", ls="none", ms=2.5)
    sigma = np.linspace(0, middle[shown].max(), 400)[1:]
    theory = persson.pressure_density(sigma, case.load, std) * std
    visible = theory > 0.3 * density[shown].min()
    sheet.curve(panel, sigma[visible] / std, theory[visible], "Persson", color=BLACK)
    title = "distribution of pressures σ > 0"
    sheet.label(panel, "σ / (E'g/2)", "P(σ) E'g/2", title, scale="semilogy")


def draw_spectra(sheet: Sheet, panel: int, case: Case):
    """Stress and contact spectra, normalised so that both tend to one curve where they are alike."""
    f, waves = case.area, case.wave_unit
    for name, square, colour, style in (("stress", case.load**2, RED, "-"), ("contact", f**2, BLUE, "--")):
        q, value, _ = case.spectrum(name)
        label = {"stress": r"$\sigma$: stress", "contact": r"$\Theta(\sigma)$: contact"}[name]
        sheet.curve(panel, q / waves, f * value / ((1 - f) * square), label, color=colour, ls=style)
    shortest = case.results.lengths[0] / case.wavelengths[0] if case.hurst is not None else None
    axes = sheet.panels[panel]
    if shortest and shortest < axes.get_xlim()[1] * 0.95:
        axes.axvline(shortest, color=GREY, lw=0.8, ls=":")
    sheet.label(panel, "waves per cell, qL/2π", r"$f_c\,|\tilde f(q)|^2\,/\,(1-f_c)\,|\tilde f(0)|^2$", "spectra",
                scale="log")  # fmt: skip


def make(folders: list[Path], output: Path) -> Findings:
    """Three panels of the last load of the first folder: quickstart.png, .pdf, .csv."""
    case = cases(folders[:1])[-1]
    sheet = Sheet(1, 3, size=(11.5, 3.5))
    draw_surface(sheet.panels[0], case)
    draw_distribution(sheet, 1, case)
    draw_spectra(sheet, 2, case)
    findings = Findings()
    findings.add("mean pressure", case.load)
    findings.add("contact area f_c", case.area)
    findings.add("contact area, corrected", case.corrected_area)
    findings.add("κ = f_c E' g/p̄", case.number("kappa"))
    findings.add("κ, corrected", case.number("kappa") * case.corrected_area / case.area)
    findings.add("certified error", case.number("certified_error"))
    findings.add("transforms", case.number("transforms"))
    findings.add("seconds of the relaxation", case.number("seconds"))
    return plotting.finish(sheet, output, "quickstart", findings)


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    return plotting.command_line(make, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())

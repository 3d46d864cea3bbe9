"""Elastic energy by scale: the share of waves up to q, with Persson's theory.

A mode of the stress holds ½ |σ̃|²/stiffness(q) per area.  Modes are summed one by one from the field pressure, or else
bin by bin from the spectra, with the mean q of each bin.  Spectra end at the surface's shortest wave; a note says what
share of the energy their bins hold.
"""

import numpy as np
from choosing import AREAS, near
from plotting import BLACK, Sheet, limited, standard_error, style
from reading import Load
from samples import Ensemble, common_bins, ensembles

from pgfmd.observables import binning
from pgfmd.theory import persson

CAPTION = """(a) Share of waves up to q in the elastic energy. (b) Elastic energy per factor of e in q, over its
sum. Filled symbols: simulation, with standard errors over seeds; lines with open symbols: Persson's theory at the same
load, over the simulation's energy."""
NEEDS = ("spectra", "load", "roughness")
OPTIONS = AREAS


def draw(loads: list[Load], areas: tuple[float, ...] = ()) -> Sheet:
    """Cumulative and differential energy of each setting and load."""
    sheet = Sheet(1, 2)
    for number, group in enumerate(limited(ensembles(near(loads, areas)), sheet)):
        name, label = group.name, group.label or "simulation"
        totals = np.array([load.number("elastic_energy") for load in group])
        q, energy = common_bins([energies(load) for load in group])
        theory = np.array([persson_energies(load, q) for load in group]) / totals[:, None]
        shares = energy / totals[:, None]
        x, width = q / group.q_unit, np.gradient(np.log(q))
        for panel, part in ((0, np.cumsum), (1, lambda values, axis, width=width: values / width)):
            measured, expected = part(shares, axis=1), part(theory, axis=1)
            look = {**style(number), "ls": "none", "ms": 2.4}
            sheet.curve(panel, x, measured.mean(axis=0), label, error=standard_error(measured), **look)
            sheet.curve(panel, x, expected.mean(axis=0), f"Persson, {name}", label=False, lw=0.9, markevery=(5, 10),
                        **look | {"ls": "-", "mfc": "white"})  # fmt: skip
        report(sheet, group, name, shares, theory)
    sheet.panels[0].plot([], [], color=BLACK, marker="o", ms=2.4, mfc="white", lw=0.9, label="Persson")
    sheet.label(0, r"$q\,/\,q_l$", "energy up to $q$ / total", scale="semilogx", columns=4, legend="figure")
    sheet.label(1, r"$q\,/\,q_l$", r"$\mathrm{d}E\,/\,\mathrm{d}\ln q$ / total", scale="semilogx", legend=False)
    return sheet


def energies(load: Load) -> tuple[np.ndarray, np.ndarray]:
    """Mean q of each bin, and the elastic energy per area of all its modes together: (m,) each."""
    if "pressure" not in load.fields:
        q, stress, count = load.spectrum("stress")
        return q, count * stress / (2 * load.stiffness(q))
    cell = load.results.shape, load.results.lengths
    q, mean, count = load.weighted_spectrum("stress", lambda q: 0.5 / load.stiffness(q), binning.bin_edges(*cell))
    return q, count * mean


def persson_energies(load: Load, q: np.ndarray) -> np.ndarray:
    """The same of Persson's theory, in bins of these mean q; the heights' bins are put into the nearest of them."""
    q_height, height, count = load.spectrum("height")
    stress = persson.stress_spectrum(load.mean_pressure, q_height, height, count, contact_modulus=load.modulus)
    nearest = np.abs(np.log(q_height)[:, None] - np.log(q)).argmin(axis=1)
    return np.bincount(nearest, count * stress / (2 * load.stiffness(q_height)), minlength=len(q))


def report(sheet: Sheet, group: Ensemble, name: str, shares: np.ndarray, theory: np.ndarray):
    """The sum over all scales against the energy of the table, and theory's."""
    total = shares.sum(axis=1)
    sheet.findings.add(f"sum over scales / elastic energy of the run, {name}", total)
    sheet.findings.add(f"Persson's energy / that of the run, {name}", theory.sum(axis=1))
    if any("pressure" not in load.fields for load in group):
        sheet.notes.append(f"{name}: from spectra, whose bins hold {100 * total.mean():.1f} % of the energy")

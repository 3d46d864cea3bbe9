"""Force against approach of adhesive contacts, loading and unloading, beside JKR, DMT and Maugis.

For a paraboloid the theories are drawn, shifted by what the images in a periodic cell move it.
"""

import math

import numpy as np
from plotting import BLACK, GREY, Sheet, style
from reading import Load
from samples import by_run

from pgfmd.errors import InputError
from pgfmd.theory import adhesion
from pgfmd.theory.hertz import LATTICE_SUM_1

CAPTION = """(a) Force against displacement; filled: loading, open: unloading. Where a branch ends, the contact jumps:
vertical lines. (b) Points that touch. Lines: the theories of Johnson, Kendall and Roberts (JKR), of Derjaguin, Muller
and Toporov (DMT), and of Maugis."""
NEEDS = ("attraction",)


def draw(loads: list[Load]) -> Sheet:
    """Both branches of each run; the pull-off force and the loss of each cycle."""
    sheet = Sheet(1, 2)
    for number, run in enumerate(by_run(loads).values()):
        name = run[0].folder
        unit, label = scale(run[0])
        x = np.array([load.number("displacement") for load in run])
        force = np.array([load.mean_pressure for load in run]) / unit
        area = np.array([load.area for load in run])
        turn = int(np.argmax(x))
        for part, filled in ((slice(0, turn + 1), True), (slice(turn, None), False)):
            if len(x[part]) > 1 or filled:
                sheet.curve(0, x[part], force[part], name, label=filled, **style(number, filled=filled))
                sheet.curve(1, x[part], area[part], name, label=False, **style(number, filled=filled))
        before = np.array([load.number("pressure_before_jump") for load in run]) / unit
        after = np.array([load.number("pressure_after_jump") for load in run]) / unit
        for place, *ends in zip([load.number("jump_to") for load in run], before, after, strict=True):
            if math.isfinite(place) and run[0].target[0] == "displacement":
                sheet.curve(0, [place, place], ends, "jump", label=False, color=GREY, ls=":", lw=0.8)
        tension = -min([*force, *before[np.isfinite(before)]])
        sheet.findings.add(f"pull-off force ({label}), {name}", [float(tension)])
        loss = sum(load.number("energy_drop") for load in run)
        sheet.findings.add(f"energy lost per area, {name}", [float(loss)])
        if run[0].job["surface"]["kind"] == "paraboloid" and number == 0:
            draw_theory(sheet, run[0], x, unit)
    sheet.label(0, "displacement", label, legend="figure", columns=4)
    sheet.label(1, "displacement", "contact area $f_c$", legend=False)
    return sheet


def scale(load: Load) -> tuple[float, str]:
    """The pressure that counts 1, and the label: πwR over the cell for a paraboloid, else E'."""
    if load.job["surface"]["kind"] != "paraboloid":
        return load.modulus, "mean pressure / $E'$"
    wall, radius = load.job["wall"], load.job["surface"]["radius"]
    if "work" not in wall:
        raise InputError("force_approach: of paraboloids the work of adhesion must be a key of the wall")
    return math.pi * wall["work"] * radius / math.prod(load.results.lengths), r"force / $\pi w R$"


def draw_theory(sheet: Sheet, load: Load, shown: np.ndarray, unit: float) -> None:
    """JKR, DMT and Maugis where the runs have displacements."""
    wall, radius, modulus = load.job["wall"], float(load.job["surface"]["radius"]), load.modulus
    work, length = wall["work"], wall["range"]
    mu = adhesion.transition(work, length, radius, modulus)
    factor = adhesion.EXPONENTIAL if wall["kind"] == "adhesive" else adhesion.CONSTANT
    cell = max(load.results.lengths)
    images = 0.0 if load.open else LATTICE_SUM_1
    a = np.geomspace(1e-3, 1, 400) * math.sqrt(radius * (abs(shown).max() + 4 * length) * 2)
    cases = {
        "JKR": (adhesion.jkr(a, work, radius, modulus), BLACK, "-"),
        "DMT": (adhesion.dmt(a, work, radius, modulus), GREY, "-"),
        f"Maugis, λ = {factor * mu:.2g}": (adhesion.maugis(a, factor * mu, work, radius, modulus), BLACK, "--"),
    }
    for name, (curve, colour, line) in cases.items():
        x = curve.approach + curve.force * images / (math.pi * modulus * cell)
        inside = (x >= shown.min()) & (x <= shown.max())
        sheet.curve(0, x[inside], curve.force[inside] / unit / cell**2, name, color=colour, ls=line, lw=0.8)
        sheet.curve(1, x[inside], math.pi * a[inside] ** 2 / cell**2, name, label=False, color=colour, ls=line, lw=0.8)
    sheet.findings.add(f"pull-off force of the exact table, μ_T = {mu:.3g}", [adhesion.pull_off(mu)])

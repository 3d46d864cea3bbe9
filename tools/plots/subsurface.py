"""Subsurface stress: von Mises' stress as a function of depth, and where it is largest."""

from maps import show_field, thinned, unit_text
from plotting import COLOURS, Sheet, limited
from reading import Load
from samples import ensembles

CAPTION = """(a) Von Mises' stress divided by the mean pressure on the contact, as a function of the depth divided by
the shortest wavelength of the surface: the largest (full lines) and the rms value (dashed) at each depth. (b) The last
load, at the depth where it is largest."""
NEEDS = ("load", "area", "subsurface")


def draw(loads: list[Load]) -> Sheet:
    """The profiles of all loads; the field of the last load that kept it."""
    sheet = Sheet(1, 2)
    for colour, group in zip(COLOURS, limited(ensembles(loads), sheet), strict=False):
        load = group.loads[0]  # of several seeds the first
        profile, shortest = load.groups["subsurface"], load.wavelengths[0]
        for name, dashes in (("max", "-"), ("rms", "--")):
            value = profile[f"von_mises_{name}"] / load.contact_pressure
            shown = (group.label or True) if name == "max" and len(loads) > 1 else False
            depth, curve = profile["depth"] / shortest, f"{group.name}, {name}"
            sheet.curve(0, depth, value, curve, label=shown, color=colour, ls=dashes)
        sheet.findings.add(f"largest over the pressure on the contact, {group.name}",
                           [each.number("von_mises_max") / each.contact_pressure for each in group])  # fmt: skip
    sheet.label(0, r"depth $/\,\lambda_s$", r"$\sigma_\mathrm{vM}\,/\,\sigma_c$", scale="log", columns=2)
    shown = [load for load in loads if "von_mises" in load.fields]
    if shown:
        unit = unit_text(shown[-1], "pressure")
        label = r"$\sigma_\mathrm{vM}$" + (f" / {unit}" if unit else "")
        show_field(sheet, 1, shown[-1], thinned(shown[-1], "von_mises"), label, cmap="inferno")
    else:
        sheet.drop(1, 'no field "von_mises" was kept')
    return sheet

"""Which loads a figure is drawn of: those that have what it needs, by what was imposed, or by contact area.  No MPI."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from reading import Load

from pgfmd.errors import InputError

# What a figure can need of a load: name → (whether the load has it, what the job must ask for).
NEEDS: dict[str, tuple[Callable[[Load], bool], str]] = {
    "histogram": (lambda load: {"pressure_histogram", "pressure_moments"} <= load.kept, 'observable "histogram"'),
    "spectra": (
        lambda load: "stress_spectrum" in load.kept or {"height", "pressure"} <= load.fields,
        'observable "spectra", or fields "height" and "pressure"',
    ),
    "correlations": (
        lambda load: "stress_acf" in load.kept or ("pressure" in load.fields and load.law == "hard"),
        'observable "acf", or (hard walls) field "pressure"',
    ),
    "two dimensions": (lambda load: min(load.results.shape) > 1, "more than one point along x and along y"),
    "patches": (lambda load: "patches" in load.kept, 'observable "patches"'),
    "bearing": (lambda load: "bearing_spectrum" in load.kept, 'observables "spectra" and "bearing"'),
    "height": (lambda load: "height" in load.fields, 'field "height"'),
    "pressure": (lambda load: "pressure" in load.fields, 'field "pressure"'),
    "area": (lambda load: load.area > 0, "a contact area above zero"),
    "partial contact": (lambda load: 0 < load.area < 1, "a contact area between zero and one"),
    "load": (lambda load: load.mean_pressure > 0, "a load above zero"),
    "attraction": (lambda load: "energy_drop" in load.results.loads, "a wall that attracts"),
    "percolation": (lambda load: "percolation" in load.kept, 'observable "percolation"'),
    "leakage": (lambda load: "leakage" in load.kept, 'observable "leakage"'),
    "partial slip": (lambda load: math.isfinite(load.number("stick_area")), 'observable "partial_slip"'),
    "subsurface": (lambda load: "subsurface" in load.kept, 'observable "subsurface"'),
    "exponential wall": (lambda load: load.law == "exponential", 'wall.kind = "exponential"'),
    "roughness": (lambda load: load.rms_slope > 0, "a surface that is not flat"),
    "self-affine": (lambda load: load.hurst is not None, 'surface.kind = "self-affine"'),
}

# Options that several figures have.
AREAS = {"--areas": {"type": float, "nargs": "+", "help": "only the loads near these contact areas"}}
WINDOW = {"--window": {"type": float, "nargs": 2, "metavar": ("FROM", "TO"), "help": "fit range in q/q_l"}}


def suitable(found: Sequence[Load], needs: Sequence[str], figure: str) -> tuple[list[Load], list[str]]:
    """The loads that have all a figure needs, and a line for each reason why others were left out.

    Raises InputError, with the first reason, if none is left.
    """
    reasons: dict[str, list[str]] = {}
    kept = []
    for load in found:
        lacking = next((need for need in needs if not NEEDS[need][0](load)), None)
        if lacking is None:
            kept.append(load)
        else:
            names = reasons.setdefault(NEEDS[lacking][1], [])
            if load.folder not in names:
                names.append(load.folder)
    lines = [f"{figure} needs {reason}: missing in {_listed(names)}" for reason, names in reasons.items()]
    if not kept:
        raise InputError(lines[0])
    return kept, lines


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def imposed(found: Sequence[Load], targets: Sequence[float]) -> list[Load]:
    """The loads whose imposed value is one of the targets (none given: all).  Raises InputError if there is none."""
    chosen = [load for load in found if not targets or any(math.isclose(load.target[1], t) for t in targets)]
    if not chosen:
        raise InputError(f"no load was imposed as {', '.join(f'{t:g}' for t in targets)} in the folders given")
    return chosen


def near(found: Iterable[Load], areas: Sequence[float], slack: float = 0.1) -> list[Load]:
    """For each area, of each folder the load whose contact area is nearest, if it is within `slack` relatively; all
    loads if no area is given.

    Raises InputError if there is none for one of the areas.
    """
    chosen: list[Load] = []
    found = list(found)
    if not areas:
        return found
    for area in areas:
        best: dict[Path, Load] = {}
        for load in found:
            if math.isfinite(load.area):
                old = best.get(load.results.directory)
                if old is None or abs(load.area - area) < abs(old.area - area):
                    best[load.results.directory] = load
        fitting = [load for load in best.values() if abs(load.area / area - 1) <= slack]
        if not fitting:
            raise InputError(f"no load with a contact area near {area:g} in the folders given")
        chosen += [load for load in fitting if load not in chosen]
    return chosen

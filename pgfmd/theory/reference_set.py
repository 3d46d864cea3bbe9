"""The reference set: contacts of self-affine surfaces with errors, which `jobs/reference.sh` makes."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from scipy.interpolate import PchipInterpolator

from pgfmd.errors import InputError

Rows = Sequence[Mapping[str, float]]
NUMBERS = ("area", "kappa", "gap", "energy", "square_pressure")


@dataclass(frozen=True)
class Reference:
    """A number of the reference set: its mean over surfaces.

    error: by solver, grid and interpolation together;  scatter: standard error of the mean over the surfaces.
    """

    value: float
    error: float
    scatter: float


def reference(hurst: float, scales: float, pressure: float, rolloff: float = 4) -> dict[str, Reference]:
    """Numbers of the contact of a half-space with a hard self-affine surface, without friction and adhesion.

    hurst: H;  scales: λ_r/λ_s;  rolloff: λ_l/λ_r, one of those of the set, with λ_l the side of the periodic cell;
    pressure: p̄/(E'g), with g the rms slope.  "area" is the relative contact area, "kappa" area over pressure, "gap" the
    mean gap over gλ_l, "energy" the elastic energy per area over E'g²λ_l, "square_pressure" ⟨p²⟩ over (E'g)².

    Logarithms are interpolated, piecewise cubic in ln p̄ and H, linear in ln(λ_r/λ_s).  The error includes the
    difference between cubic and linear interpolation.  Raises InputError outside of the set.

    >>> import pgfmd
    >>> area = pgfmd.reference(hurst=0.8, scales=16, pressure=0.02)["area"]
    >>> 0.03 < area.value < 0.06
    True
    """
    table = _table()
    rolloffs = sorted({row["rolloff"] for row in table})
    if rolloff not in rolloffs:
        raise InputError(f"rolloff = {rolloff:g}: must be one of {', '.join(f'{each:g}' for each in rolloffs)}")
    table = tuple(row for row in table if row["rolloff"] == rolloff)
    for name, value in (("hurst", hurst), ("scales", scales), ("pressure", pressure)):
        low, high = (end(row[name] for row in table) for end in (min, max))
        if not low <= value <= high:
            raise InputError(f"{name} = {value:g}: must lie between {low:g} and {high:g} for rolloff = {rolloff:g}")
    return {name: _interpolated(table, name, hurst, scales, pressure) for name in NUMBERS}


@cache
def _table() -> tuple[dict[str, float], ...]:
    """The rows of the set."""
    text = files("pgfmd.theory").joinpath("reference.csv").read_text(encoding="utf-8")
    return tuple({name: float(value) for name, value in row.items()} for row in csv.DictReader(text.splitlines()))


def _interpolated(rows: Rows, name: str, hurst: float, scales: float, pressure: float) -> Reference:
    at_scales, exponents = [], sorted({row["hurst"] for row in rows})
    for each in sorted({row["scales"] for row in rows}):
        at_hurst = []
        for h in exponents:
            curve = [row for row in rows if row["scales"] == each and row["hurst"] == h]
            pressures = [float(np.log(row["pressure"])) for row in curve]
            at_hurst.append(_between(pressures, _logarithms(curve, name), float(np.log(pressure))))
        at_scales.append(_between(exponents, np.array(at_hurst), hurst))
    keys = [float(np.log(each)) for each in sorted({row["scales"] for row in rows})]
    logarithm, error, scatter = (float(np.interp(np.log(scales), keys, column)) for column in np.array(at_scales).T)
    value = float(np.exp(logarithm))
    return Reference(value, value * error, value * scatter)


def _logarithms(rows: Rows, name: str) -> np.ndarray:
    """(m, 3): logarithm of the value, and relative error and scatter."""
    values = np.array([[row[name], row[f"{name}_error"], row[f"{name}_scatter"]] for row in rows])
    return np.column_stack([np.log(values[:, 0]), values[:, 1:] / values[:, :1]])


def _between(keys: list[float], columns: np.ndarray, at: float) -> tuple[float, float, float]:
    """Logarithm, error and scatter at a key; the error includes the difference of cubic and linear interpolation."""
    linear, error, scatter = (float(np.interp(at, keys, column)) for column in columns.T)
    cubic = float(PchipInterpolator(keys, columns[:, 0])(at))
    return cubic, float(np.hypot(error, cubic - linear)), scatter

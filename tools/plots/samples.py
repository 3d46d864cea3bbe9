"""Which loads are samples of one physical setting, and how settings differ.  No MPI."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reading import CONTROLS, Load

from pgfmd.errors import InputError
from pgfmd.options.text import printable

# Keys of a job in which loads of one physical setting may differ.
ACCIDENTAL = ("surface.seed", "load.", "solver.", "output.", "run.")
SYMBOLS = {
    "surface.hurst": "H", "surface.lambda_s": "λ_s", "surface.lambda_l": "λ_l", "surface.lambda_r": "λ_r",
    "surface.rms_slope": "ḡ", "wall.zeta": "ζ", "grid.n": "n", "solid.thickness": "d/L", "solid.contact_modulus": "E'",
    "wall.hardness": "σ_Y", "surface.kind": "surface", "wall.kind": "wall", "solid.base": "base",
}  # fmt: skip
# Keys that follow from others: said only if nothing else differs.
DERIVED = ("grid.spacing", "grid.length", "solid.lame_lambda", "solid.lame_mu", "solid.young", "wall.sigma_ref")


@dataclass(frozen=True)
class Ensemble:
    """Loads that differ by the seed alone: samples of one physical setting.

    label: how it differs from the others, for legends (empty if it does not); name: the same for tables, with the load
    as imposed.
    """

    loads: tuple[Load, ...]
    label: str = ""
    name: str = "simulation"

    def __iter__(self):
        return iter(self.loads)

    def __len__(self) -> int:
        return len(self.loads)

    def __getattr__(self, name: str):
        """Properties of the first load, for those that all share: hurst, zeta, q_unit, …"""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.loads[0], name)

    def mean(self, name: str) -> float:
        """Mean over the loads of a number or property, e.g. "area"."""
        return float(np.mean([getattr(load, name) for load in self.loads]))


def ensembles(found: Iterable[Load], *, by_load: bool = True) -> list[Ensemble]:
    """Loads put together that differ by the seed alone (and, unless `by_load`, by the load), in the order of settings.

    Labels name what differs between the ensembles.
    """
    groups: dict[tuple, list[Load]] = {}
    for load in found:
        target = load.target if by_load else ()
        key = tuple(sorted((name, str(value)) for name, value in setting(load).items()))
        groups.setdefault((key, target), []).append(load)
    members = sorted(groups.values(), key=lambda group: (_order(group[0]), group[0].mean_pressure))
    several = by_load and len({target for _, target in groups}) > 1
    found = []
    for group, differences in zip(members, named_differences([setting(group[0]) for group in members]), strict=True):
        asked = [imposed(group[0])] * by_load
        labels = [", ".join([*differences, *[text] * several]) for text in (_area(group), _pressure(group))]
        found.append((tuple(group), labels, ", ".join([*differences, *asked]) or "simulation"))
    chosen = len({labels[0] for _, labels, _ in found}) < len(found)  # equal areas: loads are told by their pressures
    return [Ensemble(group, labels[chosen], name) for group, labels, name in found]


def named_differences(settings: Sequence[dict]) -> list[list[str]]:
    """What each setting has that not all share, e.g. ["H = 0.3", "λ_s = 8"]."""
    keys = [key for key in dict.fromkeys(k for s in settings for k in s) if _differs(key, settings)]
    keys = [key for key in keys if key not in DERIVED] or keys
    return [[_named(key, values[key]) for key in keys if key in values] for values in settings]


def imposed(load: Load) -> str:
    """The quantity that the job imposed at this load, e.g. "p̄ = 0.01"."""
    control, target = load.target
    return f"{CONTROLS[control]} = {target:g}"


def _differs(key: str, settings: Sequence[dict]) -> bool:
    """Whether those settings that have the key differ in it: H does not tell a rough surface from one in a file."""
    return len({str(setting[key]) for setting in settings if key in setting}) > 1


def setting(load: Load) -> dict[str, object]:
    """What tells the physical setting of a load: dotted key → value, without the seed and the list of loads."""
    flat: dict[str, object] = {}
    tables = dict(load.job)
    while tables:
        name, value = tables.popitem()
        if isinstance(value, dict):
            tables |= {f"{name}.{key}": entry for key, entry in value.items()}
        elif not name.startswith(ACCIDENTAL):
            flat[name] = value
    flat.setdefault("solid.kind", "homogeneous")  # which older results do not say
    thickness = flat.get("solid.thickness", math.inf)
    if isinstance(thickness, float | int) and math.isfinite(thickness):
        flat["solid.thickness"] = float(thickness) / max(load.results.lengths)  # cells of any size compare
    return dict(sorted(flat.items()))


def difference(group: Sequence[Load]) -> str | None:
    """The first key, other than the grid's, by which the settings of loads differ; None if they are one problem."""
    known = ("grid.", "surface.lambda", "surface.path", "surface.dataset")
    settings = [{k: str(v) for k, v in setting(load).items() if not k.startswith(known)} for load in group]
    for key in dict.fromkeys(key for each in settings for key in each):
        if len({each.get(key) for each in settings}) > 1:
            return key
    return None


def by_run(loads: Iterable[Load]) -> dict[Path, list[Load]]:
    """Loads by the folder of their run, in their order."""
    runs: dict[Path, list[Load]] = {}
    for load in loads:
        runs.setdefault(load.results.directory, []).append(load)
    return runs


def _order(load: Load) -> tuple:
    return load.hurst or 0.0, load.zeta or 0.0, load.wavelengths[0], load.results.shape, load.folder * (not load.hurst)


def _named(key: str, value) -> str:
    if key == "surface.path":
        return printable(Path(str(value)).name, 30).replace("$", "?")  # no formula for the figures
    if isinstance(value, list) and len(set(map(str, value))) == 1:
        value = value[0]
    shown = (
        f"{value:g}" if isinstance(value, float | int) and not isinstance(value, bool) else printable(str(value), 30)
    )
    return f"{SYMBOLS.get(key, key)} = {shown}"


def _area(group: Sequence[Load]) -> str:
    areas = [load.area for load in group]
    return f"f_c = {float(np.mean(areas)):.3g}" if all(map(math.isfinite, areas)) else _pressure(group)


def _pressure(group: Sequence[Load]) -> str:
    return f"p̄ = {float(np.mean([load.mean_pressure for load in group])):.3g}"


def common_bins(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Curves (x, y) of equal grids as x (m,) and y (curves, m).  Raises InputError if the grids differ."""
    x = curves[0][0]
    if any(other.shape != x.shape or not np.allclose(other, x) for other, _ in curves):
        raise InputError("the folders hold curves on different bins; give runs of one grid")
    return x, np.array([y for _, y in curves])

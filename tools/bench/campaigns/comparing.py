"""Answers on several ranks beside those on one: fields, columns of the table of loads, datasets of observables."""

import numpy as np

from campaigns.judging import Answer
from campaigns.random_case import REFUSED, UNCERTIFIED, UNJUDGED, WRONG, kind

SAME = 1e-6  # relative distance of two pressures from which what follows from them is not compared
CARRIED = 1e3  # times that distance: how far numbers of the same contact may be apart, besides ROUNDING
ROUNDING = 1e-6  # fits end at the root of that of doubles
MOVED = 4  # points that rounding may move to the next bin
EFFORT = {"iterations", "transforms", "seconds", "labellings", "max_violation", "stick_violation", "newton_steps",
          "trials_refused", "inner_applications", "residual", "gap_bound", "bound", "least_curvature"}  # fmt: skip
LENGTHS = ("mean_gap", "displacement", "constriction_x", "constriction_y")  # small differences of heights
PLACES = ("row", "column", "von_mises_depth")  # of extremes, which several points may share


def compare(one: tuple, many: tuple, wall: dict | None = None) -> str:
    """What differs between (verdict, detail, answers) on one rank and on several; empty if nothing does.  wall: whose
    work and largest attraction energies and pressures count beside.
    """
    if one[0] != many[0]:
        doubtful = {one[0], many[0]} <= {UNCERTIFIED, UNJUDGED, "right"}  # at the limit of rounding
        return "" if doubtful else f"ends differently: {one[:2]} on one rank, {many[:2]} on several"
    if one[0] == REFUSED and kind(*one[:2]) != kind(*many[:2]):
        return f"other words: {one[1]!r} on one rank, {many[1]!r} on several"
    if one[0] in (WRONG, REFUSED, UNCERTIFIED):
        return ""
    if len(one[2]) != len(many[2]):
        return f"{len(one[2])} loads on one rank, {len(many[2])} on several"
    work = (wall or {}).get("work", 0.0)
    scales = {"elastic_energy": work, "energy": work, "mean_pressure": work / (wall or {}).get("range", 1.0)}
    return next(filter(None, (_different(a, b, scales) for a, b in zip(one[2], many[2], strict=True))), "")


def _different(one: Answer, many: Answer, scales: dict[str, float]) -> str:
    """What differs between two answers."""
    if one.pressure is None or many.pressure is None:
        return ""
    size = np.linalg.norm(one.pressure)
    apart = np.linalg.norm(many.pressure - one.pressure) / (size if size > 0 else 1)
    certified = abs(one.certified_error) + abs(many.certified_error)
    if not apart <= max(SAME, 1e2 * np.sqrt(certified if np.isfinite(certified) else 1.0)):
        return f"pressures are {apart:.1e} apart"
    same = np.array_equal(one.pressure > 0, many.pressure > 0) and np.array_equal(one.gap > 0, many.gap > 0)
    if apart > SAME or not same:
        return ""
    room = ROUNDING + CARRIED * apart
    columns = {"loads": (one.columns, many.columns)}
    groups = columns | {name: (one.groups[name], many.groups.get(name, {})) for name in one.groups}
    if set(one.groups) != set(many.groups):
        return f"groups {sorted(set(one.groups) ^ set(many.groups))} on one side only"
    for name, (first, second) in groups.items():
        for key in first:
            if wrong := _apart(key, first, second, (room, max(one.relief * (key in LENGTHS), scales.get(key, 0.0)))):
                return f"{name}: {key} {wrong}"
    return ""


def _apart(key: str, first: dict, second: dict, allowed: tuple[float, float]) -> str:
    """How one dataset of a group differs."""
    room, least = allowed
    if key in EFFORT or key.endswith((*PLACES, "_error")):
        return ""
    a, b = np.asarray(first[key]), np.asarray(second.get(key, np.nan))
    if a.shape != b.shape or a.dtype != b.dtype:
        return f"{a.dtype}{a.shape} and {b.dtype}{b.shape}"
    if key == "count" and a.dtype.kind == "i":
        return "" if np.abs(a - b).sum() <= 2 * MOVED else f"{a} and {b}"
    if key == "density":
        return ""
    if key in ("lower", "upper"):  # bounds of one number: the intervals overlap
        off = np.asarray(first["lower"]) - second["upper"], np.asarray(second["lower"]) - first["upper"]
        return "" if np.all(np.nanmax(off, axis=0) <= room * np.abs(a)) else f"of {first} and {second} do not overlap"
    if a.dtype.kind != "f":
        return "" if np.array_equal(a, b) else f"{a} and {b}"
    if not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return f"{a} and {b}"
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    given = np.abs(np.asarray(first.get(f"{key}_error", 0.0)) + np.asarray(second.get(f"{key}_error", 0.0)))
    width = float(np.max(given, initial=0.0, where=np.isfinite(given)))
    size = max(np.abs(a).max(initial=0.0), least)
    off = np.abs(a - b).max(initial=0.0)
    return "" if off <= room * size + 1.01 * width else f"differs by {off / size:.1e}: {a} and {b}"

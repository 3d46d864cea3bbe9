"""Checks answers against the slow reference (tests/reference.py)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import reference

from campaigns import walls
from campaigns.random_case import RIGHT, UNJUDGED, WRONG
from pgfmd.grid.domain import OPEN

AREA_PIXEL = 1.0  # pixels by which an area may miss, whatever area_tolerance says: README
JUMP = 1e-4  # relative width of the loads across which an area jumps
ROUNDING_OF_ONE = 2.3e-16
THIN = 0.01  # thickness over the diagonal below which the reference does not sum a slab's kernel
ROUNDING = 1e-12  # of sums over the grid, relative to their largest terms
FLOOR = 1e-30  # relative energy error of a double's last digit
IMPOSED = (*reference.CONTROLS, "force")


@dataclass
class Answer:
    """One load as pgfmd answers it; fields (nx, ny)."""

    mean_pressure: float
    contact_area: float
    mean_gap: float
    elastic_energy: float
    certified_error: float
    pressure: np.ndarray
    gap: np.ndarray
    target: float | None = None
    groups: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)  # what observables measured
    columns: dict[str, float] = field(default_factory=dict)  # of the table of loads
    relief: float = 0.0  # range of the heights, if they are known


def control_of(job: dict) -> str:
    """The key of [load] that says what is imposed."""
    return next(name for name in (*IMPOSED, "percolation") if name in job["load"])


def judge(job: dict, heights: np.ndarray | None, answers: list[Answer], table: np.ndarray | None = None):
    """(verdict, what is wrong) of the answers to an effective job; table (2, 2): q and F of such a solid."""
    if wrong := next(filter(None, map(wrong_groups, answers)), ""):
        return WRONG, wrong
    attracts = job["wall"]["kind"] in walls.ATTRACTIVE
    is_open = job["grid"].get("boundary") == "open"
    if not answers:
        return UNJUDGED, "no load was solved"
    if attracts or is_open and job["solid"].get("kind", "homogeneous") != "homogeneous":
        traction = walls.tension(job["wall"]) if attracts else 0.0
        if wrong := next(filter(None, (wrong_feasible(job, each, traction) for each in answers)), ""):
            return WRONG, wrong
        if is_open:
            return UNJUDGED, "no reference: only feasible pressures were checked"
    control = control_of(job)
    if heights is None or answers[0].pressure is None or job.get("output", {}).get("precision") == "float32":
        for answer in answers:
            values = [getattr(answer, name) for name in ("mean_pressure", "mean_gap", "elastic_energy")]
            certified = attracts or 0 <= answer.certified_error <= job["solver"]["tolerance"]
            if not all(map(math.isfinite, values)) or not certified:
                return WRONG, f"numbers {values}, certified {answer.certified_error}"
        return UNJUDGED, "fields that are needed were not asked for"
    if wrong := wrong_heights(job, heights):
        return WRONG, wrong
    solid = job["solid"]
    n = job["grid"]["n"]
    cell = job["grid"]
    spacings = cell.get("spacing") or [a / count for a, count in zip(cell.get("length", n), n, strict=True)]
    if cell.get("refine", 1) > 1:
        n, spacings = list(heights.shape), [a / cell["refine"] for a in spacings]
    slab = reference.Solid(solid["contact_modulus"], solid.get("thickness", math.inf), solid.get("base", "free"),
                           solid.get("poisson", 0.25))  # fmt: skip
    if solid.get("kind", "homogeneous") != "homogeneous":
        slab = reference.Solid(solid["contact_modulus"], factor=factor_of(solid, table))
    if is_open:
        d, torus = slab.thickness, OPEN.torus((n[0], n[1]), tuple(spacings))
        if 0.02 * min(map(math.prod, zip(torus, spacings, strict=True))) < d < 3 * max(spacings):
            # `open_kernel.layer_table` takes the modes of a torus on which the slab is thin.
            nx, ny = (max(count, math.ceil(1.01 * d / (0.04 * a))) for count, a in zip(n, spacings, strict=True))
            torus = OPEN.torus((nx, ny), tuple(spacings))
        if 3 * max(spacings) <= d < THIN * math.hypot(*(a * count for a, count in zip(spacings, n, strict=True))):
            return UNJUDGED, "the reference does not sum so many oscillations"
        contact: reference.Contact = reference.OpenContact(heights, tuple(spacings), slab, torus)
    else:
        contact = reference.Contact(heights, tuple(spacings), slab)
    for answer in answers:
        if control == "force":
            target = answer.target / math.prod(a * count for a, count in zip(spacings, n, strict=True))
            near = abs(answer.mean_pressure - target) <= 4 * ROUNDING_OF_ONE * abs(target)
            answer.target = answer.mean_pressure if near else target
        if attracts or job["wall"]["kind"] == "formula":
            wrong = (walls.wrong_attraction if attracts else walls.wrong_formula)(contact, job, control, answer)
            if wrong:
                return WRONG, f"{control} = {answer.target:g}: {wrong}"
        elif wrong := wrong_answer(contact, job, control, answer):
            return WRONG, f"{control} = {answer.target:g}: {wrong}"
    return RIGHT, ""


def factor_of(solid: dict, table: np.ndarray | None) -> Callable[[float], float]:
    """F(q): a power law between the two entries of a table; of a layer, from Navier's equations in 80 digits."""
    if table is not None:
        (first, last), (low, high) = np.log(table.T)
        return lambda q: math.exp(low + (high - low) * min(max((math.log(q) - first) / (last - first), 0.0), 1.0))
    from test_elasticity import direct_factor

    layer = SimpleNamespace(**solid | {"base_modulus": solid["base_modulus"] / solid["contact_modulus"]})
    return lambda q: direct_factor(q * solid["thickness"], layer) if q * solid["thickness"] < 45 else 1.0


def wrong_groups(answer: Answer) -> str:
    """What is wrong with what observables measured: values that are infinite, bounds in the wrong order."""
    for name, group in answer.groups.items():
        bounds = [np.asarray(group[side], float) for side in ("lower", "upper") if side in group]
        if len(bounds) == 2 and np.any(bounds[0] > bounds[1] * (1 + ROUNDING)):
            return f"{name}: bounds {bounds[0]} and {bounds[1]}"
        values = {key: np.asarray(value, float) for key, value in group.items() if np.asarray(value).dtype.kind == "f"}
        infinite = [key for key, value in values.items() if np.isinf(value).any()]
        if infinite and answer.contact_area < 1:  # full contact is rigid: its stiffness is infinite
            return f"{name}: {infinite[0]} is infinite"
    return ""


def wrong_feasible(job: dict, answer: Answer, traction: float) -> str:
    """What is wrong with a pressure, whose attraction is at most `traction`, where nothing else is known."""
    if answer.pressure is None:
        return ""
    mean = float(np.mean(answer.pressure.astype(reference.Real)))
    size = float(np.abs(answer.pressure).max())
    single = job["output"].get("precision") == "float32"
    if not (np.isfinite(answer.pressure).all() and np.isfinite(answer.gap).all()):
        return "not finite"
    room = max(1e-6 * single, ROUNDING) * (size + traction)
    if answer.pressure.min() < -traction - room:
        return f"tension {answer.pressure.min():.6g} beyond {traction:.6g}"
    if abs(mean - answer.mean_pressure) > room:
        return f"mean pressure {answer.mean_pressure!r}, of the field {mean!r}"
    touches = job["wall"]["kind"] not in ("exponential", "formula", "potential")
    if touches and (answer.gap.min() < 0 or np.any(answer.gap[answer.pressure > 0])):
        return "a gap in contact, or overlap"
    return ""


def wrong_heights(job: dict, heights: np.ndarray) -> str:
    """What is wrong with heights of the kinds that have a formula."""
    surface, n = job["surface"], job["grid"]["n"]
    if "second" in surface or job["grid"].get("refine", 1) > 1:
        return ""
    x, y = (np.arange(count)[:, None] / count for count in n)
    if surface["kind"] == "sinusoid":
        waves = surface.get("waves", 1)
        expected = surface["amplitude"] * np.cos(2 * np.pi * waves * x) * np.ones(n[1])
        if surface.get("two_dimensional"):
            expected = expected * np.cos(2 * np.pi * waves * y.T)
    elif surface["kind"] == "paraboloid":
        lengths = job["grid"].get("length") or [
            a * count for a, count in zip(job["grid"].get("spacing", (1, 1)), n, strict=True)
        ]
        expected = -((lengths[0] * (x - 0.5)) ** 2 + (lengths[1] * (y.T - 0.5)) ** 2) / (2 * surface["radius"])
    else:
        return ""
    size = np.abs(expected).max()
    deviation = np.abs(heights - expected).max()
    return f"heights are {deviation / size:.1e} off" if deviation > max(1e-13, single_digit(job)) * size else ""


def single_digit(job: dict) -> float:
    """Relative rounding of fields that are stored in single precision, three of 6e-8 (heights, field, sum); else 0."""
    return 2e-7 if job["solver"].get("storage") == "float32" else 0.0


def wrong_answer(contact: reference.Contact, job: dict, control: str, answer: Answer) -> str:
    """What is wrong with one answer; empty if nothing is."""
    pressure, gap, load = answer.pressure, answer.gap, answer.mean_pressure
    zeta, most = job["wall"].get("zeta"), job["wall"].get("hardness", math.inf)
    numbers = (load, answer.mean_gap, answer.elastic_energy, answer.certified_error)
    if not (np.isfinite(pressure).all() and np.isfinite(gap).all() and all(map(math.isfinite, numbers))):
        return f"not finite: {numbers}"
    if not 0 <= answer.certified_error <= job["solver"]["tolerance"]:
        return f"certified error {answer.certified_error:.3g} for a tolerance of {job['solver']['tolerance']:.3g}"
    digit = max(ROUNDING, single_digit(job))
    if pressure.min() < 0 or abs(float(np.mean(pressure.astype(reference.Real)) / (load or 1) - (load > 0))) > digit:
        return "the load is not carried, or there is tension"
    if pressure.max() > most * (1 + ROUNDING):
        return "more than the hardness"
    if zeta is None and (gap.min() < 0 or np.any(gap[pressure > 0])):
        return "a gap in contact, or overlap"
    if zeta is None and abs(answer.contact_area - np.mean(pressure > 0)) > 1e-14:
        return f"contact area {answer.contact_area}, of the field {np.mean(pressure > 0)}"
    if control in ("pressure", "force") and abs(load / (answer.target or 1) - (answer.target != 0)) > 1e-15:
        return f"mean pressure {load!r} instead of {answer.target!r}"
    if load == 0:
        summit = -contact.heights.mean()
        separation = {"mean_gap": answer.target - summit, "displacement": -answer.target}.get(control, 0)
        size = max(np.ptp(contact.heights), separation) or 1
        wrong = np.abs(gap.ravel() - (separation - contact.heights)).max() / size
        return f"gap without load is {float(wrong):.1e} off" if wrong > max(1e-14, single_digit(job)) else ""
    try:
        sigma_ref = job["wall"].get("sigma_ref")
        carried = pressure.astype(reference.Real).mean()  # of few points that do not yield digits of the load count
        exact = contact.at(load, zeta, sigma_ref) if math.isinf(most) else contact.hard(carried, most)
    except reference.Unable:
        if most < math.inf or contact.bound_of(pressure, zeta) > answer.certified_error * (1 + 1e-6) + FLOOR:
            raise
        return ""
    if most < math.inf:  # the level of gaps may depend on few points
        return wrong_energy(exact, answer, digit)
    wrong = wrong_energy(exact, answer, digit) or wrong_gap(exact, answer, zeta, single_digit(job))
    return wrong or wrong_control(exact, job, control, answer)


def wrong_energy(exact: reference.Solved, answer: Answer, digit: float) -> str:
    """The true error, and the energy."""
    error = exact.error_of(answer.pressure)
    if answer.elastic_energy > 0:  # the reported error is relative to the reported energy
        error *= exact.work / 2 / answer.elastic_energy
    unsure = exact.bound + 2 * np.sqrt(abs(error) * exact.bound)
    if error > answer.certified_error + unsure + FLOOR:
        return f"certified {answer.certified_error:.3g}, true error {float(error):.3g}"
    energy = exact.work / 2
    relative = reference.Real(answer.certified_error) * max(answer.elastic_energy / energy, 1) if energy > 0 else 0
    room = 2 * np.sqrt(2 * relative) + 2 * relative + digit
    if abs(answer.elastic_energy - energy) > room * energy + 1e-323:
        return f"elastic energy {answer.elastic_energy:.17g} instead of {float(energy):.17g}"
    return ""


def wrong_gap(exact: reference.Solved, answer: Answer, zeta, single: float) -> str:
    """Gap and mean gap: an error d of the pressure changes u = Gp anywhere by at most √(G₀₀) ‖d‖, ‖d‖² ≤ 2D, and the
    level of contact, ⟨p, g⟩/P, by (D + ‖p‖ ‖d‖ + ‖d‖²)/P."""
    contact, count = exact.contact, exact.contact.count
    work = exact.scaled_work
    bound = work * (reference.Real(answer.certified_error) + exact.bound)
    change = np.sqrt(2 * bound)
    level = (bound + np.sqrt(work) * change + 2 * bound) / count if zeta is None else change
    size = max(np.ptp(contact.heights), np.abs(exact.gap).max() if zeta else 0)
    # p̄ sums up to 24² pressures in pairs: 10 roundings of 1.1e-16, and 2 digits of the logarithm, each times ζ.
    rounding = (1e-13 + single) * size + 1.5e-15 * (zeta or 0)
    room = 1.5 * (change + level) * exact.unit + rounding
    largest = np.abs(answer.gap.ravel() - exact.gap).max()
    if largest > room + (np.sqrt(2 * bound) * exact.unit if zeta is None else 0):
        return f"gap off by {float(largest / size):.1e} of the height, allowed {float(room / size):.1e}"
    if abs(answer.mean_gap - exact.mean_gap) > room:
        off = abs(answer.mean_gap - exact.mean_gap)
        return f"mean gap off by {float(off / size):.1e} of the height, allowed {float(room / size):.1e}"
    if abs(answer.mean_gap - answer.gap.astype(reference.Real).mean()) > room:
        return f"mean gap {answer.mean_gap!r}, mean of the gap {answer.gap.mean()!r}"
    return ""


def wrong_control(exact: reference.Solved, job: dict, control: str, answer: Answer) -> str:
    """Whether what was imposed was reached, to the tolerance that is stated."""
    if control in ("pressure", "force", "percolation"):
        return ""
    contact = exact.contact
    if control == "contact_area":
        room = max(job["load"].get("area_tolerance", 0.005) * answer.target, AREA_PIXEL / contact.count) * (1 + 1e-9)
        if abs(answer.contact_area - answer.target) <= room:
            return ""
        sides = [contact.hard(answer.mean_pressure * (1 + sign * 3 * JUMP)) for sign in (-1, 1)]
        low, high = (contact.measure(control, side) for side in sides)
        if low <= answer.target <= high:
            return ""
        return f"area {answer.contact_area:.6g}; {low:.6g} and {high:.6g} at neighbouring loads"
    measure = contact.measure(control, exact)
    # load.gap_tolerance is relative to the imposed approach from first contact or, under a hard wall, to the imposed
    # mean gap if that is less; under an exponential wall to ζ if that is more, at most to the rms height.
    summit, zeta = -contact.heights.mean(), job["wall"].get("zeta", 0)
    approach = answer.target if control == "displacement" else summit - answer.target
    free = control == "displacement" and (not contact.wraps or contact.solid.mean_compliance)  # full contact moves on
    bounded = job["wall"]["kind"] == "hard" and not free
    size = max(min(abs(approach), summit - approach) if bounded else abs(approach), zeta)
    size = min(size, contact.rms) if zeta and contact.rms else size
    room = job["load"]["gap_tolerance"] * size * (1 + 1e-6) + 1e-13 * np.ptp(contact.heights)
    if abs(measure - answer.target) > room:
        return f"reached {float(measure):.9g}, {float((measure - answer.target) / room):.1e} tolerances off"
    return ""

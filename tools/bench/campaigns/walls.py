"""Checks of contacts under walls of which the slow reference has no solution: equilibrium, and a bound of the error."""

import math

import numpy as np
import reference
from scipy.special import erf, erfc

ATTRACTIVE = ("adhesive", "dugdale", "potential")
ROUNDING = 2.3e-16  # of one
DIGITS = 1e-9  # relative: what splines, single precision inside, and sums may leave
NAMES = {name: getattr(np, name) for name in ("exp", "expm1", "log", "sqrt", "cosh", "sinh", "tanh")} | {
    "erf": erf, "erfc": erfc, "max": np.maximum, "min": np.minimum, "abs": np.abs, "pi": np.pi}  # fmt: skip


def formula(wall: dict, gap: np.ndarray) -> np.ndarray:
    """p(gap) as written."""
    return eval(wall["pressure"], {"__builtins__": {}}, NAMES | {"gap": gap}) + 0.0 * gap  # noqa: S307


def traction(wall: dict, gap: np.ndarray) -> np.ndarray:
    """The pressure of a wall that attracts at a gap that is open: −dW/dg."""
    if wall["kind"] == "potential":
        return np.where(gap < wall["gaps"][1], formula(wall, np.minimum(gap, wall["gaps"][1])), 0.0)
    x, largest = gap / wall["range"], wall["work"] / wall["range"]
    if wall["kind"] == "adhesive":
        return -largest * np.exp(-x)
    edge = wall.get("edge", 0.0)
    if edge == 0:
        return np.where(x < 1, -largest, 0.0)
    y = np.clip((x - 1) / edge + 0.5, 0, 1)
    return -largest * (1 - 3 * y**2 + 2 * y**3)


def tension(wall: dict) -> float:
    """The largest attraction."""
    if wall["kind"] == "potential":
        nodes, (first, last) = np.linspace(*wall["gaps"], 20001), wall["gaps"]
        lowest, step = nodes[np.argmin(formula(wall, nodes))], (last - first) / 20000
        return float(-formula(wall, np.clip(lowest + step * np.linspace(-1, 1, 20001), first, last)).min())
    return wall["work"] / wall["range"]


def own_numbers(contact: reference.Contact, answer) -> str:
    """Whether mean gap and elastic energy are those of the fields."""
    p = answer.pressure.astype(reference.Real).ravel()
    size = np.abs(answer.gap).max() + np.ptp(contact.heights)
    if abs(answer.mean_gap - answer.gap.astype(reference.Real).mean()) > DIGITS * size:
        return f"mean gap {answer.mean_gap!r}, of the field {answer.gap.mean()!r}"
    return "" if np.isfinite(p).all() and np.isfinite(answer.gap).all() else "not finite"


def wrong_attraction(contact: reference.Contact, job: dict, control: str, answer) -> str:
    """A periodic contact under attraction: the pressure is the law's at each open gap, at least that where it touches;
    the solid's stress of these gaps misses it by no more than the residual that is reported.  Not: that no other state
    has less energy.
    """
    wall, p, gap = job["wall"], answer.pressure.ravel(), answer.gap.ravel()
    least = wall["gaps"][0] if wall["kind"] == "potential" else 0.0
    size, opened = tension(wall) + np.abs(p).max(), gap > least * (1 + DIGITS)
    if gap.min() < least * (1 - DIGITS):
        return "overlap"
    law = traction(wall, gap)
    off = np.where(opened, np.abs(p - law), np.maximum(law - p, 0.0))
    if wall["kind"] == "dugdale" and not wall.get("edge"):
        off[np.abs(gap / wall["range"] - 1) < DIGITS] = 0.0  # where it jumps
    if off.max() > DIGITS * size:
        return f"pressure is {off.max() / size:.1e} off the law's"
    displacement = gap.astype(reference.Real) + contact.heights
    displacement -= displacement.mean()
    stress = contact.stiffness @ displacement / contact.pixel
    force = (p - stress).astype(float)
    digit = ROUNDING * (np.abs(gap).max() + np.ptp(contact.heights))  # of a gap, and the stress of such
    spread = digit * float(np.abs(contact.stiffness).sum(axis=1).max() / contact.pixel)
    residual, rounding = float(np.std(force)), DIGITS * (size + float(np.abs(stress).max())) + spread
    if residual > 1.01 * answer.columns["residual"] + rounding:
        return f"residual {residual:.3g}, reported {answer.columns['residual']:.3g}"
    energy = float(displacement @ stress) / 2 / contact.count
    digits = digit * (4 * np.abs(stress).max() + spread)
    if abs(answer.elastic_energy - energy) > DIGITS * energy + rounding * np.abs(displacement).max() + digits:
        return f"elastic energy {answer.elastic_energy:.12g}, of the gaps {energy:.12g}"
    room = 1.01 * answer.columns["residual"] + rounding
    if control == "pressure" and abs(answer.mean_pressure - answer.target) > room:
        return f"mean pressure {answer.mean_pressure:.9g} instead of {answer.target:.9g}"
    return own_numbers(contact, answer)


def graph(wall: dict, line: tuple[float, float], targets: np.ndarray) -> np.ndarray:
    """The gap at which a p − b g = target, by bisection; p is the formula, any more at the first gap, 0 beyond."""
    low, high = (np.full(targets.shape, float(end)) for end in wall["gaps"])
    for _ in range(120):
        middle = (low + high) / 2
        more = line[0] * formula(wall, middle) - line[1] * middle > targets
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    first, last = wall["gaps"]
    near = 1e-13 * (last - first)  # digits of the ends
    return np.where(high - first <= near, first, np.where(last - low <= near, last, high))


def polished(contact: reference.Contact, wall: dict, p: np.ndarray, level: float):
    """(pressure of the solution, its gap) from an approximation, by Newton's method on p = the graph's where it meets
    c p − g = its argument.  Raises Unable.
    """
    (A, _), count, load = contact.matrices, contact.count, float(p.mean())
    c, (first, last), heights = float(contact.pixel), wall["gaps"], contact.heights.astype(float)
    p = p.astype(float)
    for _ in range(60):
        target = c * p - (A @ p - heights + level)
        gap = graph(wall, (c, 1.0), target)
        step = 1e-6 * (last - first)
        slope = (formula(wall, np.minimum(gap + step, last)) - formula(wall, gap)) / step
        answer = np.maximum((target + gap) / c, 0.0)  # also at the ends, where the graph is vertical
        soft = (gap > first) & (gap < last) & (-c * slope < 1)  # digits of the gap would count more
        answer[soft] = formula(wall, gap[soft])
        rate = np.where((gap <= first) | (gap >= last), 1 / c, slope / (c * slope - 1))
        rate[answer == 0] = 0.0
        matrix = np.zeros((count + 1, count + 1))
        matrix[:count, :count] = np.eye(count) - rate[:, None] * (c * np.eye(count) - A)
        matrix[:count, count], matrix[count, :count] = rate, 1.0 / count
        rest = np.append(p - answer, p.mean() - load)
        if np.abs(rest).max() <= 1e-13 * np.abs(p).max():
            return p, A @ p - heights + level
        scale = np.append(np.full(count, np.abs(p).max()), np.abs(level) + c * np.abs(p).max() + last - first)
        try:
            change = np.linalg.solve(matrix * scale, rest) * scale
        except np.linalg.LinAlgError:
            break
        p, level = p - change[:count], level - change[count]
    raise reference.Unable("formula: Newton's method does not end")


def wrong_formula(contact: reference.Contact, job: dict, control: str, answer) -> str:
    """A wall that is a formula.  With ε the distance of the gap from that of the law at the pressure, up to a constant,
    the energy error is at most ½ ε·Kε, as the energy is as convex as the elastic one at least.  If that is more than
    certified: ½ d·Gd of the distance d to the solution must not be.  Raises Unable if there is none.
    """
    wall, load, room = job["wall"], answer.mean_pressure, math.sqrt(8 * abs(answer.certified_error))
    p = answer.pressure.astype(reference.Real).ravel()
    if not 0 <= answer.certified_error <= job["solver"]["tolerance"]:
        return f"certified error {answer.certified_error:.3g}"
    if p.min() < 0 or abs(float(p.mean()) - load) > 1e-12 * abs(load):
        return "the load is not carried, or there is tension"
    if control in ("pressure", "force") and abs(load / (answer.target or 1) - (answer.target != 0)) > 1e-15:
        return f"mean pressure {load!r} instead of {answer.target!r}"
    if (wrong := own_numbers(contact, answer)) or load == 0:
        return wrong
    deviation = p / p.mean() - 1  # apart from the mean, whose rounding would count
    displacement = contact.displace(deviation) * contact.pixel * p.mean()
    gap = displacement - contact.heights
    level = answer.gap.ravel() - gap
    size = np.ptp(contact.heights) + np.abs(displacement).max() + np.abs(answer.gap).max()
    work = contact.work(deviation) * p.mean() ** 2 * contact.pixel
    if np.ptp(level) > (room + DIGITS) * size:
        return f"gaps are {float(np.ptp(level) / size):.1e} off those of the pressure"
    if abs(answer.elastic_energy - work / 2 / contact.count) > (room + DIGITS) * abs(work) / contact.count:
        return f"elastic energy {answer.elastic_energy:.12g}, of the pressure {float(work / 2 / contact.count):.12g}"
    gap, ends = gap + level.mean(), formula(wall, np.array(wall["gaps"]))
    rest = gap - graph(wall, (1.0, 0.0), p.astype(float))
    rest = np.where(p <= ends[1], np.minimum(rest, 0), rest)
    if not contact.wraps:
        one = contact.stiffness @ np.ones(contact.count)
        rest = rest - (one @ rest) / one.sum()
    bound = float(rest @ (contact.stiffness @ rest) / contact.pixel / 2 / work) if work > 0 else 0.0
    if bound <= answer.certified_error * (1 + 1e-6) + 1e-18:
        return ""
    with np.errstate(all="ignore"):
        exact, gap = polished(contact, wall, p, float(level.mean()))
    d = p - exact
    error = float(d @ (contact.compliance @ d) * contact.pixel / 2 / work)
    if error > answer.certified_error * (1 + 1e-6) + 1e-24 / max(answer.certified_error, 1e-12):
        return f"certified {answer.certified_error:.3g}, true error at least {error:.3g}"
    off = float(np.abs(answer.gap.ravel() - gap).max() / size)
    return f"gaps are {off:.1e} off" if off > 30 * room + DIGITS else ""

"""Round trips: the contact at a load, and from its area, mean gap, displacement or force back to the load.

    python tools/bench/round_trips.py --trips 2000 --seed 1       # counts, and the worst of each law and control
    python tools/bench/round_trips.py --seed 1 --only 4711        # that trip alone

Random self-affine surfaces, half-spaces and slabs, loads from first touch to full contact; each law with each control
in turn.  A trip is right if the value at the load that comes back, of a contact as exact as rounding allows, is the
value asked for to the documented tolerance; under "contact_area" also if the areas at loads 3e-4 below and above lie on
both sides of it.  A refusal is one line of an InputError or SolverError.  Anything else is wrong.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import brentq

import pgfmd
from pgfmd.errors import InputError, SolverError

FORMULAS = (
    ("0.5 / (1 + exp(3 * gap))", (-10, 12)),  # a plateau, where the range grows without limit
    ("0.1 * (0.5 / gap)**9", (0.05, 20)),
    ("0.2 * exp(-gap / 0.1)", (-2, 6)),
    ("0.05 * (9 - gap) if gap < 9 else 0", (-60, 20)),  # ends before its gaps do
    ("1e-9 * (6 - gap)", (5, 6)),  # weak until it closes
    ("2 - gap if gap < 1 else 0.8 / gap", (0.1, 5)),  # a jump
    ("erfc(gap)", (-2, 4)),
    ("0.3 / (1 + gap)**2", (0, 50)),
    ("0.05 - 0.02 * gap", (0.5, 1.5)),
)
LAWS = ("hard", "exponential", "hardness", "formula")
CONTROLS = ("pressure", "contact_area", "mean_gap", "displacement", "force")
TIGHT = 1e-20, 1e-16, 1e-12  # certified errors of the contacts at both ends of a trip, the first that rounding allows
ROUNDING = 1e-13  # of a gap, over the rms height


@dataclass(frozen=True)
class Trip:
    """heights (nx, ny); what is imposed, and at which load the trip begins; options: of `pgfmd.solve`."""

    heights: np.ndarray
    law: str
    control: str
    load: float
    options: dict[str, Any]


def draw(seed: int, number: int) -> Trip:
    """The trip of that number; the same whatever was drawn before."""
    chance = np.random.default_rng([seed, number])
    law, control = LAWS[number % 4], CONTROLS[number // 4 % 5]
    n = [int(chance.integers(8, 25)) for _ in range(2)]
    hurst, lambda_s, slope = chance.uniform(0.2, 0.9), chance.uniform(1, min(n) / 2), 10 ** chance.uniform(-1.5, 0.3)
    rough = {"kind": "self-affine", "hurst": hurst, "lambda_s": lambda_s, "rms_slope": slope, "seed": number}
    heights = pgfmd.surface({"grid": {"n": n}, "surface": rough})
    rms = float(np.std(heights))
    options: dict[str, Any] = {}
    if chance.random() < 0.4:
        options["thickness"] = float(max(n) * 10 ** chance.uniform(-1.3, 0.5))
        options["base"] = str(chance.choice(["bonded", "free", "sliding"]))
    if chance.random() < 0.3:
        options["area_tolerance" if control == "contact_area" else "gap_tolerance"] = 10 ** chance.uniform(-6, -2.5)
    load = slope / 2 * 10 ** chance.uniform(-3.5, 0.5)  # over the stress of full contact
    if law == "exponential":
        options["wall"] = {"kind": law, "zeta": rms * 10 ** chance.uniform(-2, 1.5)}
        if chance.random() < 0.5:
            options["wall"]["sigma_ref"] = 10 ** chance.uniform(-4, 4)
    elif law == "hardness":
        options["wall"] = {"kind": law, "hardness": float(load / chance.uniform(0.01, 0.99))}
    elif law == "formula":
        text, gaps = FORMULAS[int(chance.integers(len(FORMULAS)))]
        options["wall"] = {"kind": law, "pressure": text, "gaps": gaps}
    return Trip(heights, law, control, float(load), options)


def value(contact: pgfmd.Contact, control: str) -> float:
    """What is imposed, from the fields of a contact."""
    if control == "contact_area":
        return float(np.mean(contact.pressure > contact.threshold))
    if control == "mean_gap":
        return contact.mean_gap
    return contact.displacement if control == "displacement" else getattr(contact, control.replace("pre", "mean_pre"))


def solve(trip: Trip, load: float) -> pgfmd.Contact:
    """The contact at a load, as exact as rounding allows."""
    options = {key: kept for key, kept in trip.options.items() if not key.endswith("_tolerance")}
    for tolerance in TIGHT[:-1]:
        with suppress(SolverError):
            return pgfmd.solve(trip.heights, load, tolerance=tolerance, **options)
    return pgfmd.solve(trip.heights, load, tolerance=TIGHT[-1], **options)


def range_at(trip: Trip, pressure: float) -> float:
    """−p/(dp/dgap) of the law of a trip at that pressure; 0 where it closes or ends."""
    wall = trip.options.get("wall", {})
    if trip.law != "formula":
        return wall.get("zeta", 0.0)
    names = {"exp": math.exp, "erfc": math.erfc}

    def excess(gap: float) -> float:
        return eval(wall["pressure"], names, {"gap": gap}) - pressure  # noqa: S307

    low, high = map(float, wall["gaps"])
    if not excess(low) > 0 > excess(high):
        return 0.0
    gap, step = brentq(excess, low, high, xtol=1e-15), 1e-7 * (high - low)
    before, after = max(gap - step, low), min(gap + step, high)
    return -pressure * (after - before) / (excess(after) - excess(before))


def room(trip: Trip, asked: float, contact: pgfmd.Contact) -> float:
    """The documented tolerance of what is asked."""
    heights, options = trip.heights, trip.options
    if trip.control == "contact_area":
        return max(options.get("area_tolerance", 0.005) * asked, 1 / heights.size)
    if trip.control in ("pressure", "force"):
        return 1e-14 * asked
    summit, rms = float(heights.max() - heights.mean()), float(np.std(heights))
    rigid = options.get("base", "free") != "free"
    approach = asked if trip.control == "displacement" else summit - asked
    bounded = trip.control == "mean_gap" or not rigid
    if trip.law in ("hard", "hardness"):
        left = contact.mean_gap + contact.mean_plastic_depth * (trip.control == "displacement")
        size = min(approach, left) if bounded else approach
    elif trip.law == "exponential":
        size = min(max(abs(approach), range_at(trip, contact.mean_pressure)), rms)
    else:
        first, last = options["wall"]["gaps"]
        last = 9 if "gap < 9" in options["wall"]["pressure"] else last
        ways = [abs(approach + first), approach + last] + [summit - first - approach] * bounded
        size = min(max(min(ways), range_at(trip, contact.mean_pressure)), rms)
    return options.get("gap_tolerance", 1e-4) * size + ROUNDING * rms


@dataclass(frozen=True)
class Outcome:
    """verdict: "right", "jump", "refused" or "wrong"; off: |value − asked| over its tolerance; ratio: of both loads."""

    verdict: str
    detail: str = ""
    off: float = 0.0
    ratio: float = 1.0


def run(trip: Trip) -> Outcome:
    """Goes there and back."""
    there = None
    try:
        there = solve(trip, trip.load)
        asked = value(there, trip.control)
        if trip.control == "contact_area":
            asked = min(asked, 1 - 0.5 / trip.heights.size)  # 1 cannot be asked for
        back = pgfmd.solve(trip.heights, **({trip.control: asked} | trip.options))
        again = solve(trip, back.mean_pressure)
    except (InputError, SolverError) as error:
        message = str(error)
        good = message.isprintable() and "\n" not in message
        return Outcome("refused" if good else "wrong", f"{'there' if there is None else 'back'}: {message}")
    allowed, ratio = room(trip, asked, back), back.mean_pressure / trip.load
    off = max(abs(value(each, trip.control) - asked) for each in (back, again)) / allowed
    if off <= 1 + 1e-6:
        return Outcome("right", "", off, ratio)
    if trip.control == "contact_area":
        sides = [solve(trip, back.mean_pressure * factor) for factor in (1 - 3e-4, 1 + 3e-4)]
        if value(sides[0], trip.control) <= asked <= value(sides[1], trip.control):
            return Outcome("jump", "", 0.0, ratio)
    return Outcome("wrong", f"asked {asked:.9g}, tolerance {allowed:.2g}, off by {off:.3g} of it", off, ratio)


def kind(detail: str) -> str:
    """A refusal without its numbers."""
    return " ".join(word for word in detail.split() if not any(letter.isdigit() for letter in word))


def trips(seed: int, first: int, count: int) -> Iterator[tuple[int, Trip, Outcome]]:
    """Runs trips, one after another."""
    for number in range(first, first + count):
        trip = draw(seed, number)
        yield number, trip, run(trip)


def report(seed: int, first: int, count: int) -> int:
    """Runs trips, prints what goes wrong, refusals, and the worst of each law and control; 0 if nothing went wrong."""
    verdicts, refusals, began = Counter[str](), Counter[str](), time.perf_counter()
    worst: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0, 0.0, 0.0])
    example: dict[str, int] = {}
    for number, trip, outcome in trips(seed, first, count):
        verdicts[outcome.verdict] += 1
        if outcome.verdict == "wrong":
            print(f"{number}: {trip.law}, {trip.control}: {outcome.detail}, {trip.options}", flush=True)
        if outcome.verdict == "refused":
            refusal = f"{trip.law}, {trip.control}, {kind(outcome.detail)}"
            refusals[refusal] += 1
            example.setdefault(refusal, number)
        else:
            row = worst[trip.law, trip.control]
            row[:] = row[0] + 1, max(row[1], outcome.off), max(row[2], abs(math.log(outcome.ratio)))
    for (law, control), (met, off, ratio) in sorted(worst.items()):
        print(f"{law:12} {control:13} {met:5} trips, |reached − asked|/tolerance ≤ {off:.3f}, |ln load| ≤ {ratio:.2g}")
    for name, count in refusals.most_common():
        print(f"{count:5}  {name} (first: {example[name]})")
    print(f"seed {seed}: {verdicts.total()} trips: {dict(verdicts)}; {time.perf_counter() - began:.0f} s")
    return int(verdicts["wrong"] > 0)


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trips", type=int, default=200, help="how many")
    parser.add_argument("--seed", type=int, default=1, help="of all of them")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--only", type=int, help="run the trip of that number, and show it")
    options = parser.parse_args(arguments)
    if options.only is not None:
        trip = draw(options.seed, options.only)
        print(trip, run(trip), sep="\n")
        return 0
    return report(options.seed, options.first, options.trips)


if __name__ == "__main__":
    raise SystemExit(main())

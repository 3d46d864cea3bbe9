"""Claims of a paper, and the rule by which a measured number decides on each; read from a file such as
tools/paper/claims.toml.

A claim has parts, each of which holds one number found by a figure against what the paper says of it:

    number = [v, e]     the paper's number and its own error; x is the measured one, s its error (seeds, choices).
                        Agrees if |x − v| ≤ √(e² + s²) and s ≤ e; differs if |x − v| > 2 √(e² + s²)
    range = [low, high] a statement: agrees if x lies between, widened by s, and s is below half its width; with a bound
                        on one side only (the other inf), if x lies inside by s or more; differs if it lies outside by
                        more than 2 s
    beyond = [low, high] the opposite: agrees if x lies outside by s or more; differs if it lies inside by more than 2 s
    identity = [v, t]   true by construction: |x − v| ≤ t, or the program is wrong; never counted as agreement
    nothing             a number given for information
Otherwise: cannot tell, also where no error is known (unless `exact`).  A claim differs if any part differs, else it
cannot be told if any cannot, else it agrees.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

from plotting import Finding, Findings

from pgfmd.errors import InputError

AGREES, DIFFERS, CANNOT_TELL, IDENTITY, VIOLATED, NOT_RUN, GIVEN = (
    "agrees", "differs", "cannot tell", "identity", "violated", "not run", "",
)  # fmt: skip
ORDER = (VIOLATED, DIFFERS, NOT_RUN, CANNOT_TELL, AGREES, IDENTITY)  # a claim gets the first of these that a part has


@dataclass(frozen=True)
class Part:
    """One number of a claim.  finding: "KEY: name" of a figure's finding; over, minus: another to put it against."""

    what: str
    finding: str
    number: tuple[float, float] | None = None
    range: tuple[float, float] | None = None
    beyond: tuple[float, float] | None = None
    identity: tuple[float, float] | None = None
    over: str = ""
    minus: str = ""
    exact: bool = False  # a number without error: theory's, or a count

    def measured(self, findings: dict[str, Findings]) -> Finding | None:
        """The number; None if a figure that it needs was not made."""
        first = _find(self.finding, findings)
        if first is None or not (self.over or self.minus):
            return replace(first, seeds=0.0) if first is not None and self.exact else first
        other = _find(self.over or self.minus, findings)
        return None if other is None else _combined(first, other, bool(self.over))

    def verdict(self, found: Finding | None) -> str:
        """By the rules of this module."""
        if self.number is self.range is self.beyond is self.identity is None:
            return GIVEN
        if found is None:
            return NOT_RUN
        if self.identity is not None:
            return IDENTITY if abs(found.value - self.identity[0]) <= self.identity[1] else VIOLATED
        if found.error is None:
            return CANNOT_TELL
        outside, small_enough = self._outside(found)
        if outside > 2:
            return DIFFERS
        return AGREES if outside <= 1 and small_enough else CANNOT_TELL

    def outside(self, found: Finding | None) -> float:
        """How far the number lies outside of what the paper says, in combined errors; −1 for a part without a rule."""
        decided = self.number is not None or self.range is not None or self.beyond is not None
        return self._outside(found)[0] if found is not None and decided else -1.0

    def _outside(self, found: Finding) -> tuple[float, bool]:
        """Distance from what the paper says in combined errors, and whether the error is small enough to decide."""
        value, error = found.value, found.error or 0.0
        if self.number is not None:
            expected, own = self.number
            return _over(abs(value - expected), math.hypot(own, error)), error <= own
        if self.beyond is not None:
            low, high = self.beyond
            inside = min(value - low, high - value)
            return _over(max(inside, 0.0), error), -inside >= error
        low, high = self.range
        outside = max(low - value, value - high)
        small_enough = -outside >= error if math.isinf(high - low) else error <= (high - low) / 2
        return _over(max(outside, 0.0), error), small_enough

    def expectation(self) -> str:
        """What the paper says of the number."""
        if self.number is not None:
            return f"{self.number[0]:g} ± {self.number[1]:g}"
        if self.range is not None:
            low, high = self.range
            return f"≤ {high:g}" if math.isinf(low) else f"≥ {low:g}" if math.isinf(high) else f"{low:g} … {high:g}"
        if self.beyond is not None:
            return f"not {self.beyond[0]:g} … {self.beyond[1]:g}"
        return "" if self.identity is None else f"{self.identity[0]:g}, exactly"


@dataclass(frozen=True)
class Claim:
    """What the paper says, where, under which conditions here, and the parts that decide."""

    number: int
    says: str
    where: str
    figure: str  # key of the figure under which it stands
    parts: tuple[Part, ...]
    conditions: str = ""  # departures from those of the paper, and their size
    why: str = ""  # said where it differs or cannot be told
    decided_by: str = ""  # said where it cannot be told

    def verdict(self, findings: dict[str, Findings]) -> str:
        """Of the claim as a whole."""
        verdicts = {part.verdict(part.measured(findings)) for part in self.parts}
        return next((verdict for verdict in ORDER if verdict in verdicts), CANNOT_TELL)

    def decisive(self, findings: dict[str, Findings]) -> Part | None:
        """The part that says most: the farthest out among those with the claim's verdict."""
        verdict = self.verdict(findings)
        same = [part for part in self.parts if part.verdict(part.measured(findings)) == verdict]
        return max(same, key=lambda part: part.outside(part.measured(findings)), default=None)


def read(path: Path, figures: set[str], small: bool = False) -> list[Claim]:
    """The claims of a file; with `small`, settings in the names of findings are those of its table `small`.

    Raises InputError if a claim refers to a figure that the file does not have.
    """
    with open(path, "rb") as file:
        content = tomllib.load(file)
    claims, renamed = [], content.get("small", {}) if small else {}
    for table in content["claim"]:
        for part in table["parts"]:
            for key in ("finding", "over", "minus"):
                part[key] = ", ".join(renamed.get(word, word) for word in part.get(key, "").split(", "))
        parts = tuple(Part(**{key: tuple(v) if isinstance(v, list) else v for key, v in part.items()})
                      for part in table["parts"])  # fmt: skip
        claims.append(Claim(**table | {"parts": parts}))
        wanted = {claims[-1].figure} | {name.partition(": ")[0] for part in parts
                                        for name in (part.finding, part.over, part.minus) if name}  # fmt: skip
        if wanted - figures:
            raise InputError(f"{path}: claim {claims[-1].number} refers to unknown figures {sorted(wanted - figures)}")
    return claims


def _over(distance: float, error: float) -> float:
    return 0.0 if distance == 0 else distance / error if error > 0 else math.inf


def _find(reference: str, findings: dict[str, Findings]) -> Finding | None:
    key, _, name = reference.partition(": ")
    return findings.get(key, Findings()).get(name)


def _combined(first: Finding, other: Finding, quotient: bool) -> Finding:
    """first/other or first − other.  Errors of one kind are added in squares, as if independent; where only one is
    known, it counts alone.
    """
    if not quotient:
        value, scales = first.value - other.value, (1.0, 1.0)
    else:
        value = first.value / other.value
        scales = 1 / abs(other.value), abs(value / other.value)
    errors = []
    for pair in ((first.seeds, other.seeds), (first.choices, other.choices)):
        known = [scale * error for scale, error in zip(scales, pair, strict=True) if error is not None]
        errors.append(math.hypot(*known) if known else None)
    return Finding(value, errors[0], errors[1], min(first.count, other.count))

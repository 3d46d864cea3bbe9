"""Claims of a paper, and the rule by which a measured number decides on each; read from a file such as
tools/paper/claims.toml.

A claim has parts.  A part holds one number of a figure against what the paper says of it, at the accuracy that the
paper gives, or with which its figure can be read:

    number = [v, e]        the paper's number and its accuracy: the range v ± e
    range = [low, high]    a statement in words, as a range; one end may be infinite
    beyond = [low, high]   a statement that the number lies outside of a range
    identity = [v, t]      true by construction: |x − v| ≤ t, or the program is wrong; never counted as agreement
    nothing                a number given for information

u is the 95 % uncertainty of our number: Student's t times the standard error over seeds.  With `minus` and `paired`,
seeds are subtracted one by one before that.  The spread over defensible choices, such as fit ranges, is printed beside
it; it counts only where there are no seeds, since a claim is judged with the choice that was fixed before the runs.
    agrees       the number lies in the range, and u is at most half the width of the range, or the distance to its
                 only end, so that the part could have failed
    differs      the number lies outside by more than u
    cannot tell  otherwise, also where no uncertainty is known (unless `exact`)

Parts of the column "paper" are made under the paper's conditions, and decide: a claim agrees if all of them agree; it
agrees in a range if at least half do; it differs if more than half differ, or one does where the claim is that
something happens there alone (`only`); otherwise it cannot be told.  Parts of the column "limit" say what is true with
better numbers: resolution, cell, seeds or estimator.  They do not decide.

`kind` tells results apart from what is none: identities, slips, quotations of other work, and conjectures.
"""

import math
import tomllib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from plotting import Finding, Findings

from pgfmd.errors import InputError

AGREES, IN_A_RANGE, DIFFERS, CANNOT_TELL, IDENTITY, VIOLATED, NOT_RUN, GIVEN = (
    "agrees", "agrees in a range", "differs", "cannot tell", "identity", "violated", "not run", "",
)  # fmt: skip
ORDER = (AGREES, IN_A_RANGE, DIFFERS, CANNOT_TELL, IDENTITY, VIOLATED, NOT_RUN)
KINDS = {
    "result": "Results",
    "conjecture": "An observation, and a conjecture that the paper draws from it",
    "quotation": "Quotations of other work",
    "slip": "Slips and normalisations",
    "identity": "Identities",
}
COLUMNS = ("paper", "limit")


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
    paired: bool = False  # minus: the seeds are the same
    exact: bool = False  # a number without error: theory's, or a count
    column: str = "paper"

    def measured(self, findings: dict[str, Findings]) -> Finding | None:
        """The number; None if a figure that it needs was not made."""
        first = _look_up(self.finding, findings)
        if first is None or not (self.over or self.minus):
            return replace(first, seeds=0.0) if first is not None and self.exact else first
        other = _look_up(self.over or self.minus, findings)
        if other is None:
            return None
        return _paired(first, other) if self.paired else _combined(first, other, bool(self.over))

    def verdict(self, finding: Finding | None) -> str:
        """By the rules of this module."""
        if self.identity is self._interval() is self.beyond is None:
            return GIVEN
        if finding is None:
            return NOT_RUN
        if self.identity is not None:
            return IDENTITY if abs(finding.value - self.identity[0]) <= self.identity[1] else VIOLATED
        if finding.uncertainty is None:
            return CANNOT_TELL
        outside = self.outside(finding)
        if outside <= 0:
            return AGREES if finding.uncertainty <= self._room(finding) else CANNOT_TELL
        return DIFFERS if outside > finding.uncertainty else CANNOT_TELL

    def outside(self, finding: Finding) -> float:
        """By how much the number lies outside of what the paper says; negative inside."""
        if self.beyond is not None:
            return min(finding.value - self.beyond[0], self.beyond[1] - finding.value)
        low, high = self._interval() or (-math.inf, math.inf)
        return max(low - finding.value, finding.value - high)

    def _room(self, finding: Finding) -> float:
        """The largest uncertainty with which the part could have failed."""
        low, high = self.beyond or self._interval()
        return -self.outside(finding) if self.beyond or math.isinf(high - low) else (high - low) / 2

    def _interval(self) -> tuple[float, float] | None:
        return (self.number[0] - self.number[1], self.number[0] + self.number[1]) if self.number else self.range

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
    kind: str = "result"
    conditions: str = ""  # how ours depart from the paper's, and what its words are taken to mean
    holds: str = ""  # where it holds, if not everywhere
    limit: str = ""  # what better numbers show, in words
    why: str = ""  # said where it differs
    decided_by: str = ""  # said where it cannot be told
    only: bool = False  # it says that something happens there only: one part that differs refutes it

    def verdict(self, findings: dict[str, Findings]) -> str:
        """Of the claim as a whole."""
        deciding = [part for part in self.parts if part.column == "paper"]
        counts = Counter(part.verdict(part.measured(findings)) for part in deciding)
        del counts[GIVEN]
        for single in (VIOLATED, NOT_RUN):
            if counts[single]:
                return single
        if self.only and counts[DIFFERS]:
            return DIFFERS
        most = counts.total() / 2
        if counts.total() == counts[IDENTITY] > 0:
            return IDENTITY
        if counts[AGREES] == counts.total() > 0:
            return AGREES
        return IN_A_RANGE if counts[AGREES] >= most else DIFFERS if counts[DIFFERS] > most else CANNOT_TELL


@dataclass(frozen=True)
class Result:
    """What the runs show beyond the paper, with the numbers that show it."""

    title: str
    text: str
    figure: str
    parts: tuple[Part, ...]


def read(path: Path, figures: set[str], small: bool = False) -> tuple[list[Claim], list[Result]]:
    """The claims of a file, and what is new; with `small`, findings have the settings of the file's table `small`.

    Raises InputError if one refers to a figure that the file does not have, or has a kind or column that is none.
    """
    with open(path, "rb") as file:
        content = tomllib.load(file)
    renamed = content.get("small", {}) if small else {}
    claims = [Claim(**table | {"parts": _parts(table, renamed)}) for table in content["claim"]]
    results = [Result(**table | {"parts": _parts(table, renamed)}) for table in content.get("new", [])]
    for entry in (*claims, *results):
        title = f"{path}: claim {entry.number}" if isinstance(entry, Claim) else f"{path}: {entry.title}"
        wanted = {entry.figure} | {name.partition(": ")[0] for part in entry.parts
                                   for name in (part.finding, part.over, part.minus) if name}  # fmt: skip
        if wanted - figures:
            raise InputError(f"{title} refers to unknown figures {sorted(wanted - figures)}")
        if {part.column for part in entry.parts} - set(COLUMNS):
            raise InputError(f"{title}: column is one of {list(COLUMNS)}")
        if isinstance(entry, Claim) and entry.kind not in KINDS:
            raise InputError(f"{title}: kind is one of {list(KINDS)}")
    return claims, results


def _parts(table: dict, renamed: dict[str, str]) -> tuple[Part, ...]:
    parts = []
    for part in table["parts"]:
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in part.items()}
        for key in ("finding", "over", "minus"):
            values[key] = ", ".join(renamed.get(word, word) for word in part.get(key, "").split(", "))
        parts.append(Part(**values))
    return tuple(parts)


def _look_up(reference: str, findings: dict[str, Findings]) -> Finding | None:
    key, _, name = reference.partition(": ")
    return findings.get(key, Findings()).get(name)


def _paired(first: Finding, other: Finding) -> Finding:
    """first − other, seed by seed and choice by choice."""
    if len(first.values) != len(other.values) or len(first.others) != len(other.others):
        raise InputError("numbers of unlike seeds or choices cannot be paired")
    difference = Findings()
    others = np.subtract(first.others, other.others) if first.others else None
    difference.add("", np.subtract(first.values, other.values), others)
    return difference[""]


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

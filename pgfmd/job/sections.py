"""The sections [solid] and [run] of a job.  No MPI here.

The fields of a class are the keys of its TOML table.  All numbers are in one consistent set of units, the user's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pgfmd.errors import InputError
from pgfmd.options.rules import POSITIVE, assignment, choice, many, number
from pgfmd.options.section import Section, key, wrong
from pgfmd.options.text import show


@dataclass(frozen=True, kw_only=True)
class Solid(Section):
    """The elastic solid: half-space or slab.

    Give one of (lame_lambda, lame_mu), (young, poisson), contact_modulus alone or with poisson; the others follow from
    it.  Nothing given: λ = μ = 1.  Redundant values must agree.
    `contact_modulus` is always known; the others are None if contact_modulus was given without poisson.
    """

    where = "solid"
    lame_lambda: float | None = key(number(), about="λ, with lame_mu", unit="pressure")
    lame_mu: float | None = key(POSITIVE, about="μ", unit="pressure")
    young: float | None = key(POSITIVE, about="E, with poisson", unit="pressure")
    poisson: float | None = key(number(above=-1, below=0.5), about="ν", unit="1")
    contact_modulus: float = key(POSITIVE, about="E' = E/(1 − ν²)", unit="pressure")
    thickness: float = key(number(above=0, infinite=True), math.inf, "of a slab; inf is a half-space", unit="length")
    base: str = key(
        choice("bonded", "free", "sliding"), "bonded", "slab's far face; free: under constant pressure, not held"
    )

    def check(self) -> None:
        given = {name: getattr(self, name) for name in MODULI if getattr(self, name) is not None}
        known = _moduli(given or {"lame_lambda": 1.0, "lame_mu": 1.0})
        if known is None:
            raise InputError(
                "solid: give lame_lambda and lame_mu, or young and poisson, or contact_modulus "
                f"(with poisson); given: {', '.join(given)}"
            )
        for name, value in known.items():
            if value is None:
                continue
            if not (math.isfinite(value) and (value > 0 or name in ("lame_lambda", "poisson"))):
                raise InputError(f"solid: {show(given)} gives {name} = {value:g}, which no stable solid has")
            if name in given and not math.isclose(given[name], value, rel_tol=1e-9, abs_tol=1e-9 * abs(value)):
                raise wrong(self, name, f"the other moduli give {value:g}")
            object.__setattr__(self, name, given.get(name, value))
        if math.isinf(self.thickness) and self.base != "bonded":
            raise wrong(self, "base", "belongs to a slab; a half-space has none: give thickness as well")
        if math.isfinite(self.thickness) and self.poisson is None and self.base != "free":
            raise wrong(self, "thickness", f"a slab with a {self.base} base needs poisson as well")


MODULI = ("lame_lambda", "lame_mu", "young", "poisson", "contact_modulus")


def _moduli(given: dict[str, float]) -> dict[str, float | None] | None:
    """All five moduli from a pair that fixes them; None if nothing does."""
    if {"lame_lambda", "lame_mu"} <= given.keys():
        lam, mu = given["lame_lambda"], given["lame_mu"]
        if 3 * lam <= -2 * mu:
            raise InputError(f"solid.lame_lambda = {lam:g}: must exceed −2/3 lame_mu = {-2 * mu / 3:g}")
        poisson = lam / (2 * (lam + mu))
        young = 2 * mu * (1 + poisson)
    elif {"young", "poisson"} <= given.keys():
        young, poisson = given["young"], given["poisson"]
    elif {"contact_modulus", "poisson"} <= given.keys():
        poisson = given["poisson"]
        young = given["contact_modulus"] * (1 - poisson**2)
    elif given.keys() == {"contact_modulus"}:
        return {name: given.get(name) for name in MODULI}
    else:
        return None
    mu = young / (2 * (1 + poisson))
    return {
        "lame_lambda": 2 * mu * poisson / (1 - 2 * poisson) if poisson < 0.5 else math.inf,
        "lame_mu": mu,
        "young": young,
        "poisson": poisson,
        "contact_modulus": young / (1 - poisson**2),
    }


@dataclass(frozen=True, kw_only=True)
class Run(Section):
    """Checkpoints and time limit of a run, for machines that stop long jobs; how its files are written.  Not compared
    by --restart: it does not change results.
    """

    where = "run"
    checkpoint_interval: float = key(
        number(low=0, infinite=True),
        1800.0,
        "between checkpoints of an unfinished load; 0: each step; inf: none",
        unit="s",
    )
    time_limit: float = key(
        number(above=0, infinite=True), math.inf, "of the run; it stops in time, to be restarted", unit="s"
    )
    io_hints: tuple[str, ...] = key(
        many(assignment()),
        (),
        "for MPI-IO, which ignores unknown ones; stripes are set on the folder (lfs setstripe)",
        example=["cb_nodes=8", "romio_cb_write=enable"],
    )

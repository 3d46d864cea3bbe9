"""What an elastic solid is: the stiffness of its surface to each mode of pressure, and the inverse, its compliance.

A half-space has p̃(q) = (E'/2) q ũ(q), with the contact modulus E' = E/(1−ν²).  Any other solid that is the same in all
directions along its surface has p̃ = (E'/2) q F(q) ũ.  The mean mode q = 0 is apart: at imposed load it only shifts the
surface as a whole.  A new solid is one file here that defines a `Solid`, and its line in `kinds`.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.errors import InputError
from pgfmd.options.rules import POSITIVE, number
from pgfmd.options.section import Section, key, wrong
from pgfmd.options.text import show

if TYPE_CHECKING:
    from pgfmd.grid.cell import Cell
    from pgfmd.grid.domain import Domain
    from pgfmd.grid.slab_grid import SlabGrid
    from pgfmd.grid.transforms import ColumnAction

SOFT = 0.3  # `Solid.softest` below which contacts are solved by the method for thin solids (`solvers.active_set.thin`)
POISSON = number(above=-1, below=0.5)
MODULI = ("lame_lambda", "lame_mu", "young", "poisson", "contact_modulus")


@dataclass(frozen=True, kw_only=True)
class Solid(Section):
    """An elastic solid; a subclass is one kind, and its fields are its keys in [solid].

    Give one of (lame_lambda, lame_mu), (young, poisson), contact_modulus alone or with poisson; the others follow from
    it.  There is no default.  Redundant values must agree.
    `contact_modulus` is always known; the others are None if contact_modulus was given without poisson.

    long_waves: the key that decides the response to long waves, for messages.
    """

    where = "solid"
    shown: ClassVar[tuple[str, ...]] = ("contact_modulus",)
    long_waves: ClassVar[str] = "thickness"

    lame_lambda: float | None = key(number(), about="λ, with lame_mu", unit="pressure")
    lame_mu: float | None = key(POSITIVE, about="μ", unit="pressure")
    young: float | None = key(POSITIVE, about="E, with poisson", unit="pressure")
    poisson: float | None = key(
        POISSON, about="ν, without a default; slabs, layers, stresses and partial slip need it", unit="1", example=0.25
    )
    contact_modulus: float = key(
        POSITIVE, about="E' = E/(1 − ν²); 1: pressures are in units of E'", unit="pressure", example=1.0
    )

    def check(self) -> None:
        given = {name: getattr(self, name) for name in MODULI if getattr(self, name) is not None}
        if not given:
            raise InputError(
                "solid.contact_modulus is missing: give it (1.0: pressures are in units of E'), or young and poisson, "
                "or lame_lambda and lame_mu (both 1.0 where jobs of earlier versions gave nothing)"
            )
        known = _moduli(given)
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
        if self.poisson is None and self.needs_poisson:
            raise wrong(self, "contact_modulus", "this solid needs poisson as well: its response depends on it")

    @property
    def needs_poisson(self) -> bool:
        """Whether the response depends on Poisson's ratio otherwise than through the contact modulus."""
        return False

    @property
    def no_border(self) -> str:
        """Why boundaries cannot be open with this solid; "" if they can."""
        return "its kernel on a patch is not known"

    def check_domain(self, domain: Domain) -> None:
        """Raises InputError if its boundaries are open, but cannot be with this solid."""
        if self.no_border and not domain.wraps:
            raise InputError(f'grid.boundary = "open": not with solid.kind = {show(self.kind)}: {self.no_border}')

    @property
    def only_inwards(self) -> bool:
        """Whether it is certain that pressure on a patch displaces all points inwards."""
        return False

    @property
    def surface_modulus(self) -> float:
        """E' F(q → ∞), the contact modulus of the half-space that responds to short waves alike."""
        return self.contact_modulus

    @property
    def effort(self) -> float:
        """Time of a solution over that on a half-space with as many transforms, for `pgfmd check`: the mean of eight
        contacts of 512² points where F is computed for each mode (1 … 1.9).
        """
        return 1.3

    def check_inputs(self, cell: Cell, length_unit: str | None) -> str:
        """As `Surface.check_inputs`: checks the files that the keys name, and describes them ("": there are none)."""
        return ""

    def prepare(self, grid: SlabGrid) -> None:
        """Read the files that the keys name, once for all ranks.  Collective.  Raises InputError on all ranks."""

    def in_units(self, height: float, pressure: float) -> Solid:
        """The same solid, with displacements and pressures in these units; wave numbers keep theirs."""
        scaled = copy.copy(self)
        for field in dataclasses.fields(self):
            if field.metadata["unit"] == "pressure" and getattr(self, field.name) is not None:
                object.__setattr__(scaled, field.name, getattr(self, field.name) * height / pressure)
        if not 0 < scaled.contact_modulus < math.inf:
            raise InputError(f"contact_modulus = {self.contact_modulus!r}: too far from the pressures of this contact")
        return scaled

    def factor(self, q: np.ndarray) -> np.ndarray:
        """F(q) for q > 0 (rad/length), of the same shape."""
        raise NotImplementedError

    def mean_stiffness(self, periodic: bool = True) -> float:
        """dp̄/dū of the mean mode of a periodic cell, which forbids lateral strain (pressure per length); 0 for solids
        without a far side at rest.  Not periodic: the limit of stiffness(q) for q → 0.
        """
        return 0.0

    def stiffness(self, q: np.ndarray) -> np.ndarray:
        """(E'/2) q F(q) for q > 0 (rad/length), pressure per displacement, and 0 at q = 0; of the same shape."""
        q = np.asarray(q, dtype=np.float64)
        return 0.5 * self.contact_modulus * q * self.factor(np.where(q > 0, q, 1.0))

    def compliance(self, q: np.ndarray) -> np.ndarray:
        """1/stiffness, and 0 at q = 0."""
        stiffness = self.stiffness(q)
        return np.divide(1.0, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0)

    def softest(self, lengths: tuple[float, float], spacing: tuple[float, float]) -> float:
        """Least stiffness to a wave of a cell over that of the half-space that responds to short waves alike.  Below
        `SOFT` the solid is thin: a free slab of .2 of the cell, a layer of .1 on a base five times as soft.
        """
        q = np.geomspace(2 * math.pi / max(lengths), math.pi / min(spacing), 64)
        return float(np.min(self.stiffness(q) / self.half_space_stiffness(q)))

    def half_space_stiffness(self, q: np.ndarray) -> np.ndarray:
        """(E'/2) q F(∞): of the half-space that responds to short waves alike; of the shape of q."""
        return 0.5 * self.surface_modulus * q

    def half_space_compliance(self, q: np.ndarray) -> np.ndarray:
        """1/half_space_stiffness, for q > 0."""
        return 1 / self.half_space_stiffness(q)

    def open_table(self, grid: SlabGrid) -> np.ndarray:
        """E' times the compliance of the modes kx ≥ 0 on an open patch, (nky_local, Nx // 2 + 1).  Called often: make
        it once for each grid (`open_kernel.kept_table`).  Collective.
        """
        raise NotImplementedError

    def modes(self, grid: SlabGrid, first: int = 0, stop: int | None = None) -> np.ndarray:
        """Compliance of the modes kx ≥ 0 of this rank's columns first … stop−1, (columns, Nx // 2 + 1).  Collective at
        its first use on a domain with a border.
        """
        if not grid.domain.wraps:
            return self.open_table(grid)[first:stop] / self.contact_modulus
        return self.compliance(np.sqrt(half_q_squared(grid, first, stop)))

    def mean_mode(self, grid: SlabGrid) -> float:
        """Compliance of the mean mode on the rank that holds it, 0 on others.  Collective as `modes`."""
        modes = self.modes(grid, 0, 1)
        return float(modes[0, 0]) if grid.columns.start == 0 and len(modes) else 0.0

    def apply_compliance(self, grid: SlabGrid, dtype: DTypeLike, factor: float) -> ColumnAction:
        """Column action p̃ ← factor · compliance(q) · p̃ in the given precision.  Collective as `modes`."""
        if not grid.domain.wraps:
            return _by_table(grid, dtype, factor / self.contact_modulus, self.open_table(grid), False)
        return multiply(grid, dtype, lambda q: factor * self.compliance(q))

    def apply_stiffness(self, grid: SlabGrid, dtype: DTypeLike, factor: float) -> ColumnAction:
        """Column action ũ ← factor · stiffness(q) · ũ in the given precision, 0 at q = 0.  Collective as `modes`."""
        if not grid.domain.wraps:
            return _by_table(grid, dtype, factor * self.contact_modulus, self.open_table(grid), True)
        return multiply(grid, dtype, lambda q: factor * self.stiffness(q))


def half_q_squared(grid: SlabGrid, first: int = 0, stop: int | None = None) -> np.ndarray:
    """|q|² of the modes with kx ≥ 0 of this rank's columns first … stop−1: (columns, Nx // 2 + 1)."""
    return grid.qx[:, : grid.torus[0] // 2 + 1] ** 2 + grid.qy[first:stop] ** 2


def _by_table(grid: SlabGrid, dtype: DTypeLike, factor: float, table: np.ndarray, divide: bool) -> ColumnAction:
    """Column action: each mode times factor · table, or factor/table, but the mean mode then becomes 0."""
    from pgfmd.grid.kernels import scale_even  # compiled code, which only a run needs

    real, has_mean = np.dtype(dtype), divide and grid.columns.start == 0

    def act(block: np.ndarray, first: int, stop: int) -> None:
        scale_even(block.view(real).reshape(*block.shape, 2), table[first:stop], factor, divide)
        if has_mean and first == 0:
            block[0, 0] = 0

    return act


def multiply(grid: SlabGrid, dtype: DTypeLike, function: Callable[[np.ndarray], np.ndarray]) -> ColumnAction:
    """Column action that multiplies each mode by `function(|q|)`."""
    real = np.dtype(dtype)

    def action(block: np.ndarray, first: int, stop: int) -> None:
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of a diverging iteration
            block *= function(np.sqrt(grid.q_squared(first, stop))).astype(real)

    return action


def _moduli(given: dict[str, float]) -> dict[str, float | None] | None:
    """All five moduli from those that are given; None if these do not fix them."""
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

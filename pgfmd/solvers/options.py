"""What is imposed on a contact, and how it is found: the tables [load] and [solver] of a job; what each method costs.

No MPI here.  How costs were measured: NUMERICS.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

from pgfmd.errors import InputError
from pgfmd.grid.cell import TRANSFORMS
from pgfmd.grid.domain import Domain
from pgfmd.grid.grid_cost import Cost
from pgfmd.options.rules import choice, flag, integer, many, number
from pgfmd.options.section import Section, key, wrong
from pgfmd.options.text import show
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.laws.table import LAWS
from pgfmd.physics.solids.solid import SOFT, Solid

SCALED = 8.0  # heights about their mean, over their rms value
SINGLE = 8.0  # saved by a hard wall's pressure and gap in single precision
MODERATE = 1e6  # largest rms height, and inverse of the smallest, that is solved without a scaled copy
SINGLE_TO = 1.2e-13  # tolerance over points per side down to which rounding in single precision is unseen
# Per unknown of the active set, which is the pressure of a point in contact or, where these are the majority, the gap
# of one that is not: its column, now and before (4), direction, residual, preconditioned one, change (16), for
# pressures the residual less its means (4); the rest as measured.
PER_PRESSURE, PER_GAP = 26.0, 20.0
MESH = 4.2  # meshes and means over blocks, as measured
CERTIFIED = 3.4, 6.0  # while a contact is certified: meshes, and per unknown its column and residual
MEASURED = 0.7  # what is measured of every contact
# Newton's root, residual, direction, image, change, response (24), in single precision, and targets (8); the rest as
# measured.
NEWTON = 39.0
ADHESIVE = 40.0  # gap and stress, the next gap and the last (32), three fields in single precision: as measured
DYNAMICS = 42.0  # displacement, force, modes and their mobility (28); the rest as measured
GAPS_FROM, LARGE = (0.65, 0.8), 4096**2  # see `gaps_from`


class Arrays(NamedTuple):
    """What decides on the memory beside the contact.  scaled: whether heights are scaled in an array of their own.
    single: whether the active set can keep pressure and gap in single precision while it solves.  strips: bytes per
    point of the transforms in double precision that it frees while it does not transform.  stored: whether fields are
    stored in double precision.  gaps_from: contact area above which the active set's unknowns are the gaps outside.
    """

    scaled: bool = True
    single: bool = False
    strips: float = 0.0
    stored: bool = True
    gaps_from: float = GAPS_FROM[1]


USUAL = Arrays()


def cost(method: str, area: float, slabs: int = 1, effort: float = 1.0, arrays: Arrays = USUAL) -> Cost:
    """One contact of that relative area by that method; memory of the fullest of so many slabs.

    effort: time under the law over that under a hard wall (dynamics) or an exponential one (Newton); under a law that
    attracts, the transforms.
    """
    heights = SCALED * arrays.scaled
    if method == "adhesive":
        return Cost(effort, ADHESIVE)
    if method == "newton":
        return Cost(70 * effort, heights + NEWTON)
    if method == "gfmd":
        return Cost(110 * effort, heights + DYNAMICS)
    by_pressures = area <= arrays.gaps_from
    most = fullest(area if by_pressures else 1 - area, slabs)
    work, unknowns = (6.5 + 22 * area, PER_PRESSURE) if by_pressures else (13.5 - 7 * area, PER_GAP)
    saved, half = SINGLE * (arrays.single and arrays.stored), 1 - arrays.single / 2
    solving, certified = MESH + most * unknowns, CERTIFIED[0] + most * CERTIFIED[1] + half * arrays.strips
    # Solved, the fields are in the precision of `storage`, and there are no strips.
    return Cost(work, heights + max(max(solving, certified) - saved, MEASURED) - arrays.strips)


def gaps_from(points: int) -> float:
    """Contact area above which the active set's unknowns are the gaps outside the contact, on a grid of so many points;
    there it needs most memory.
    """
    return GAPS_FROM[int(points > LARGE)]


def fullest(area: float, slabs: int) -> float:
    """The part in contact of the fullest of so many slabs, of which `area` is the mean.

    1 − (1 − area)^k with k = 1 + log₂(slabs)/2 up to 3: the mean over four surfaces whose longest wave is the cell, of
    areas .01 … .8 and 2 … 128 slabs, within .06.  Shorter waves spread contact more evenly.
    """
    return float(1 - (1 - area) ** (1 + min(math.log2(slabs) / 2, 2)))


Sides = tuple[float, float]
METHODS = tuple(dict.fromkeys(method for law in LAWS.choices if issubclass(law, ContactLaw) for method in law.methods))


@dataclass(frozen=True, kw_only=True)
class Solver(Section):
    """How the contact is found, and how well.

    method "auto" takes the fastest method for the contact law.  On periodic cells dynamics ("gfmd") take over where the
    active set fails, with "auto" and storage "float64", and where Newton's steps cycle.
    """

    where: ClassVar[str] = "solver"
    method: str = key(choice("auto", *METHODS), "auto", "auto: the fastest for the contact law")
    tolerance: float = key(
        number(above=0, below=1),
        1e-8,
        "certified error of the energy, over twice the elastic energy, at which the solver stops; at 1e-8 the error "
        "of the pressure is 1e-3 ... 1e-4 of its rms value",
        unit="1",
    )
    max_iterations: int | None = key(integer(1), about='time steps of "gfmd", 10000 if not given; others need no limit')
    transform: str = key(
        choice(*TRANSFORMS), "blocked", "transforms by blocks that stay in cache, or by the library mpi4py-fft"
    )
    storage: str = key(
        choice("float64", "float32"), "float64",
        "of heights, pressure and gap; float32 takes 4 to 5 bytes per point less, of 25 to 36, for hard walls on "
        "periodic cells; heights are rounded to 6e-8 of the largest, and the contact of these is certified",
    )  # fmt: skip

    def check(self) -> None:
        """`max_iterations` is given for dynamics only."""
        if self.max_iterations is not None and self.method != "gfmd":
            raise wrong(self, "max_iterations", 'belongs to method = "gfmd" only; the others stop by themselves')

    def check_law(self, law: ContactLaw) -> None:
        """Raises InputError for a method that cannot take that law."""
        if self.method not in ("auto", *law.methods):
            allowed, kind = ", ".join(("auto", *law.methods)), show(law.kind)
            raise InputError(f"solver.method = {show(self.method)}: must be one of {allowed} for wall.kind = {kind}")

    def check_storage(self, law: ContactLaw, solid: Solid, domain: Domain, lengths: Sides, spacing: Sides) -> None:
        """Raises InputError for what cannot be solved in single precision."""
        if self.storage == "float64":
            return
        for reason in (
            law.kind != "hard" and f"wall.kind = {show(law.kind)}",
            self.method not in ("auto", "active-set") and f"solver.method = {show(self.method)}",
            not domain.wraps and 'grid.boundary = "open"',
            solid.softest(lengths, spacing) < SOFT and "so thin a solid",
        ):
            if reason:
                raise InputError(f'solver.storage = "float32": not with {reason}; take "float64"')

    def check_domain(self, law: ContactLaw, solid: Solid, domain: Domain) -> None:
        """Raises InputError for what cannot be solved on that domain."""
        if domain.wraps:
            return
        solid.check_domain(domain)
        method = law.methods[0] if self.method == "auto" else self.method
        for reason in (
            method == "gfmd" and f'wall.kind = {show(law.kind)} by "gfmd": dynamics move the surface outside too',
            self.transform == "mpi4py-fft" and 'solver.transform = "mpi4py-fft": it does not pad; take "blocked"',
        ):
            if reason:
                raise InputError(f'grid.boundary = "open": not with {reason}')


@dataclass(frozen=True, kw_only=True)
class Load(Section):
    """What is imposed, one solution per entry, in the order given: exactly one of the five lists, or percolation."""

    where: ClassVar[str] = "load"
    shown: ClassVar[tuple[str, ...]] = ("pressure",)
    pressure: tuple[float, ...] | None = key(
        many(number(), least=1), about="mean pressure, ≥ 0 unless the wall attracts", unit="pressure", example=[0.01]
    )
    contact_area: tuple[float, ...] | None = key(
        many(number(above=0, below=1), least=1), about="relative contact area", unit="1", example=[0.01, 0.1]
    )
    mean_gap: tuple[float, ...] | None = key(many(number(), least=1), about="mean gap", unit="length")
    displacement: tuple[float, ...] | None = key(
        many(number(), least=1),
        about="approach of the solid's far side (half-space: of its mean plane) from where the flat solid touches the "
        "highest point",
        unit="length",
    )
    force: tuple[float, ...] | None = key(
        many(number(), least=1), about="total force: mean pressure times the area of the cell", unit="pressure*length^2"
    )
    percolation: str | None = key(
        choice("gap"),
        about="one contact, at the highest load found at which a path in the gap, over edges of pixels, still winds "
        "around the periodic cell; the table of loads holds the loads between which the last one closes",
    )
    cycle: bool = key(flag(), False, "the list is followed by itself backwards: loading, then unloading")
    branch: str = key(
        choice("follow", "cold", "probe"), "follow",
        'of a wall that attracts. "follow": each contact continues from the last; "cold": from the undeformed solid; '
        '"probe": from the contact at longer ranges, which often finds states of lower energy',
    )  # fmt: skip
    jump_accuracy: float = key(
        number(low=0, high=1), 0.02,
        "a jump is bisected until its loss is known to this (at most 2 %), or this/64 of the step; 0: none is sought",
        unit="1",
    )  # fmt: skip
    area_tolerance: float = key(
        number(above=0, below=1),
        0.005,
        "relative, of contact_area: it is met to this or to one pixel; where it jumps, to the nearer side",
        unit="1",
    )
    gap_tolerance: float = key(
        number(above=0, below=1),
        1e-4,
        "of mean_gap and displacement, relative to a length. Hard wall: the approach since first contact, or the mean "
        "gap if that is less (limited hardness: plus the mean plastic depth for displacement). Exponential wall: that "
        "approach, or zeta if that is more, but at most the rms height. Formula: the approach since first contact at "
        "the smallest of gaps, or the way to either end of gaps if that is less; or −p/(dp/dgap) at the mean pressure "
        "if that is more, but at most the rms height. Displacement of a slab on a rigid base: itself in place of the "
        "approach",
        unit="1",
    )

    percolation_accuracy: float = key(
        number(above=0, below=1),
        1e-3,
        "relative distance of those two loads; the solver's tolerance is at most its square over 100",
        unit="1",
    )

    def check(self) -> None:
        """Exactly one list is given."""
        given = [name for name in CONTROLS if getattr(self, name) is not None]
        if len(given) != 1:
            found = f"found {' and '.join(given)}" if given else "found none"
            raise InputError(f"load: give exactly one of {', '.join(CONTROLS)}; {found}")
        if self.cycle and self.percolation:
            raise wrong(self, "cycle", "is for lists; percolation is one load")
        if self.cycle:  # written out, so that a list can be compared with that of earlier results
            object.__setattr__(self, given[0], self.targets + self.targets[-2::-1])
            object.__setattr__(self, "cycle", False)

    def check_law(self, law: ContactLaw, cell: float = 1.0) -> None:
        """Raises InputError for targets that a law cannot have.  cell: its area, by which forces are divided."""
        kind = show(law.kind)
        if self.contact_area or self.percolation:
            if not law.releases:
                raise wrong(self, self.control, f"cannot be imposed with wall.kind = {kind}, which touches everywhere")
            if not law.convex:
                raise wrong(self, self.control, f"cannot be imposed with wall.kind = {kind}: the area is not monotonic")
        lowest, highest = (limit * (cell if self.force else 1.0) for limit in (law.lowest, law.highest))
        if loads := self.pressure or self.force:
            if min(loads) < lowest:
                raise wrong(self, self.control, f"must be a number ≥ {lowest:g} with wall.kind = {kind}")
            if not law.releases and 0.0 in loads:
                raise wrong(self, self.control, f"must be > 0 with wall.kind = {kind}, which touches everywhere")
            if not max(loads) < highest:
                raise wrong(self, self.control, f"must be below {highest:g}, the most the wall bears")
        loading = sorted(self.targets, reverse=self.control == "mean_gap")
        if law.highest < math.inf and list(self.targets) != loading:
            back = "rise" if self.control == "mean_gap" else "fall"
            raise wrong(
                self, self.control, f"must not {back} from entry to entry with wall.kind = {kind}, which keeps the "
                "shape to which it has yielded; to unload, solve for the heights less the field plastic_depth"
            )  # fmt: skip

    def check_domain(self, domain: Domain) -> None:
        """Raises InputError for what needs a period where there is none."""
        if self.percolation and not domain.wraps:
            raise wrong(self, "percolation", 'needs a period, not boundary = "open": paths wind around the cell')

    @property
    def control(self) -> str:
        """The name of what is imposed."""
        return next(name for name in CONTROLS if getattr(self, name) is not None)

    @property
    def targets(self) -> tuple[float, ...]:
        """The values imposed; of percolation the critical constriction, 0."""
        return (0.0,) if self.percolation else getattr(self, self.control)

    def in_pressure(self, lengths: tuple[float, float]) -> Load:
        """The same on a cell of these sides, with mean pressures in place of forces."""
        if self.force is None:
            return self
        return replace(self, force=None, pressure=tuple(force / (lengths[0] * lengths[1]) for force in self.force))

    def imposing(self, targets: tuple[float, ...]) -> Load:
        """The same with other values imposed, where there are values."""
        values: dict[str, Any] = {} if self.percolation else {self.control: targets}
        return replace(self, **values)


CONTROLS = ("pressure", "contact_area", "mean_gap", "displacement", "force", "percolation")

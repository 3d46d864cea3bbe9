"""For scripts and notebooks: `solve` the contact of a surface, `certify` a pressure.  No files here."""

from __future__ import annotations

import dataclasses
import logging
import math
import sys
from collections.abc import Generator, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Generic, TypedDict, TypeVar, Unpack, overload

import numpy as np

import pgfmd.observables.observable_kinds  # noqa: F401  (fills the table of observables)
from pgfmd.arguments import BOUNDARY, SPACING, agree, alike, own_copy, rule_of_load, section_of, surface_of, targets_of
from pgfmd.errors import InputError
from pgfmd.grid.domain import DOMAINS, Domain
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import interpolate
from pgfmd.observables.contact import Certified, Contact, certified
from pgfmd.observables.percolation import gap_percolates
from pgfmd.options.rules import POSITIVE, checked, integer, number
from pgfmd.options.text import show
from pgfmd.parallel.collectives import raise_together
from pgfmd.parallel.mpi import ALONE, MPI
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.laws.table import LAWS
from pgfmd.physics.problem import ContactProblem
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.physics.solids.kinds import SOLIDS
from pgfmd.physics.solids.solid import POISSON, Solid
from pgfmd.solvers.adhesive_branch import Branch
from pgfmd.solvers.dispatch import solve_contact
from pgfmd.solvers.load_control import LoadControl, load_control
from pgfmd.solvers.nondimensional import in_storage
from pgfmd.solvers.options import Load, Solver
from pgfmd.solvers.solution import ContactSolution, SolverState
from pgfmd.surfaces.file import fill_holes, warn_of_edges
from pgfmd.surfaces.measurement import is_topography

T = TypeVar("T")
IMPOSED = "pressure", "contact_area", "mean_gap", "displacement", "force"
CLOSENESS = "area_tolerance", "gap_tolerance", "percolation_accuracy"
log = logging.getLogger("pgfmd")


class Options(TypedDict, total=False):
    """Arguments of `solve` other than the heights and what is imposed."""

    contact_modulus: float
    spacing: float | tuple[float, float] | None
    tolerance: float
    wall: ContactLaw | Mapping[str, Any] | None
    zeta: float | None
    solid: Solid | Mapping[str, Any] | None
    thickness: float
    base: str | None
    poisson: float
    method: str
    storage: str
    area_tolerance: float
    gap_tolerance: float
    percolation_accuracy: float
    start: np.ndarray | None
    refine: int
    boundary: str
    comm: MPI.Comm | None
    threads: int | None
    progress: bool | None


class Imposed(Options, Generic[T], total=False):
    """`Options`, and what can be imposed instead of a pressure: numbers (T: one, or a list), or `percolation`."""

    contact_area: T
    mean_gap: T
    displacement: T
    force: T
    percolation: str


@overload
def solve(heights: np.ndarray, pressure: float | None = None, **options: Unpack[Imposed[float]]) -> Contact: ...


@overload
def solve(
    heights: np.ndarray,
    pressure: Sequence[float] | np.ndarray | None = None,
    **options: Unpack[Imposed[Sequence[float]]],
) -> Iterator[Contact]: ...


def solve(
    heights: np.ndarray,
    pressure: Any = None,
    *,
    contact_area: Any = None,
    mean_gap: Any = None,
    displacement: Any = None,
    force: Any = None,
    percolation: str | None = None,
    percolation_accuracy: float = 1e-3,
    contact_modulus: float = 1.0,
    spacing: float | tuple[float, float] | None = None,
    tolerance: float = 1e-8,
    wall: ContactLaw | Mapping[str, Any] | None = None,
    zeta: float | None = None,
    solid: Solid | Mapping[str, Any] | None = None,
    thickness: float = math.inf,
    base: str | None = None,
    poisson: float = 0.25,
    method: str = "auto",
    storage: str = "float64",
    area_tolerance: float = 0.005,
    gap_tolerance: float = 1e-4,
    start: np.ndarray | None = None,
    refine: int = 1,
    boundary: str = "periodic",
    comm: MPI.Comm | None = None,
    threads: int | None = None,
    progress: bool | None = None,
) -> Contact | Iterator[Contact] | list[Contact]:
    """The contact of one surface at one load, or an iterator over its contacts at a list of them.  Collective.

    Or, for heights (B, nx, ny), the list of the contacts of B surfaces at one load, each as if it were solved alone.

    heights: without `comm` the whole surface (nx, ny), solved by this process alone; with it this rank's rows
    (nx_local, ny), split as `parallel.slab` does.  Any consistent units.  The fields of the answer are split like them.
    They are copied, once, unless the array cannot be written (`heights.flags.writeable = False` saves the memory).
    Or a two-dimensional topography of the package SurfaceTopography, whole on each rank or decomposed like the rows:
    then the spacing is its own, in its unit, and up to a third of its points may be undefined; they are filled.

    contact_modulus: E', by default 1, the unit of pressures then.  A job has no default for it.

    Exactly one of pressure, contact_area, mean_gap, displacement (what they mean: [load] of a job) and force (pressure
    times the area of the cell) is imposed: a number, or a list, whose contacts are solved when the iterator reaches
    them, each starting from the last where that pays.  Or percolation="gap": the contact at the
    highest load found at which the gap percolates.  area_tolerance, gap_tolerance, percolation_accuracy: see [load] of
    a job.

    boundary: "periodic", or "open": the heights are a patch of an infinite surface, and no pressure acts outside of it;
    displacement is then the approach of distant points.

    spacing: of the grid; None: that of a topography, else 1.  wall: a contact law, or its keys as in [wall] of a job; a
    hard wall if this and zeta are None.  zeta: the range of an exponential wall with σ_ref = contact_modulus.
    thickness, base ("bonded" if None), poisson: a slab instead of a half-space.  solid: a solid, or its keys as in
    [solid], instead of these and contact_modulus.  comm: the ranks that solve together; None: this process alone.
    method: see `solvers.options`.  storage: precision of heights, pressure and gap, "float32" for a hard wall on a
    periodic cell alone, for large grids: 4 to 5 bytes per point less.  start: a pressure (where the wall attracts, a
    gap) to begin with, split like the fields of the answer.  refine: those are on a grid with so many times the points
    each way, onto which the heights of a periodic surface are interpolated by their Fourier modes.  tolerance:
    certified relative energy error (1e-8: pressures to some 1e-3 … 1e-4 of their rms value).  threads: of this process;
    OMP_NUM_THREADS or the free cores if None.  progress: whether to show a bar; None: in notebooks only.

    Raises InputError for heights that are masked, not finite or wrongly split, values out of range and arguments that
    differ between ranks, SolverError if the tolerance cannot be reached, Unreachable if no load gives the target.

    >>> import numpy as np, pgfmd
    >>> wave = np.cos(2 * np.pi * np.arange(64) / 64)
    >>> heights = wave[:, None] * wave
    >>> pgfmd.solve(heights, contact_area=0.3).contact_area
    0.29931640625
    >>> [round(contact.mean_gap, 3) for contact in pgfmd.solve(heights, [0.01, 0.02, 0.04])]
    [0.287, 0.132, 0.028]
    """
    comm = ALONE if comm is None else comm
    given = locals()  # the arguments by name, as nothing else is a variable yet
    if _is_batch(comm, heights):
        return _batch(given)
    with raise_together(comm):
        topography, (heights, spacing) = heights, surface_of(heights, spacing, comm)
        name, targets, single = targets_of({name: given[name] for name in (*IMPOSED, "percolation")})
        refine, domain = checked("refine", refine, integer(1)), DOMAINS[checked("boundary", boundary, BOUNDARY)]
        if refine > 1 and not domain.wraps:
            raise InputError('refine: must be 1 with boundary = "open": heights that do not wrap have no Fourier modes')
        solid = _solid(contact_modulus, thickness, base, poisson, solid)
        law = _law(wall, zeta)
        if name == "force" and min(targets) < 0 <= law.lowest:
            raise InputError(f"force = {show(force)}: must be a number ≥ 0 with wall.kind = {show(law.kind)}")
        options = Solver(
            method=method, storage=storage, tolerance=checked("tolerance", tolerance, number(above=0, below=1))
        )
        closeness = {key: checked(key, given[key], rule_of_load(key)) for key in CLOSENESS}
    agree(comm, (name, targets, single, solid, law, options, closeness, refine, domain, start is None))
    own = _grid(comm, heights, spacing, threads, domain)
    _mend(own, heights, topography)
    grid = own if refine == 1 else own.like(comm, (refine * own.shape[0], refine * own.shape[1]), own.lengths)
    options.check_domain(law, solid, domain)
    options.check_storage(law, solid, domain, grid.lengths, grid.spacing)
    if refine > 1:
        with own.freed(), grid.freed():  # so that no transforms stay if what follows is refused
            heights = interpolate(own, grid, heights)
    grid.storage = np.dtype(storage).type
    heights = in_storage(grid, heights)
    if start is not None:
        with raise_together(comm):
            pressed = alike("start", start, heights)
            start = pressed if single else own_copy(pressed, start)  # a list is solved later
    solid.prepare(grid)
    if name == "force":
        name, targets = "pressure", tuple(target / math.prod(grid.lengths) for target in targets)
    asked_load = Load(**{name: targets, **closeness})
    shown = "ipykernel" in sys.modules and "IPython" in sys.modules if progress is None else progress
    control = load_control(asked_load, ContactProblem(grid, heights, solid, law), options.tolerance)
    if isinstance(control, LoadControl):
        control.solver, control.percolates = partial(_solve, options, shown), gap_percolates
    control.check_targets(asked_load.targets)
    control.resume(start)
    contacts = _contacts(control, asked_load.targets, not getattr(topography, "is_periodic", True))
    if not single:
        return contacts
    try:
        return next(contacts)
    finally:
        contacts.close()


def _is_batch(comm: MPI.Comm, heights: Any) -> bool:
    """Whether heights are several surfaces.  Raises InputError unless all ranks have as many.  Collective."""
    several = getattr(heights, "ndim", 2) == 3 and not is_topography(heights)
    counts = set(comm.allgather(len(heights) if several else None))
    if len(counts) > 1:
        raise InputError("heights: the ranks hold different numbers of surfaces")
    return several


def _batch(options: dict[str, Any]) -> list[Contact]:
    """The contacts of surfaces (B, nx_local, ny), from the arguments of `solve`.  Collective."""
    surfaces = options.pop("heights")
    with raise_together(options["comm"]):
        if not len(surfaces) or options["start"] is not None or any(np.ndim(options[name]) for name in IMPOSED):
            raise InputError("heights (B, nx, ny): B ≥ 1 surfaces take one load, as a number, and no start")
    return [solve(heights, **options) for heights in surfaces]


def certify(
    heights: np.ndarray,
    pressure: np.ndarray,
    mean_pressure: float | None = None,
    *,
    contact_modulus: float = 1.0,
    spacing: float | tuple[float, float] | None = None,
    wall: ContactLaw | Mapping[str, Any] | None = None,
    zeta: float | None = None,
    solid: Solid | Mapping[str, Any] | None = None,
    thickness: float = math.inf,
    base: str | None = None,
    poisson: float = 0.25,
    boundary: str = "periodic",
    comm: MPI.Comm | None = None,
    threads: int | None = None,
) -> Certified:
    """The certificate of any pressure on a surface, whatever program it comes from, as a contact.  Collective.

    heights, and all that follows the mean pressure: as for `solve`.  pressure: like the heights, positive where the
    solids press.  It is made feasible: cut to its bounds, and brought to `mean_pressure` (its own if None) by a factor.
    What it takes: 1.5 transforms.

    A pressure that fits heights of quite another scale is reported in the log.  Raises InputError as `solve` does, and
    for a pressure that is not of the heights' shape, not finite, uniform, or without a positive sum; SolverError where
    nothing can be certified.

    >>> import numpy as np, pgfmd
    >>> wave = np.cos(2 * np.pi * np.arange(64) / 64)
    >>> heights = wave[:, None] * wave
    >>> solved = pgfmd.solve(heights, 0.01, tolerance=1e-4)
    >>> pgfmd.certify(heights, solved.pressure).certified_error < 1e-4
    True
    """
    comm = ALONE if comm is None else comm
    with raise_together(comm):
        topography, (heights, spacing) = heights, surface_of(heights, spacing, comm)
        given = alike("pressure", pressure, heights)
        if not np.isfinite(given).all():
            raise InputError("pressure: all values must be finite")
        solid, law = _solid(contact_modulus, thickness, base, poisson, solid), _law(wall, zeta)
        domain = DOMAINS[checked("boundary", boundary, BOUNDARY)]
        solid.check_domain(domain)
        mean = None if mean_pressure is None else checked("mean_pressure", mean_pressure, POSITIVE)
    agree(comm, (solid, law, mean, domain))
    grid = _grid(comm, heights, spacing, threads, domain)
    _mend(grid, heights, topography)
    with grid.freed():
        solid.prepare(grid)
        contact = certified(ContactProblem(grid, heights, solid, law), given, mean)
    if contact.projection.doubt and comm.rank == 0:
        log.warning("%s", contact.projection.doubt)
    return contact


def _mend(grid: SlabGrid, heights: np.ndarray, given: Any) -> None:
    """Fill the undefined points of a topography, in place, and warn of edges that do not match.  Collective."""
    if is_topography(given):
        fill_holes(grid, heights)
        if not given.is_periodic:
            warn_of_edges(grid, heights)


def _grid(comm: MPI.Comm, heights: np.ndarray, spacing: Any, threads: Any, domain: Domain) -> SlabGrid:
    """The grid of heights that are split over the ranks; raises InputError.  Collective."""
    with raise_together(comm):
        ax, ay = checked("spacing", 1.0 if spacing is None else spacing, SPACING)
        threads = None if threads is None else checked("threads", threads, integer(1))
    rows, ny = comm.allgather(len(heights)), heights.shape[1]
    agree(comm, (ax, ay, ny))
    grid = SlabGrid(comm, (sum(rows), ny), (sum(rows) * ax, ny * ay), threads, domain=domain)
    if rows != list(np.diff(grid.starts)):
        raise InputError(f"heights: the ranks hold {rows} rows; expected {list(map(int, np.diff(grid.starts)))}")
    return grid


def _law(wall: ContactLaw | Mapping[str, Any] | None, zeta: float | None) -> ContactLaw:
    """The contact law of the arguments of `solve`; raises InputError."""
    if wall is None:
        return HardWall() if zeta is None else ExponentialWall(zeta=zeta)
    if zeta is not None:
        raise InputError(f"zeta = {show(zeta)}: give it or a wall, not both")
    return section_of(LAWS, ContactLaw, wall)


def _solid(
    contact_modulus: float, thickness: float, base: str | None, poisson: float, solid: Solid | Mapping[str, Any] | None
) -> Solid:
    """The solid of the arguments of `solve`; raises InputError."""
    slab: dict[str, Any] = {"contact_modulus": contact_modulus, "thickness": thickness}
    slab |= {"base": base, "poisson": poisson}
    if solid is None:
        checked("poisson", poisson, POISSON)  # never None, as it may be in a job
        return Homogeneous(**slab | {"base": "bonded" if base is None else base})
    for name, value in slab.items():
        if show(value) != show((solve.__kwdefaults__ or {})[name]):
            raise InputError(f"{name} = {show(value)}: give it or a solid, not both")
    return section_of(SOLIDS, Solid, solid)


def _contacts(
    control: LoadControl | Branch, targets: Sequence[float], cut_out: bool
) -> Generator[Contact, None, None]:
    """The contacts at the targets, one after another; cut_out: whether the surface goes on beyond.  Collective."""
    with control.grid.freed():
        for target in targets:
            solution = control.solution(target)
            problem = control.problem.at(solution.mean_pressure)
            contact = Contact(**vars(solution), problem=problem, displacement=control.displacement(solution))
            if cut_out:
                contact.warn_at_border()
            yield contact


def _solve(
    options: Solver, shown: bool, problem: ContactProblem, start: np.ndarray | None, tolerance: float
) -> ContactSolution:
    """One contact, with a progress bar if `shown`.  Collective."""
    options, grid = dataclasses.replace(options, tolerance=tolerance), problem.grid
    if not shown:
        return solve_contact(problem, options, start)
    from pgfmd.application.progress import Progress

    label, before = f"pressure {problem.mean_pressure:.4g}", grid.transforms
    bar = Progress(grid.comm.rank, 1, grid.shape, tolerance)
    bar.begin(label)

    def see(level: SlabGrid, state: SolverState) -> None:
        bar.step(level.shape, state.error, state.contact / level.size, grid.transforms - before)

    try:
        return solve_contact(problem, options, start, see)
    finally:
        bar.hide()

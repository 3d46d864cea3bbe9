"""The job: a TOML file (or Python values) as one frozen, validated Job.  No MPI here."""

from __future__ import annotations

import dataclasses
import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

from pgfmd import plugins as user_plugins
from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.observables.adhesive_state import Adhesion
from pgfmd.observables.contact_patches import ContactPatches
from pgfmd.observables.observable import Observable
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.observables.percolation import ClosingLoad
from pgfmd.observables.schema import FIELDS
from pgfmd.options.rules import assignment, checked, choice, many, number, text
from pgfmd.options.section import Kinds, Section, build, key, wrong
from pgfmd.options.section import as_toml as section_as_toml
from pgfmd.options.text import as_toml_value, guess, printable, show
from pgfmd.physics.laws.hard import HardWall
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.laws.table import LAWS
from pgfmd.physics.solids.homogeneous import Homogeneous
from pgfmd.physics.solids.kinds import SOLIDS
from pgfmd.physics.solids.solid import Solid
from pgfmd.plugins import Plugin
from pgfmd.solvers.options import CONTROLS, Load, Solver
from pgfmd.surfaces.rigid_surface import Surface
from pgfmd.surfaces.surface_kinds import SURFACES

PLUGINS = many(text())
NO_UNIT = "length"  # the length_unit of jobs that do not say one
NEEDED = {
    "grid": "n, the points per side (those of a file of heights if it is left out)",
    "surface": "kind, the sort of heights",
    "load": f"one of {', '.join(CONTROLS)}",
}


@dataclass(frozen=True, kw_only=True)
class Run(Section):
    """Checkpoints and time limit of a run, for machines that stop long jobs; how its files are written.  Not compared
    by --restart: it does not change results.
    """

    where = "run"
    checkpoint_interval: float = key(
        number(low=0, infinite=True), 1800.0, "between checkpoints of an unfinished load; 0: each step; inf: none",
        unit="s",
    )  # fmt: skip
    time_limit: float = key(
        number(above=0, infinite=True), math.inf, "of the run, which stops before it, ready for --restart", unit="s"
    )
    io_hints: tuple[str, ...] = key(
        many(assignment()), (), "for MPI-IO, which ignores unknown ones; stripes are set on the folder (lfs setstripe)",
        example=["cb_nodes=8", "romio_cb_write=enable"],
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Written(Section):
    """What is written.  Only what is listed is computed; options of observables that are not listed have no effect."""

    where = "output"
    shown: ClassVar[tuple[str, ...]] = ("fields", "observables")
    fields: tuple[str, ...] = key(
        many(choice(*FIELDS), distinct=True), (), "written for each load (height: once); none if left out",
        example=("height", "pressure", "gap"),
    )  # fmt: skip
    observables: tuple[str, ...] = key(
        many(choice(*OBSERVABLES), distinct=True), (), "measured for each load; none if left out",
        example=("histogram", "spectra"),
    )  # fmt: skip
    precision: str = key(choice("float64", "float32"), "float64", "of the fields in the files")
    length_unit: str = key(
        text(), "length", "label; heights from a file that has a unit are converted to it; left out: that of the file"
    )
    pressure_unit: str = key(text(), "pressure", "label")

    def check(self) -> None:
        makers = {field: name for name, kind in OBSERVABLES.items() for field in kind.fields}
        for field in self.fields:
            if field in makers and makers[field] not in self.observables:
                raise wrong(self, "fields", f'{field} comes from the observable "{makers[field]}": list that as well')

    @property
    def asked(self) -> list[Observable]:
        """The observables that are measured, with their options."""
        return [getattr(self, name) for name in self.observables]

    @property
    def idle(self) -> list[str]:
        """A warning for each table [output.NAME] that changes an observable which is not listed."""
        names = [each.name for each in dataclasses.fields(self) if each.name in OBSERVABLES.keys() - self.observables]
        given = [name for name in names if getattr(self, name) != OBSERVABLES[name]()]
        return [f"output.{name}: has no effect, as output.observables does not list {name}" for name in given]

    @property
    def connectivity(self) -> int:
        """Connectivity of the contact patches, in their table and in the field of labels."""
        patches: ContactPatches = getattr(self, ContactPatches.name)
        return patches.connectivity


def output_section() -> type[Written]:
    """The section [output]: `Written` with all observables, plugins' included, and a table [output.NAME] for each."""
    return _output_section(tuple(OBSERVABLES.items()))


@cache
def _output_section(kinds: tuple[tuple[str, type[Observable]], ...]) -> type[Written]:
    listed = {field.name: field for field in dataclasses.fields(Written)}["observables"].metadata
    names = many(choice(*(name for name, _ in kinds)), distinct=True)
    observables = key(names, (), listed["about"], example=listed["example"])
    fields = [("observables", tuple, observables), *((name, kind, key(kind)) for name, kind in kinds)]
    names_of_class = {"__doc__": Written.__doc__, "__module__": __name__}
    return dataclasses.make_dataclass(
        "Output", fields, bases=(Written,), namespace=names_of_class, frozen=True, kw_only=True
    )


@dataclass(frozen=True, kw_only=True)
class Job:
    """A whole job.  Checks on creation that its sections fit together; raises InputError."""

    grid: Cell
    surface: Surface
    solid: Solid = dataclasses.field(default_factory=Homogeneous)
    wall: ContactLaw = dataclasses.field(default_factory=HardWall)
    load: Load
    solver: Solver = dataclasses.field(default_factory=Solver)
    output: Written = dataclasses.field(default_factory=lambda: output_section()())
    run: Run = dataclasses.field(default_factory=Run)
    plugins: tuple[Plugin, ...] = ()
    text: str = dataclasses.field(default="", compare=False, repr=False)  # the TOML file as the user wrote it

    def __post_init__(self) -> None:
        self.surface.whole.check_in(self.grid)
        self.solver.check_law(self.wall)
        self.load.check_law(self.wall, math.prod(self.grid.lengths))
        self.load.check_domain(self.grid.domain)
        if not self.wall.convex:
            self._always(Adhesion.name)
        if self.load.percolation:
            self._always(ClosingLoad.name)
        elif ClosingLoad.name in self.output.observables:
            raise InputError(f"output.observables: {ClosingLoad.name} needs load.percolation")
        for observable in self.output.asked:
            if not self.wall.convex and not observable.attraction:
                attracts = f"wall.kind = {show(self.wall.kind)}"
                raise InputError(f"output.observables: {observable.name} is not measured with {attracts}")
            observable.check_in(self.grid.domain)
            observable.check_storage(self.solver.storage == "float64")
            observable.check_contact(self.solid, self.wall)
        self.solver.check_domain(self.wall, self.solid, self.grid.domain)
        self.solver.check_storage(self.wall, self.solid, self.grid.domain, self.cell.lengths, self.cell.spacings)

    def _always(self, name: str) -> None:
        """Adds an observable to those that are asked for."""
        if name not in self.output.observables:
            names = (*self.output.observables, name)
            object.__setattr__(self, "output", dataclasses.replace(self.output, observables=names))

    def __reduce__(self) -> tuple:  # pickled as text for other ranks, which may not see its files
        return _job, (self.plugins, _tables_of(self), self.text)

    @property
    def imposed(self) -> Load:
        """The load, with forces converted to mean pressures."""
        return self.load.in_pressure(self.grid.lengths)

    @property
    def doubts(self) -> list[str]:
        """A line for each thing that is allowed but hardly meant: options without effect, pressures above E'."""
        times = max(self.imposed.pressure or (0.0,)) / self.solid.contact_modulus
        units = f"load.{self.load.control}: the mean pressure is {times:.3g} E'; are both in the same unit?"
        return self.output.idle + [units] * (times > 1)

    @property
    def cell(self) -> Cell:
        """The grid on which contacts are solved."""
        return self.grid.refined

    @property
    def sources(self) -> dict[str, tuple[str, str | None]]:
        """The files that the job names, each with the dataset in it: key → (path, dataset)."""
        sources = {f"{name}.path": getattr(self, name).source for name in SECTIONS}
        if self.surface.second is not None:
            sources["surface.second.path"] = self.surface.bodies[1].source
        sources |= {f"plugins[{number}]": (plugin.path, None) for number, plugin in enumerate(self.plugins)}
        return {name: source for name, source in sources.items() if source is not None}

    def of_seed(self, seed: int) -> Job:
        """The job of one seed of an ensemble."""
        return dataclasses.replace(self, surface=dataclasses.replace(self.surface, seed=seed))  # type: ignore[call-arg]


def _job(plugins: tuple[Plugin, ...], effective: str, text: str) -> Job:
    _register(plugins)
    return dataclasses.replace(parse(effective), plugins=plugins, text=text)


_SECTIONS: tuple[type[Section] | Kinds, ...] = (Cell, SURFACES, SOLIDS, LAWS, Load, Solver, output_section(), Run)
SECTIONS = {kind.where: kind for kind in _SECTIONS}  # the classes of its tables; their fields are the keys


def load(path: str | os.PathLike, overrides: list[str] | tuple[str, ...] = ()) -> Job:
    """The job in the TOML file `path`, changed by `overrides` ("section.key=value"); raises InputError.

    Relative paths count from the folder of the TOML file, in overrides from the working directory; files must exist.
    """
    name = os.fspath(path)
    try:
        with open(name, "rb") as file:
            source = file.read().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{printable(name, 400)}: not a text in UTF-8 (byte {error.start})") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{printable(name, 400)}: cannot be read: {getattr(error, 'strerror', '') or error}") from None
    return parse(source, name, overrides, folder=os.path.dirname(os.path.abspath(name)))


def parse(
    source: str, name: str = "job", overrides: list[str] | tuple[str, ...] = (), folder: str | None = None
) -> Job:
    """The job in a TOML text; `name`: of the file, for messages.

    If `folder` is given, relative paths count from it, files must exist, and points, size and unit that the job leaves
    out are read from its file of heights.  Without `folder` no file is opened: the job of results says all of them.
    """
    try:
        document = tomllib.loads(source)
    except RecursionError:
        raise InputError(f"{printable(name, 400)}: not valid TOML: nested too deeply") from None
    except ValueError as error:
        raise InputError(f"{printable(name, 400)}: not valid TOML: {printable(str(error), 200)}") from None
    changes: dict[str, Any] = {}
    try:
        paths = checked("plugins", document.pop("plugins", []), PLUGINS)
        plugins = tuple(user_plugins.read(os.path.join(folder or "", path)) for path in paths)
        _register(plugins)
        _check_tables(document)
        if folder is not None:
            _anchor(document, folder)
        changes |= dict(map(_change, overrides))
        _make_way(document, changes)
        for dotted, value in changes.items():
            _override(document, dotted, value)
        _check_tables(document)
        if folder is not None:
            _complete(document)
        sections: dict[str, Any] = {section: build(SECTIONS[section], table) for section, table in document.items()}
        for section, what in NEEDED.items():
            if section not in sections:
                raise InputError(f"[{section}] is missing: it must say {what}")
        return Job(**sections, plugins=plugins, text=source)
    except InputError as error:
        # A message begins with the key.
        at_fault = "--set" if str(error).split(" ")[0].rstrip(":") in changes else printable(name, 400)
        missing = at_fault == "--set" and "no such file" in str(error)
        hint = " (a path after --set counts from the working directory)" * missing
        raise InputError(f"{at_fault}: {error}{hint}") from None


def _register(plugins: tuple[Plugin, ...]) -> None:
    """Run the plugins, and know their classes; raises InputError."""
    for plugin in plugins:
        plugin.load()
    SECTIONS["output"] = output_section()


def _check_tables(document: dict) -> None:
    """Raises InputError unless all entries of the document are tables of known names."""
    for section, table in document.items():
        if section not in SECTIONS:
            raise InputError(f"[{printable(section)}] is not a section{guess(section, list(SECTIONS))}")
        if not isinstance(table, dict):
            raise InputError(f"{section} = {show(table)}: must be a table, [{section}]")


def _change(entry: str) -> tuple[str, Any]:
    """(dotted key, value) of "section.key=value".  A value that is not TOML is taken as a text."""
    dotted, equals, value = entry.partition("=")
    names = dotted.strip().split(".")
    if not equals or len(names) < 2 or not all(names):
        raise InputError(f"--set {printable(entry, 200)}: must be section.key=value")
    try:
        table = tomllib.loads(f"value = {value}")
        parsed: Any = table["value"] if len(table) == 1 else value.strip()
    except (ValueError, RecursionError):
        parsed = value.strip()
        if parsed[:1] == "[":
            quoted = f"""texts need quotes: '{dotted}=["…"]'"""
            raise InputError(f"--set {printable(entry, 200)}: not TOML; {quoted}") from None
    return dotted.strip(), parsed


def _make_way(document: dict, changes: Mapping[str, Any]) -> None:
    """Remove what changes replace: keys that a new kind of section does not have, and any other imposed quantity."""
    for dotted, value in changes.items():
        section, _, name = dotted.partition(".")
        table, kinds, unwanted = document.get(section, {}), SECTIONS.get(section), set[str]()
        if name == "kind" and isinstance(kinds, Kinds) and (keys := kinds.keys(value)) is not None:
            unwanted = table.keys() - keys
        elif section == "load" and name in CONTROLS:
            unwanted = set(CONTROLS)
        for other in unwanted - {"kind"}:
            if f"{section}.{other}" not in changes:
                table.pop(other, None)


def _override(document: dict, dotted: str, value: Any) -> None:
    """Put a value into the document."""
    *tables, last = dotted.split(".")
    for position, name in enumerate(tables):
        document = document.setdefault(name, {})
        if not isinstance(document, dict):
            raise InputError(f"--set {printable(dotted, 200)}: {'.'.join(tables[: position + 1])} is not a table")
    document[last] = os.path.abspath(value) if last == "path" and isinstance(value, str) else value


def _anchor(document: dict, folder: str) -> None:
    """Make the `path` of each section absolute, in place."""
    for table in (*document.values(), document.get("surface", {}).get("second")):
        if isinstance(table, dict) and isinstance(table.get("path"), str) and table["path"]:
            table["path"] = os.path.join(folder, table["path"])


def _complete(document: dict) -> None:
    """Add what the document leaves out, and its file of heights says: points, size, unit.  Raises InputError."""
    for section, table in document.items():
        if isinstance(table.get("path"), str) and table["path"]:
            path, _ = build(SECTIONS[section], table).source or (table["path"], None)
            if not os.path.isfile(path):
                raise InputError(f"{section}.path: no such file: {printable(path, 400)}")
    table, grid, output = (document.get(section, {}) for section in ("surface", "grid", "output"))
    sized, unit = {"length", "spacing"} & grid.keys(), output.get("length_unit", NO_UNIT)
    if "path" not in table or sized and "n" in grid and unit != NO_UNIT:
        return
    surface: Any = build(SURFACES, table)
    extent = surface.extent(unit if isinstance(unit, str) and unit != NO_UNIT else None)
    if extent is None:
        return
    document.update(grid=grid, output=output)
    grid.setdefault("n", list(extent.n))
    if extent.lengths and not sized:
        grid["length"] = list(extent.lengths)
    if extent.unit and unit == NO_UNIT:
        output["length_unit"] = extent.unit


def as_toml(job: Job) -> str:
    """The effective job as TOML: every key with its value, defaults included.  `parse` of it gives an equal Job."""
    plugins = f"plugins = {as_toml_value([plugin.path for plugin in job.plugins])}\n\n" * bool(job.plugins)
    return plugins + _tables_of(job)


def _tables_of(job: Job) -> str:
    return "\n".join(section_as_toml(section, getattr(job, section)) for section in SECTIONS)


def tables_as_toml(job: Mapping[str, Any]) -> str:
    """The TOML text of a job given as nested tables, for `parse`; raises InputError for what TOML cannot express."""
    lines: list[str] = []
    try:
        for section, table in job.items():
            if isinstance(table, Mapping):
                lines += [f"[{section}]", *(f"{name} = {as_toml_value(value)}" for name, value in table.items()), ""]
            else:
                lines.insert(0, f"{section} = {as_toml_value(table)}")
    except (TypeError, RecursionError) as error:
        raise InputError(f"job: [{printable(str(section))}]: {error}") from None
    return "\n".join(lines)


def differences(before: Job, after: Job) -> list[str]:
    """The keys in which two jobs differ, as "section.key: old → new"; without [run], which does not change results."""
    old, new = (dict(sorted(_flat(tomllib.loads(as_toml(job))).items())) for job in (before, after))
    return [
        f"{name}: {show(old.get(name, 'not given'))} → {show(new.get(name, 'not given'))}"
        for name in old | new
        if old.get(name) != new.get(name) and not name.startswith("run.")
    ]


def _flat(tables: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Every key of nested tables, dotted."""
    values: dict[str, Any] = {}
    for name, value in tables.items():
        values |= _flat(value, f"{above}{name}.") if isinstance(value, dict) else {above + name: value}
    return values

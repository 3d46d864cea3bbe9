"""Laws, solids, surfaces and observables of a user's own file: in `solve`, in a run, on ranks, after a restart."""

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
from conftest import once, python

import pgfmd
from pgfmd import plugins
from pgfmd.application.job import as_toml, load, parse
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.errors import InputError
from pgfmd.observables.observable import Observable
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.parallel.collectives import from_root
from pgfmd.physics.laws.exponential_law import ExponentialWall
from pgfmd.physics.laws.law import ContactLaw

PLUGIN = '''
from dataclasses import dataclass
import numpy as np
from pgfmd.observables.observable import Observable
from pgfmd.observables.schema import Dataset
from pgfmd.options.rules import POSITIVE
from pgfmd.options.section import key
from pgfmd.physics.laws.hard import Hardness
from pgfmd.physics.solids.solid import Solid
from pgfmd.surfaces.rigid_surface import Surface, coordinates


@dataclass(frozen=True, kw_only=True)
class Halved(Solid):
    """A solid of a multiple of the half-space's stiffness."""

    kind = "scaled"
    multiple: float = key(POSITIVE, 2.0, "of the stiffness", unit="1")

    def factor(self, q):
        return np.full_like(q, self.multiple)


@dataclass(frozen=True, kw_only=True)
class Egg(Surface):
    """Heights of two crossed waves."""

    kind = "egg"
    amplitude: float = key(POSITIVE, about="of each", unit="length", needed=True, example=1.0)

    def heights(self, grid, length_unit=None):
        x, y = coordinates(grid)
        waves = np.cos(2 * np.pi * x / grid.lengths[0]) + np.cos(2 * np.pi * y / grid.lengths[1])
        return self.amplitude * waves


@dataclass(frozen=True, kw_only=True)
class Soft(Hardness):
    """A wall that yields."""

    kind = "soft"


@dataclass(frozen=True, kw_only=True)
class Peak(Observable):
    """The largest pressure."""

    name = "peak"
    layout = {"loads": {"peak": Dataset("{pressure}", "largest pressure")}}

    def measure(self, contact):
        peak = contact.grid.reduction.max(contact.pressure)
        return {"loads": {"peak": np.array(peak)}}
'''
JOB = """
plugins = ["mine.py"]
[grid]
n = [13, 12]
[surface]
kind = "egg"
amplitude = 0.5
[solid]
kind = "scaled"
contact_modulus = 1.0
[wall]
kind = "soft"
hardness = 0.4
[load]
pressure = [0.1, 0.2]
[output]
fields = ["height", "pressure"]
observables = ["peak"]
"""


@pytest.fixture(autouse=True)
def forgotten():
    """Nothing that a test registers is known to the next."""
    tables = [(table, table.choices, table.added) for table in plugins.TABLES.values()]
    observables = dict(OBSERVABLES)
    yield
    for table, choices, added in tables:
        object.__setattr__(table, "choices", choices)
        object.__setattr__(table, "added", added)
    OBSERVABLES.clear()
    OBSERVABLES.update(observables)


@pytest.fixture
def job(shared_tmp_path, comm):
    """The path of a job whose law, solid, surface and observable are of a file beside it."""
    if comm.rank == 0:
        (shared_tmp_path / "mine.py").write_text(PLUGIN)
        (shared_tmp_path / "job.toml").write_text(JOB)
    comm.Barrier()
    return shared_tmp_path / "job.toml"


def twin():
    """The contact of that job at its first load with a solid of the package, twice as stiff."""
    x, y = np.arange(13) / 13, np.arange(12) / 12
    heights = 0.5 * (np.cos(2 * np.pi * x)[:, None] + np.cos(2 * np.pi * y))
    return pgfmd.solve(
        heights, 0.1, contact_modulus=2.0, wall={"kind": "hardness", "hardness": 0.4}, spacing=(1.0, 1.0)
    )


@pytest.mark.mpi
def test_a_run_and_its_continuation(comm, job, shared_tmp_path):
    """A run gives the contact of the package's own parts; a restart adds a load, and refuses a changed file."""
    folder = shared_tmp_path / "out"
    def job_of(*overrides):
        return from_root(comm, load, job, overrides)

    simulate(job_of("load.pressure=[0.1]"), comm, folder)
    simulate(job_of(), comm, folder, restart=True)
    results = Results(folder)
    assert len(results) == 2 and "mine.py" in results.provenance["inputs"]
    np.testing.assert_allclose(results.field("pressure", 0), twin().pressure, atol=1e-5)
    for index in range(2):
        assert results.loads["peak"][index] == results.field("pressure", index).max()
    once(comm, (shared_tmp_path / "mine.py").write_text, PLUGIN + "\n# another version\n")
    with pytest.raises(InputError, match="the content of .*mine.py has changed since"):
        simulate(job_of(), comm, folder, restart=True)


def test_solve_takes_what_is_registered(shared_tmp_path, job):
    """By its kind, and as an object."""
    pgfmd.register(shared_tmp_path / "mine.py")
    heights = pgfmd.surface(job)
    wall, solid = {"kind": "soft", "hardness": 0.4}, {"kind": "scaled", "contact_modulus": 1.0}
    found = pgfmd.solve(heights, 0.1, wall=wall, solid=solid)
    np.testing.assert_allclose(found.pressure, twin().pressure, atol=1e-5)


def test_a_plugin_changes_no_other_job(shared_tmp_path, job):
    """A table without `kind` is of the package's own kinds, whatever is registered."""
    pgfmd.register(shared_tmp_path / "mine.py")
    text = '[grid]\nn = 8\n[surface]\nkind = "sinusoid"\namplitude = 1\n[load]\npressure = 1\n[solid]\n'
    for keys in ("contact_modulus = 1.0", "contact_modulus = 1.0\nmultiple = 3.0"):
        try:
            assert parse(text + keys).solid.kind == "homogeneous"
        except InputError as error:
            assert "solid.multiple" in str(error)


def test_other_ranks_need_no_file(job, shared_tmp_path):
    """A job that is sent to a process, which knows nothing of its plugins, arrives whole, though the file is gone."""
    (shared_tmp_path / "sent").write_bytes(pickle.dumps(load(job)))
    text = as_toml(load(job))
    (shared_tmp_path / "mine.py").unlink()
    code = """import pickle, sys
from pgfmd.application.job import as_toml
print(as_toml(pickle.load(open(sys.argv[1], "rb"))), end="")"""
    run = python(code, shared_tmp_path / "sent")
    assert run.stdout == text, run.stderr


@pytest.mark.parametrize(("text", "words"), [
    (None, "mine.py: cannot be read: No such file"),
    ("x = 1\ny = x / 0\n", "mine.py:2: ZeroDivisionError"),
    ("def x(:\n", "mine.py:1: SyntaxError"),
    ("x = 1\n", "defines no ContactLaw, Solid, Surface or Observable"),
    (PLUGIN.replace('kind = "soft"', 'kind = "hard"'), '"hard" is the name of HardWall in pgfmd'),
    (PLUGIN.replace('kind = "egg"', 'kind = ""'), "Egg: needs a kind"),
])  # fmt: skip
def test_wrong_plugins(job, shared_tmp_path, text, words):
    """One line that names the file, its line and what is wrong."""
    path = shared_tmp_path / "mine.py"
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        load(job)
    assert "\n" not in str(caught.value) and "plugins" in str(caught.value) or text


def test_plugins_must_be_names(job):
    """Anything but a text, or a list of texts, is refused."""
    job.write_text(JOB.replace('["mine.py"]', "[1]"))
    with pytest.raises(InputError, match=r"plugins = \[1\]: must be a text"):
        load(job)


def test_a_class_that_is_not_whole_is_named():
    """Keys without a dataclass, and a law without a solver, are refused with the remedy when they are registered."""

    class Bare(ContactLaw):
        kind = "bare"
        strength: float = 1.0

    class Idle(ContactLaw):
        kind = "idle"

    for wrong, remedy in ((Bare, "@dataclass"), (Idle, "methods")):
        with pytest.raises(InputError, match=remedy):
            pgfmd.register(wrong)


def _in_units(self, units, factor=1.0):
    return type(self)(zeta=factor * self.zeta / units.height, sigma_ref=1.0)


def _half_the_excess(self, pressure, gap, residual, compliance, level):
    return ExponentialWall.excess(self, pressure, gap, residual, compliance, level) / 2


def _no_residual(self, pressure, gap, residual, compliance, level):
    excess = ExponentialWall.excess(self, pressure, gap, residual, compliance, level)
    residual[...] = 0
    return excess


@pytest.mark.parametrize(("changed", "words"), [
    ({}, ""),
    ({"in_units": lambda self, units: _in_units(self, units, 2.0)}, "respond"),
    ({"excess": _half_the_excess}, "excess: .* less"),
    ({"excess": _no_residual}, "excess: the residual"),
    ({"releases": True}, "releases: True is for laws of reach 0"),
])  # fmt: skip
def test_a_law_that_contradicts_itself_is_refused(changed, words):
    """Units, answers, excess and contact lines of a user's law, here an exponential wall of which some methods are
    replaced, are compared with its gaps."""
    own = {"kind": "wrong", "in_units": _in_units} | changed
    pgfmd.register(dataclass(frozen=True, kw_only=True)(type("Wrong", (ExponentialWall,), own)))
    heights, law = np.diag([0.1, 0.0, 0.0, 0.0]), {"kind": "wrong", "zeta": 0.3}
    if not words:
        assert pgfmd.solve(heights, 0.01, wall=law, method="gfmd").certified_error < 1e-8
        return
    with pytest.raises(InputError, match=f'wall.kind = "wrong": {words}'):
        pgfmd.solve(heights, 0.01, wall=law)


def test_an_observable_may_say_where_its_keys_stand():
    """The table of a subclass is [output.NAME], unless the class says something else."""

    class Plain(Observable):
        name = "plain"

    class Elsewhere(Observable):
        name = "elsewhere"
        where = "output.there"

    assert (Plain.where, Elsewhere.where) == ("output.plain", "output.there")

"""The job file: what is allowed, what is refused and in which words; nothing is lost on the way to Python and back."""

import json
import math
import string
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import python

from pgfmd.application import job as config
from pgfmd.errors import InputError
from pgfmd.grid.cell import Cell
from pgfmd.options.key_reference import example, json_schema
from pgfmd.surfaces.surface_kinds import SURFACES

JOBS = Path(__file__).resolve().parent.parent / "jobs"
ROUGH = """
[grid]
n = 64
[surface]
kind = "self-affine"
hurst = 0.8
lambda_s = 16.0
rms_slope = 0.031
[solid]
contact_modulus = 1.0
[load]
pressure = [0.0032]
"""
TAIL = "[solid]\ncontact_modulus = 1\n[load]\npressure = 1\n"


@pytest.mark.parametrize("path", sorted(JOBS.rglob("*.toml")), ids=lambda path: path.name)
def test_every_job_of_the_repository_is_valid(path):
    """The examples that users copy obey the reference."""
    assert config.load(path).load.targets


@pytest.fixture(scope="module")
def schema():
    """The JSON Schema of a job, as editors use it."""
    validator = pytest.importorskip("jsonschema").Draft202012Validator
    document = json.loads(json_schema(config.SECTIONS.values()))
    validator.check_schema(document)
    return validator(document)


@pytest.mark.parametrize("text", [path.read_text() for path in sorted(JOBS.rglob("*.toml"))] + ["reference"])
def test_schema_takes_what_is_valid(schema, text):
    """The JSON Schema accepts every job of the repository, and the example of every kind, all keys written out."""
    for kind in [choice.kind for choice in SURFACES.choices] if text == "reference" else []:
        job = config.parse(example(config.SECTIONS.values(), kind))
        assert not list(schema.iter_errors(tomllib.loads(config.as_toml(job)))), kind
    assert text == "reference" or not list(schema.iter_errors(tomllib.loads(text)))


@pytest.mark.parametrize(
    "line",
    ["grid.m = 3", "grid.n = 0", "grid.n = 1.5", 'surface.kind = "flat"', "surface.hurst = true", 'load.pressure = "x"',
     "solid.contact_modulus = -1", 'output.fields = ["heat"]', 'wall.kind = "hard"\nwall.zeta = 1.0', "extra.key = 1",
     'output.histogram.bins = "many"'],
)  # fmt: skip
def test_schema_refuses_what_is_wrong(schema, line):
    """What one key alone makes invalid is invalid for an editor as well as for a run."""
    document = tomllib.loads(ROUGH)
    for entry in line.split("\n"):
        name, value = entry.split(" = ")
        *tables, last = name.split(".")
        table = document
        for each in tables:
            table = table.setdefault(each, {})
        table[last] = tomllib.loads(f"value = {value}")["value"]
    assert list(schema.iter_errors(document))
    with pytest.raises(InputError):
        config.parse(config.tables_as_toml(document))


def test_values_and_defaults():
    """What is written arrives with its type; what is not has the documented default."""
    job = config.parse(ROUGH)
    assert job.grid.shape == (64, 64) and job.grid.lengths == (64.0, 64.0) and job.grid.spacings == (1.0, 1.0)
    assert job.load.control == "pressure" and job.load.targets == (0.0032,)
    assert job.wall.kind == "hard" and job.solid.thickness == math.inf and job.solver.tolerance == 1e-8
    assert job.output.fields == () and job.output.patches.connectivity == 8
    assert job.surface.wavelengths(job.grid) == (16.0, 64.0, 64.0)


def test_arrays_without_axes_are_refused_in_one_line():
    """A section made in Python says what is allowed where an array has no entries to go through."""
    with pytest.raises(InputError, match=r"^grid\.n = ndarray: must be a whole number ≥ 1, or two"):
        Cell(n=np.array(32))


def test_cell_from_length_or_spacing():
    """Length and spacing are two ways to say the same cell; wavelengths count in the smaller spacing."""
    job = config.parse(ROUGH, overrides=["grid.n=[64, 32]", "grid.spacing=[0.5, 1]"])
    same = config.parse(ROUGH, overrides=["grid.n=[64, 32]", "grid.length=32"])
    assert job.grid.lengths == same.grid.lengths == (32.0, 32.0)
    assert job.grid.spacings == same.grid.spacings == (0.5, 1.0)
    assert job.surface.wavelengths(job.grid) == (8.0, 32.0, 32.0)


@pytest.mark.parametrize("given", [
    {"lame_lambda": 1.0, "lame_mu": 1.0}, {"young": 2.5, "poisson": 0.25},
    {"contact_modulus": 8 / 3, "poisson": 0.25},
])  # fmt: skip
def test_elastic_moduli_from_each_pair(given):
    """λ = μ = 1 is E = 5/2, ν = 1/4, E' = 8/3, from whichever pair it is given (rounding only: 1e-15 relative)."""
    solid = config.Homogeneous(**given)
    found = [solid.lame_lambda, solid.lame_mu, solid.young, solid.poisson, solid.contact_modulus]
    assert found == pytest.approx([1, 1, 2.5, 0.25, 8 / 3], rel=4e-15, abs=0)


def test_contact_modulus_alone_leaves_the_rest_unknown():
    """E' does not fix Poisson's ratio; a bonded slab needs it, a half-space does not."""
    assert config.Homogeneous(contact_modulus=2.0).poisson is None
    with pytest.raises(InputError, match="needs poisson"):
        config.Homogeneous(contact_modulus=2.0, thickness=3.0)


@pytest.mark.parametrize("given", [{}, {"thickness": 3.0, "base": "free"}])
def test_a_solid_has_no_default_modulus(given):
    """A job without a modulus is refused (`solve` assumes 1, earlier jobs 8/3), with what to write."""
    with pytest.raises(InputError, match=r"^solid.contact_modulus is missing: .*both 1.0 where jobs of earlier"):
        config.Homogeneous(**given)
    with pytest.raises(InputError, match="solid.contact_modulus is missing"):
        config.parse(ROUGH.replace("contact_modulus = 1.0", ""))
    with pytest.raises(InputError, match="solid.contact_modulus is missing"):
        config.parse(ROUGH.replace("[solid]\ncontact_modulus = 1.0", ""))


def test_contradicting_moduli_are_refused():
    """Redundant moduli are accepted only if they agree."""
    config.Homogeneous(lame_lambda=1.0, lame_mu=1.0, contact_modulus=8 / 3)
    with pytest.raises(InputError, match=r"solid.contact_modulus = 2.0: the other moduli give 2.66667"):
        config.Homogeneous(lame_lambda=1.0, lame_mu=1.0, contact_modulus=2.0)


@pytest.mark.parametrize("overrides", [
    [],
    ["wall.kind=exponential", "wall.zeta=0.25", "solver.method=newton"],
    ["wall.zeta=0.25"],
    ["solid.contact_modulus=3", "solid.poisson=0.1", "solid.thickness=64", "solid.base=free"],
    [f"solid.contact_modulus={0.1 / (1 - 0.4999**2)!r}", "solid.young=0.1", "solid.poisson=0.4999"],
    ["run.time_limit=3600", "grid.spacing=1e-7"],
    ["surface.lambda_l=32", "surface.lambda_r=24", "output.fields=height", "output.lowpass.q=[0.5, 1]"],
    ['output.length_unit="µ\\"\\\\\\u007f\\tm"', "output.observables=[]", "grid.n=[64, 48]"],
])  # fmt: skip
def test_effective_toml_round_trip(overrides):
    """The effective job, written as TOML and read again, is the same job."""
    job = config.parse(ROUGH, overrides=overrides)
    text = config.as_toml(job)
    assert config.parse(text) == job
    assert config.as_toml(config.parse(text)) == text
    assert set(tomllib.loads(text)) == set(config.SECTIONS)


REFUSED = {
    # override → words of the message (the key, the value, what is allowed)
    "grid.n=1": "grid.n = [1, 1]: at least one direction must have 2 points",
    "grid.n=64.0": "grid.n = 64.0: must be a whole number ≥ 1",
    "grid.n=true": "grid.n = true: must be a whole number",
    "grid.n=[4, 4, 4]": "or two of them [x, y]",
    "grid.n=" + 30 * "9": "grid.n = 999999999999999999999999999999: must be",
    "grid.length=0": "grid.length = 0: must be a number > 0",
    "grid.spacing=inf": "grid.spacing = inf: must be a number > 0",
    "grid.spacing=1e-320": "out of range",
    "grid.m=64": "grid.m is not known",
    "gird.n=64": "[gird] is not a section; did you mean grid?",
    "surface.hurts=0.5": "surface.hurts is not known; did you mean hurst?",
    "surface.hurst=1.1": "surface.hurst = 1.1: must be a number ≥ 0 and ≤ 1",
    "surface.hurst=nan": "surface.hurst = nan: must be",
    "surface.kind=fractal": 'surface.kind = "fractal": must be one of "self-affine", "file", "sinusoid", "paraboloid"',
    "surface.lambda_s=65": "surface.lambda_s = 65.0: must not exceed the cell, 64 grid spacings",
    "surface.lambda_l=8": "surface.lambda_s = 16.0: must not exceed lambda_l = 8.0",
    "surface.lambda_r=8": "surface.lambda_r = 8.0: must not be below lambda_s = 16.0",
    "surface.lambda_r=65": "surface.lambda_r = 65.0: must not exceed the cell, 64 grid spacings",
    "surface.lambda_r=inf": "surface.lambda_r = inf: must be a number > 0",
    "surface.seed=-1": "surface.seed = -1: must be a whole number ≥ 0",
    "surface.amplitude=1": 'surface.amplitude = 1: belongs to kind = "sinusoid" only',
    "solid.poisson=0.5": "solid.poisson = 0.5: must be a number > -1 and < 0.5",
    "solid.young=1": "solid: give lame_lambda and lame_mu, or young and poisson, or contact_modulus",
    "solid.base=glued": 'must be one of "bonded", "free", "sliding"',
    "solid.thickness=-inf": "solid.thickness = -inf: must be a number > 0 (inf included)",
    "wall.kind=exponential": "wall.zeta is missing: it must be a number > 0",
    "wall.zeta=-1": "wall.zeta = -1: must be a number > 0",
    "load.pressure=-0.1": 'load.pressure = [-0.1]: must be a number ≥ 0 with wall.kind = "hard"',
    "load.pressure=[]": "load.pressure = []: must be a number; or a list of them, not empty",
    'load.pressure=["a"]': 'load.pressure = ["a"]: must be',
    "solver.method=newton": 'solver.method = "newton": must be one of auto, active-set, gfmd for wall.kind = "hard"',
    "solver.tolerance=0": "solver.tolerance = 0: must be a number > 0 and < 1",
    "output.fields=[gap, gap]": """[gap, gap]: not TOML; texts need quotes: 'output.fields=["…"]'""",
    "load.force=-3": 'load.force = [-3.0]: must be a number ≥ 0 with wall.kind = "hard"',
    'output.fields=["gap", "gap"]': "; or a list of them, without repetition",
    "output.patches=8": "output.patches = 8: must be a table, [output.patches]",
    "output.patches.connectivity=6": "output.patches.connectivity = 6: must be one of 8, 4",
    "run.io_hints=cb_nodes": 'run.io_hints = "cb_nodes": must be a text "name=value" without spaces; or a list of them',
    'run.io_hints=["cb_nodes= 8"]': 'must be a text "name=value" without spaces; or a list of them',
    "surface.path=\udcff": "belongs to kind",
    "grid": "--set grid: must be section.key=value",
    "n=3": "--set n=3: must be section.key=value",
    "grid.n.x=3": "grid.n is not a table",
}


@pytest.mark.parametrize("override", REFUSED, ids=ascii)
def test_wrong_values_are_refused_in_one_line(override):
    """A wrong value: one printable line that names the key, the value and what is allowed."""
    with pytest.raises(InputError) as caught:
        config.parse(ROUGH, "job.toml", [override])
    message = str(caught.value)
    assert REFUSED[override] in message
    assert message.isprintable() and len(message) < 500
    assert message.startswith(("--set: ", "job.toml: "))


@pytest.mark.parametrize(("text", "words"), [
    ("[grid]\nn = 64\nn = 65\n" + ROUGH, "not valid TOML"),
    ("grid = 3", "grid = 3: must be a table"),
    ("", "[grid] is missing"),
    ("[grid]\nn = 4\n[load]\npressure=1\n[surface]\n", "surface.kind is missing: it must be one of"),
    ("x = " + 100000 * "[", "not valid TOML"),
    ("x = " + 5000 * "1", "not valid TOML"),
    ('["a\\nb"]\nx = 1\n', "[a?b] is not a section"),
], ids=range(7))  # fmt: skip
def test_wrong_files_are_refused_in_one_line(text, words):
    """A file that is no job says so in one line, whatever is in it."""
    with pytest.raises(InputError) as caught:
        config.parse(text, "job.toml")
    assert str(caught.value).startswith("job.toml: ") and words in str(caught.value)
    assert str(caught.value).isprintable()


def test_unreadable_files(tmp_path):
    """A job that is missing, a folder or no text is a wrong input."""
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    for name, words in (("none.toml", "No such file"), (".", "directory"), ("binary.toml", "not a text in UTF-8")):
        with pytest.raises(InputError, match=words):
            config.load(tmp_path / name)
    with pytest.raises(InputError, match="cannot be read"):
        config.load("nul\0.toml")


def test_override_values():
    """--set takes TOML values; a bare word is a text; the last one wins."""
    job = config.parse(
        ROUGH,
        overrides=["load.pressure=[1e-3, 2]", "surface.seed=3", "surface.seed=4"]
        + ["solid.base=free", "solid.thickness=9"],
    )
    assert job.load.pressure == (1e-3, 2.0) and job.surface.seed == 4 and job.solid.base == "free"
    with pytest.raises(InputError, match="load.pressure"):
        config.parse(ROUGH, overrides=["load.pressure=1\nx=2"])


def test_relative_heights_path(tmp_path, monkeypatch):
    """A heights file counts from the job's folder, in --set from the working directory; it must exist."""
    jobs, data = tmp_path / "jobs", tmp_path / "data"
    jobs.mkdir()
    data.mkdir()
    np.save(jobs / "h.npy", np.eye(8))
    with h5py.File(data / "g.h5", "w") as file:
        file["a/b"] = np.eye(8)
    (jobs / "job.toml").write_text('[grid]\nn = 8\n[surface]\nkind = "file"\npath = "h.npy"\n' + TAIL)
    monkeypatch.chdir(data)
    assert config.load(jobs / "job.toml").surface.source == (str(jobs / "h.npy"), None)
    other = config.load(jobs / "job.toml", ["surface.path=g.h5:a/b"]).surface
    assert other.source == (str(data / "g.h5"), "a/b")
    with pytest.raises(InputError, match=r"surface.path: no such file: .*h.npy \(a path after --set"):
        config.load(jobs / "job.toml", ["surface.path=h.npy"])


def test_sinusoid_must_be_resolved():
    """A wave beyond the Nyquist wave number is not on the grid."""
    surface = '[surface]\nkind = "sinusoid"\namplitude = 1\nwaves = {}\n' + TAIL
    assert config.parse("[grid]\nn = [8, 2]\n" + surface.format(4)).surface.waves == 4
    with pytest.raises(InputError, match="resolve no more than 4"):
        config.parse("[grid]\nn = [8, 2]\n" + surface.format(5))


def test_differences_name_what_changed():
    """What differs between two jobs is named; [run] does not count."""
    old = config.parse(ROUGH)
    new = config.parse(ROUGH, overrides=["surface.seed=2", "run.time_limit=60", "output.patches.connectivity=4"])
    assert config.differences(old, old) == []
    assert config.differences(old, new) == ["output.patches.connectivity: 8 → 4", "surface.seed: 1 → 2"]


def test_roll_off_of_format_1(caplog):
    """In format_version 1 lambda_l and lambda_r had each other's meaning: the same surface, with a warning."""
    rough = ROUGH.replace("lambda_s = 16.0", "lambda_s = 6\nlambda_l = {}\nlambda_r = {}")
    old, new = config.parse(rough.format(24, 48)), config.parse(rough.format(48, 24))
    assert old == new and config.as_toml(old) == config.as_toml(new)
    assert "lambda_r = 48 exceeds lambda_l = 24" in caplog.text


def test_fuzzed_jobs_end_in_a_job_or_one_line(request):
    """Any text, as a file or as a value, gives a job or an InputError of one line; nothing else ever."""
    hypothesis = pytest.importorskip("hypothesis")
    factor = 20 if request.config.getoption("--long") else 1
    keys = [name.partition("=")[0] for name in REFUSED if name.count(".")]
    values = hypothesis.strategies.one_of(
        hypothesis.strategies.text(max_size=30),
        hypothesis.strategies.text(string.digits + ".-+eEinfa[],\"'_xo {}=#\n", max_size=20),
        hypothesis.strategies.floats().map(repr),
        hypothesis.strategies.integers().map(str),
    )

    def attempt(text, overrides):
        try:
            job = config.parse(text, "job.toml", overrides)
        except InputError as error:
            assert str(error).isprintable() and len(str(error)) < 700
        else:
            assert config.parse(config.as_toml(job)) == job

    @hypothesis.settings(max_examples=500 * factor, deadline=None)
    @hypothesis.given(hypothesis.strategies.sampled_from(keys), values)
    def override(key, value):
        attempt(ROUGH, [f"{key}={value}"])

    @hypothesis.settings(max_examples=300 * factor, deadline=None)
    @hypothesis.given(hypothesis.strategies.integers(0, len(ROUGH)), values, hypothesis.strategies.integers(0, 20))
    def splice(at, value, cut):
        attempt(ROUGH[:at] + value + ROUGH[at + cut :], [])

    override()
    splice()


@pytest.mark.parametrize(("names", "libraries"), [
    ("pgfmd, pgfmd.application.job", {"mpi4py", "h5py"}), ("pgfmd.application.results", {"mpi4py"}),
])  # fmt: skip
def test_needs_no_mpi(names, libraries):
    """The package, and reading a job, import neither mpi4py nor h5py; reading results imports no mpi4py."""
    assert python(f"import sys, {names}; sys.exit(bool({libraries!r} & sys.modules.keys()))").returncode == 0

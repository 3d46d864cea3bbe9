"""What `check` predicts, against what a run takes."""

import itertools
import os
import re
import sys

import numpy as np
import pytest
from conftest import ROOT, broad
from job_texts import rough_job

import pgfmd
from pgfmd.application import estimate, job, machine
from pgfmd.grid.cell import Cell
from pgfmd.grid.grid_cost import holders, largest_shares
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.options.text import readable
from pgfmd.parallel.mpi import ALONE
from pgfmd.solvers.active_set import cropping
from pgfmd.surfaces.self_affine import SelfAffine


def text_of(n: int, pressure: float, wall: dict, **solver) -> str:
    """A job at one pressure, that writes it."""
    surface = {"lambda_s": 16.0, "rms_slope": 0.031}
    sections = {"wall": wall, "load": {"pressure": [pressure]}, "solver": {"tolerance": 1e-3} | solver}
    return rough_job(n, surface, **sections, output={"fields": ["pressure"]})


MEASURE = """
import sys, tempfile
from mpi4py import MPI
from pgfmd.application.job import parse
from pgfmd.application.simulate import simulate

def peak():
    lines = open("/proc/self/status").read().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

comm = MPI.COMM_WORLD
simulate(parse(open(sys.argv[1]).read()), comm, sys.argv[2])
found = comm.gather(peak())
if comm.rank == 0:
    print(max(found))
"""


def sphere_text(n: int, radius: float) -> str:
    """A sphere on an open patch, of that contact radius over the side."""
    surface = {"kind": "paraboloid", "radius": 4.0 * n}
    load = {"pressure": [radius**3 / 3]}
    tables = {"grid": {"n": n, "boundary": "open"}, "surface": surface, "load": load, "solid": {"contact_modulus": 1.0}}
    return job.tables_as_toml(tables | {"output": {"fields": ["pressure"]}})


def with_observable(name: str, **options) -> str:
    """A job that measures it, at a tenth of the area and a gap that percolates."""
    surface, output = {"lambda_s": 8.0, "rms_slope": 0.1}, {"observables": [name], name: options}
    solid = {"contact_modulus": 1.0, "poisson": 0.3}
    return rough_job(1024, surface, solid=solid, load={"pressure": [0.006]}, output=output)


ADHESIVE = {"kind": "adhesive", "work": 0.0002, "range": 0.05}
MEMORY = {  # job and ranks; of spheres it is predicted from a contact on coarse grids
    **{f"{n} points a side, {ranks} ranks": (text_of(n, 0.0032, {}), ranks)
       for n, ranks in itertools.product((1024, 2048), (1, 2, 4))},
    **{f"sphere, {n}, {radius}": (sphere_text(n, radius), 1) for n, radius in ((1024, 0.2), (2048, 0.05), (2048, 0.2))},
    **{f"pressure {pressure}": (text_of(1024, pressure, {}), 1) for pressure in (0.012, 0.04)},
    "gfmd": (text_of(1024, 0.0032, {}, method="gfmd"), 1),
    "mpi4py-fft": (text_of(1024, 0.0032, {}, transform="mpi4py-fft"), 1),
    "float32": (text_of(1024, 0.012, {}, storage="float32"), 1),
    "exponential": (text_of(1024, 0.0032, {"kind": "exponential", "zeta": 0.25}), 1),
    "adhesive": (text_of(1024, 0.0032, ADHESIVE), 1),
    **{name: (with_observable(name), 1) for name in ("stiffness", "percolation", "leakage", "subsurface")},
    "partial slip": (with_observable("partial_slip", friction=0.3), 1),
    **{f"area {area}": (text_of(2048, 0.01, {}).replace("pressure = [0.01]", f"contact_area = {area}"), 1)
       for area in (0.05, 0.5)},
}  # fmt: skip


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the peak of the memory from /proc")
@pytest.mark.parametrize("case", broad(MEMORY))
def test_memory_is_predicted(mpirun, tmp_path, case):
    """The peak of a rank's resident memory in a run, all libraries included, is within 15 % of what `check` says."""
    text, ranks = MEMORY[case]
    plan = estimate.explored if "sphere" in case else estimate.Plan
    script, path = tmp_path / "measure.py", tmp_path / "job.toml"
    script.write_text(MEASURE)
    path.write_text(text)
    environment = dict(os.environ) | {"OMP_NUM_THREADS": "1"}
    for attempt in range(2):  # the first may compile, whose memory counts until it is cached
        done = mpirun(ranks, script, path, tmp_path / f"out {attempt}", timeout=900, env=environment)
        assert done.returncode == 0, done.stderr
    expected = plan(job.parse(text)).estimate(ranks).memory
    assert float(done.stdout.split()[-1]) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("radius", [0.05, 0.2, 0.4])
def test_contacts_of_bodies_are_explored(radius):
    """A sphere on a patch: area πa²/L² in a rectangle of √2 a about the middle; over half of the patch, all of it."""
    asked = job.parse(sphere_text(512, radius))
    unknown, plan = estimate.Plan(asked), estimate.explored(asked)
    assert unknown.contact_areas() == [estimate.OPEN_AREA]
    (found,) = plan.extents
    assert found.area == pytest.approx(np.pi * radius**2, rel=0.15)
    assert found.part == pytest.approx(min((2 * np.sqrt(2 * cropping.MARGIN) * radius) ** 2, 1), rel=0.15)
    assert (plan.bytes_per_point() < 0.9 * unknown.bytes_per_point()) == (found.part < 0.5)
    assert estimate.WORTH == cropping.WORTH


def test_a_run_explores_what_would_be_too_large(monkeypatch):
    """A small contact on a large patch is refused neither by `check` nor by a run, which explores it only then."""
    asked = job.parse(sphere_text(8192, 0.05))
    unknown, known = (make(asked).estimate(1).node for make in (estimate.Plan, estimate.explored))
    for memory, expected in ((2 * unknown, unknown), (1.1 * known, known)):
        monkeypatch.setattr(machine, "largest_memory", lambda memory=memory: memory)
        assert machine.memory_per_rank(asked, ALONE) == expected
        machine.refuse_too_large(ALONE, expected)


@pytest.mark.parametrize("n", [64, 8192])
@pytest.mark.parametrize("load", ["pressure", "mean_gap"])
def test_an_unknown_area_is_the_one_that_takes_most_memory(n, load, tmp_path):
    """Heights of a file tell no area: as many bytes per point are counted as for the worst of all areas."""
    np.save(tmp_path / "heights.npy", np.zeros((2, 2)))
    tables = {"grid": {"n": n, "length": 1.0}, "surface": {"kind": "file", "path": str(tmp_path / "heights.npy")}}
    plan = estimate.Plan(job.parse(job.tables_as_toml(tables | {"solid.contact_modulus": 1.0, "load": {load: 0.5}})))
    assumed = plan.bytes_per_point()
    areas = [estimate.Extent(area, 1.0, 0.0) for area in np.arange(1, 101) / 100]
    worst = max(estimate.Plan(plan.job, (each,)).bytes_per_point() for each in areas)
    assert assumed == pytest.approx(worst)


def test_nodes_hold_what_their_ranks_hold():
    """On several nodes each needs its part, and a second strip (8 bytes per point), of which rows for other nodes are
    packed: (1 − 1/nodes) of it.  Contact may be uneven over nodes: never less than its part.  Ranks of a node see one
    strip, all of it."""
    one = job.parse(text_of(4096, 0.0032, {}))
    alone, apart = estimate.Plan(one).estimate(16), estimate.Plan(one).estimate(16, per_node=4)
    least = (alone.node - estimate.LIBRARY_BYTES) / 4 + 8 * 4096**2 / 4 * (1 - 1 / 4)
    assert least <= apart.node - estimate.LIBRARY_BYTES < 1.1 * least
    assert apart.memory - alone.memory == pytest.approx(8 * 4096**2 / 16 * (3 + 3 / 4 - 15 / 16), rel=1e-9)


@pytest.mark.parametrize("ranks, of", [(1, 1), (5, 2), (64, 16), (300, 300), (4096, 64)])
def test_coarse_grids_of_a_node(ranks, of):
    """The first ranks hold the points of the rows that `Layout.spread` gives them, each counted as the fullest."""
    shape = (8192, 512)
    found, holding = largest_shares(shape, ranks, of), ranks
    for level, points in enumerate(found):
        holding = holders(shape, holding) if level else ranks
        places = np.arange(holding) * ranks // holding
        rows = np.count_nonzero(places < of) * -(-shape[0] // holding)
        assert points == min(rows, shape[0]) * shape[1]
        shape = -(-shape[0] // 2), -(-shape[1] // 2)


def test_time_of_sticky_contacts():
    """The shorter the process zone ρ²E'/w, the longer; what is held needs no search; jumps from load to load more."""

    def seconds(work: float, load: str = "pressure", accuracy: float = 0.0, count: int = 1) -> float:
        wall, solid = {"kind": "adhesive", "work": work, "range": 2.0}, {"contact_modulus": 1.0}
        loads = {load: [0.01] * count, "jump_accuracy": accuracy}
        text = rough_job(2048, {"lambda_s": 16.0, "rms_slope": 1.0}, wall=wall, load=loads, solid=solid)
        return estimate.Plan(job.parse(text)).estimate(1).seconds

    assert 2 * seconds(0.1) < seconds(3.0) == seconds(3.0, accuracy=0.02)
    assert seconds(3.0, count=2) < seconds(3.0, accuracy=0.02, count=2)
    assert seconds(3.0, "mean_gap") == seconds(3.0)


@pytest.mark.parametrize("pressure", [0.001, 0.01, 0.03])
def test_a_search_costs_what_its_contact_costs(pressure):
    """At a mean gap `check` guesses the contact: its work is within a factor of 1.5 of that at the pressure."""
    given = job.parse(text_of(128, pressure, {}))
    heights = given.surface.whole.heights(SlabGrid(ALONE, given.cell.n, given.cell.lengths), None)
    contact = pgfmd.solve(heights, pressure, contact_modulus=given.solid.contact_modulus)
    expected = estimate.Plan(given).solving_costs()[0].transforms
    text = text_of(128, 0.5, {}).replace("pressure = [0.5]", f"mean_gap = {contact.mean_gap}")
    assert 1 / 1.5 < estimate.Plan(job.parse(text)).solving_costs()[0].transforms / expected < 1.5


def test_a_search_costs_more_than_a_load():
    """Three areas, which no pressure is known for, take three times as long as one, and longer than pressures."""
    seconds = [
        estimate.Plan(job.parse(text_of(1024, 0.01, {}).replace("pressure = [0.01]", load))).estimate(1).seconds
        for load in ("contact_area = [0.1]", "contact_area = [0.1, 0.2, 0.3]", "pressure = [0.01]")
    ]
    one, three, pressed = (value - estimate.START for value in seconds)
    assert 2 < three / one < 4 and one > pressed


def test_thin_free_slabs_take_more_time():
    """A contact on a free slab of .2 of the cell takes many times as long as one on a slab of .3."""
    slabs = (["solid.base=free", f"solid.thickness={thickness}"] for thickness in (200, 300))
    thin, thick = (estimate.Plan(job.parse(text_of(1024, 0.01, {}), overrides=slab)).estimate(1) for slab in slabs)
    assert thin.seconds > thick.seconds + 5 * (thick.seconds - estimate.START) / 3


def test_small_grids_take_time_too():
    """Many loads of few points take what a load takes at least, whatever its grid."""
    one = job.parse(text_of(64, 0.01, {}))
    many = job.parse(text_of(64, 0.01, {}).replace("[0.01]", str([0.01 + 1e-6 * i for i in range(2000)])))
    assert estimate.Plan(many).estimate(1).seconds > estimate.Plan(one).estimate(1).seconds + 1999 * estimate.PER_LOAD


@pytest.mark.parametrize(
    "seconds, expected", [(1.234, "1.2 s"), (105, "100 s"), (119, "120 s"), (7000, "120 min"), (5e8, "5790 days")]
)
def test_times_have_no_exponent(seconds, expected):
    """A time is a number as people write it, to two digits, days to three."""
    assert estimate.duration(seconds) == expected


def test_bytes_have_no_exponent():
    """999.7 MB, to three digits, are 1000 MB."""
    assert (readable(999.7e6), readable(1.234e9)) == ("1000 MB", "1.23 GB")


def test_the_very_large_job_says_what_check_says():
    """The table in jobs/very-large.toml: memory of a node and files within 10 %, the time within a factor of 2."""
    path = ROOT / "jobs" / "very-large.toml"
    rows = re.findall(r"^# +(\d+) +(\d+) +([\d.]+) GB +([\d.]+) GB +([\d.]+) s$", path.read_text(), re.MULTILINE)
    assert [int(n) for n, *_ in rows] == [16384, 32768, 65536] and job.load(path).grid.n[0] == 16384
    for n, ranks, memory, files, seconds in rows:
        found = estimate.Plan(job.load(path, [f"grid.n={n}"])).estimate(int(ranks), per_node=4)
        assert (found.node, found.files) == pytest.approx((float(memory) * 1e9, float(files) * 1e9), rel=0.1)
        assert 0.5 < found.seconds / float(seconds) < 2


def test_dynamics_take_longer():
    """Some six times, at sizes at which the start of a run does not matter."""
    texts = (text_of(4096, 0.01, {}, method=method) for method in ("active-set", "gfmd"))
    quick, slow = (estimate.Plan(job.parse(text)).estimate(1).seconds for text in texts)
    assert slow > 3 * quick


@pytest.mark.parametrize("length", [1e-160, 1e-85, 1.0, 1e150])
def test_known_heights_scale_with_the_cell(length):
    """The rms height of a self-affine surface, known before the run, is proportional to the cell, at any length."""
    surface = SelfAffine(hurst=0.8, lambda_s=4.0, rms_slope=0.1)
    one, other = (surface.known_height(Cell(n=(64, 64), length=side)) for side in (1.0, length))
    assert other == pytest.approx(one * length, rel=1e-12, abs=0)

"""What must not change the answer: units, position, direction, tiling, order; for all walls, solids, and controls."""

import itertools
import math
import signal

import numpy as np
import pytest
from conftest import broad, contents

pytest.importorskip("mpi4py")

import pgfmd  # noqa: E402
from pgfmd.application import job as jobs  # noqa: E402
from pgfmd.application.simulate import simulate  # noqa: E402
from pgfmd.application.stop import Interruptions  # noqa: E402
from pgfmd.errors import InputError, Stopped  # noqa: E402
from pgfmd.parallel.mpi import ALONE  # noqa: E402

pytestmark = pytest.mark.mpi

N = 12
WALLS = {
    "hard": "",
    "exponential": "[wall]\nzeta = {zeta!r}\n",
    "hardness": "[wall]\nkind = 'hardness'\nhardness = {hardness!r}\n",
}
SOLIDS = {
    "half-space": "contact_modulus = {modulus!r}\n",
    "bonded": "contact_modulus = {modulus!r}\npoisson = 0.3\nthickness = {thickness!r}\n",
    "free": "contact_modulus = {modulus!r}\nthickness = {thickness!r}\nbase = 'free'\n",
    "sliding": "contact_modulus = {modulus!r}\npoisson = 0.3\nthickness = {thickness!r}\nbase = 'sliding'\n",
}
TARGETS = {"pressure": (0.05, 0.4), "contact_area": (0.2, 0.6), "mean_gap": (1.2, 0.4), "displacement": (0.9, 1.6)}
CASES = [
    case
    for case in itertools.product(WALLS, SOLIDS, TARGETS)
    if {"hard": True, "exponential": case[2] != "contact_area", "hardness": case[1] == "half-space"}[case[0]]
]  # fmt: skip


def place(case) -> tuple[int, int, int]:
    """Which wall, solid and control a case has."""
    return tuple(list(kinds).index(kind) for kinds, kind in zip((WALLS, SOLIDS, TARGETS), case, strict=True))


# Each wall with each control, the solids in turns; all others with --all.
TURNS = [case for case in CASES if case[0] == "hardness" or sum(place(case)) % 4 == 0]
SOME = broad([(case,) for case in TURNS + [case for case in CASES if case not in TURNS]], len(TURNS))


def heights(seed: int = 3, shape=(N, N)) -> np.ndarray:
    """A rough surface."""
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8, 1e-12])
def test_ranks_differ_within_the_certificate(comm, tolerance):
    """‖p − p'‖_G ≤ √(2 D) + √(2 D') for the pressures of all ranks and of one process, of certified errors D, D'."""
    surface = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 4.0, "rms_slope": 0.1}
    job = {"grid": {"n": 64}, "surface": surface}
    both = [pgfmd.solve(pgfmd.surface(job, ranks), 0.01, tolerance=tolerance, comm=ranks) for ranks in (comm, ALONE)]
    whole = np.concatenate(comm.allgather(both[0].pressure))
    q = 2 * np.pi * np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64), indexing="ij"))
    q[0, 0] = np.inf
    square = np.sum(np.abs(np.fft.fft2(whole - both[1].pressure)) ** 2 * 2 / q) / 64**4
    bounds = [math.sqrt(2 * contact.certified_error * 2 * contact.elastic_energy) for contact in both]
    assert math.sqrt(square) <= sum(bounds)


def job_of(comm, folder, surface, case, *, length=1.0, pressure=1.0, targets=None):
    """A job in units of length and pressure, with its heights in the folder."""
    wall, solid, control = case
    if comm.rank == 0:
        folder.mkdir(exist_ok=True)
        np.save(folder / "heights.npy", surface * length)
    comm.Barrier()
    unit = {"pressure": pressure, "contact_area": 1.0}.get(control, length)
    targets = TARGETS[control] if targets is None else targets
    text = (
        f"[grid]\nn = {list(surface.shape)}\nspacing = {length!r}\n"
        f"[surface]\nkind = 'file'\npath = '{folder}/heights.npy'\n"
        + WALLS[wall].format(zeta=0.2 * length, hardness=0.8 * pressure)
        + "[solid]\n" + SOLIDS[solid].format(modulus=pressure, thickness=3.0 * length)
        + f"[load]\n{control} = {[value * unit for value in targets]}\n[solver]\ntolerance = 1e-12\n"
        + "[output]\nfields = ['pressure', 'gap']\n"
    )  # fmt: skip
    return jobs.parse(text)


def contacts(comm, folder, surface, case, *, length=1.0, pressure=1.0, targets=None):
    """Pressures and mean gaps of a job in units of length and pressure, over these units: one of each for a target."""
    folder = comm.bcast(folder)
    simulate(
        job_of(comm, folder, surface, case, length=length, pressure=pressure, targets=targets), comm, folder / "out"
    )
    comm.Barrier()
    results = pgfmd.Results(folder / "out")
    return [
        (results.field("pressure", load=index) / pressure, float(results.loads["mean_gap"][index]) / length)
        for index in range(len(results))
    ]


def alike(ones, others, moved=lambda field: field, room=1e-5):
    """Pressures, moved, and mean gaps agree."""
    for (one, gap), (other, moved_gap) in zip(ones, others, strict=True):
        assert np.linalg.norm(moved(one) - other) <= room * np.linalg.norm(other)
        assert moved_gap == pytest.approx(gap, rel=room, abs=room)


def room_of(case) -> float:
    """Pressures certified to 1e-12 agree to 1e-5.  Gaps are met to 1e-4, and pressures change up to ten times as much.
    Areas jump: loads between two jumps are all right."""
    return {"pressure": 1e-5, "contact_area": 0.1}.get(case[2], 1e-3)


@pytest.fixture(scope="module")
def plain(comm, tmp_path_factory):
    """plain(case): the contacts of a case as it stands, solved once."""
    folder, known = comm.bcast(tmp_path_factory.mktemp("plain")), {}

    def solved(case):
        if case not in known:
            known[case] = contacts(comm, folder / " ".join(case), heights(), case)
        return known[case]

    return solved


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("case", SOME, ids=" ".join)
def test_units(comm, shared_tmp_path, plain, case):
    """Lengths × 1e±100 (in turns), pressures ÷ that: the same contact."""
    unit = (1e-100, 1e100)[CASES.index(case) % 2]
    there = contacts(comm, shared_tmp_path / "there", heights(), case, length=unit, pressure=1 / unit)
    alike(plain(case), there, room=room_of(case))


MOVES = {
    "translation": lambda field: np.roll(field, (5, -3), (0, 1)),
    "rotation": np.rot90,
    "reflection": np.flipud,
    "tiling": lambda field: np.tile(field, (2, 1)),
}


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("case", SOME, ids=" ".join)
def test_moves(comm, shared_tmp_path, plain, case):
    """A surface shifted, turned, mirrored or repeated (in turns over solids and controls): so are its pressures."""
    wall, solid, control = place(case)
    moved = list(MOVES.values())[(wall + solid + control * (1 if case[0] == "hardness" else 2)) % 4]
    after = contacts(comm, shared_tmp_path / "after", np.ascontiguousarray(moved(heights())), case)
    alike(plain(case), after, moved, room_of(case))


ANY_ORDER = [case for case in CASES if case[1] in ("half-space", "free") and case[0] != "hardness"]


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("case", ANY_ORDER, ids=" ".join)
def test_order_of_loads(comm, shared_tmp_path, plain, case):
    """Loads in another order, from other starts: the same pressures.  (A wall that yields refuses falling loads.)"""
    back = contacts(comm, shared_tmp_path / "back", heights(), case, targets=TARGETS[case[2]][::-1])
    alike(plain(case), back[::-1], room=room_of(case))


@pytest.mark.parametrize("case", SOME, ids=" ".join)
def test_rank_count(comm, shared_tmp_path, plain, case):
    """All ranks together, and one alone: pressures agree as closely as they are certified."""
    if comm.size == 1:
        pytest.skip("needs several ranks")
    from mpi4py import MPI

    alone = contacts(MPI.COMM_SELF, shared_tmp_path / f"alone {comm.rank}", heights(), case)
    alike(plain(case), alone, room=room_of(case))


class StopsIn(Interruptions):
    """Interruptions by a signal after the first step of the load with that number, of those this run solves."""

    def __init__(self, comm, folder, number):
        super().__init__(comm, folder, math.inf, math.inf)
        self.loads_left = number

    def load_begins(self, resumed):
        self.loads_left -= 1
        super().load_begins(resumed)

    def between_steps(self, save=None):
        if self.loads_left == 0 and save is not None:
            self._signal = signal.SIGTERM
        super().between_steps(save)


def files(comm, folder) -> dict:
    """Every file below a folder, by its path, the same on all ranks."""
    comm.Barrier()
    return comm.bcast(contents(folder))


COSTS = ("iterations", "transforms", "seconds", "pressure_error", "certified_error", "max_violation")


@pytest.mark.mpi("breadth")
@pytest.mark.parametrize("case", SOME, ids=" ".join)
def test_restart(comm, shared_tmp_path, case):
    """A run of one load, stopped in it, continued with a load added, stopped in that, and continued again: the rows of
    a run that never stopped.  Other heights, and another value of any key but those of [run], are refused in between,
    and nothing is touched."""
    run, there, both = shared_tmp_path / "run", shared_tmp_path / "run" / "out", TARGETS[case[2]]
    for number, targets in ((1, both[:1]), (2, both)):
        job = job_of(comm, run, heights(), case, targets=targets)
        with pytest.raises(Stopped):
            simulate(job, comm, there, restart=True, interruptions=StopsIn(comm, there, number))
        before = files(comm, there)
        job_of(comm, run, 2 * heights(), case)
        with pytest.raises(InputError, match="content of .*heights.npy has changed since"):
            simulate(job, comm, there, restart=True)
        for units in ({"length": 2.0}, {"pressure": 2.0}):
            other = job_of(comm, run, heights(), case, targets=targets, **units)
            with pytest.raises(InputError, match="cannot be continued, the job differs"):
                simulate(other, comm, there, restart=True)
        assert files(comm, there) == before
    simulate(job_of(comm, run, heights(), case), comm, there, restart=True)
    once = contacts(comm, shared_tmp_path / "once", heights(), case)
    read, rows = pgfmd.Results(there), pgfmd.Results(shared_tmp_path / "once" / "out").loads
    found = [(read.field("pressure", load=index), float(read.loads["mean_gap"][index])) for index in (0, 1)]
    alike(once, found, room=room_of(case))
    assert read.status == "complete" and read.loads.keys() == rows.keys()
    for name in rows.keys() - set(COSTS):
        np.testing.assert_allclose(read.loads[name], rows[name], room_of(case), room_of(case), err_msg=name)

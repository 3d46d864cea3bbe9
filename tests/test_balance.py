"""A contact moved along x, so that slabs hold equally much of it."""

from contextlib import nullcontext

import numpy as np
import pytest
from conftest import saved as saved_to
from conftest import whole
from contacts import elastic, under_hard_wall

from pgfmd.application.job import parse, tables_as_toml
from pgfmd.application.loads import Checkpoints
from pgfmd.application.results import Results
from pgfmd.application.simulate import simulate
from pgfmd.application.stop import Interruptions
from pgfmd.errors import SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.physics.laws.hard import Hardness, HardWall
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set import balance
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.surfaces.self_affine import self_affine

pytestmark = pytest.mark.mpi


@pytest.fixture
def always(monkeypatch):
    """Contacts of few points are moved too, however little that gains."""
    monkeypatch.setattr(balance, "LEAST_POINTS", 1)
    monkeypatch.setattr(balance, "LEAST_GAIN", 0.0)


def hill(grid):
    """A rough hill on the first quarter of the rows of a cell of 64 × 48 points."""
    x = np.arange(64)[grid.rows, None] / 64
    return np.exp(-(((x - 0.12) / 0.1) ** 2)) + self_affine(grid, 0.8, 8.0, 0.05, 1)


def test_rows_move_as_those_of_one_array(comm):
    """In place, by any number of rows that a slab has, up and down, also on uneven slabs."""
    field = np.random.default_rng(1).random((29, 5))
    grid = SlabGrid(comm, field.shape)
    for rows in range(1, 29 // comm.size + 1):
        for shift in (rows, -rows):
            own = field[grid.rows].copy(), field[grid.rows].astype(np.float32)
            balance.move_rows(grid, own, shift)
            for part in own:
                assert np.array_equal(part, np.roll(field, -shift, axis=0)[grid.rows].astype(part.dtype))


def test_the_fullest_slab_is_as_empty_as_can_be(comm):
    """Of all shifts of random counts by up to half a slab, by brute force; none if that gains little."""
    counts = np.random.default_rng(2).integers(0, 1000, 30) * (np.arange(30) < 11)
    grid = SlabGrid(comm, (30, 1000))
    found = balance.best_shift(grid, counts[grid.rows])

    def fullest(shift):
        moved = np.roll(counts, -shift)
        return max(moved[a:b].sum() for a, b in zip(grid.starts[:-1], grid.starts[1:], strict=True))

    half = 30 // comm.size // 2
    assert fullest(found) == min(fullest(shift) for shift in range(-half, half + 1))
    assert balance.best_shift(grid, np.full(len(counts[grid.rows]), 500)) == 0


@pytest.mark.parametrize("law", [HardWall(), Hardness(hardness=0.3)], ids=["hard", "hardness"])
@pytest.mark.parametrize("load", [0.005, 0.02])
def test_the_contact_is_the_same(comm, always, monkeypatch, law, load):
    """Moved or not, the pressure is the same, and the heights are as they were; on several ranks it is moved."""
    grid, found, moved = SlabGrid(comm, (64, 48)), [], []
    heights = hill(grid)
    before = heights.copy()
    for least in (1 << 40, 1):
        monkeypatch.setattr(balance, "LEAST_POINTS", least)
        problem = ContactProblem(grid, heights, elastic(1.0), law, load)
        found.append(solve_hard_wall(problem, 1e-20, monitor=lambda _, state: moved.append(state.shift)).pressure)
        assert np.array_equal(heights, before)
    assert any(moved) == (comm.size > 1)
    np.testing.assert_allclose(found[1], found[0], atol=1e-8 * grid.reduction.max(found[0]))


def test_heights_come_back_after_an_error(comm, always):
    """A tolerance that rounding forbids is refused, and the heights are as they were."""
    grid = SlabGrid(comm, (64, 48))
    heights = hill(grid)
    before = heights.copy()
    with pytest.raises(SolverError):
        solve_hard_wall(under_hard_wall(grid, heights, 0.01), 1e-40)
    assert np.array_equal(heights, before)


@pytest.mark.parametrize("how", ["read only", "an error of its own"])
def test_heights_of_the_caller(comm, always, how):
    """Read-only heights are not shifted; after one rank's error in a monitor, shifted ones are NaN, not others."""
    grid, shifts = SlabGrid(comm, (64, 48)), []
    heights = hill(grid)
    for _ in range(2):  # of mean 0: the solver works on this array
        heights -= grid.reduction.sum(heights) / grid.size
    heights.flags.writeable = how != "read only"
    before = heights.copy()

    def monitor(level, state):
        shifts.append(state.shift)
        if how != "read only" and level is grid:
            raise ZeroDivisionError

    problem = under_hard_wall(grid, heights, 0.01)
    with nullcontext() if how == "read only" else pytest.raises(ZeroDivisionError):
        solve_hard_wall(problem, 1e-8, monitor=monitor)
    if how == "read only" or not shifts[-1]:
        assert np.array_equal(heights, before)
        assert shifts[-1] == 0
    else:
        assert np.isnan(heights).all()


def test_a_checkpoint_holds_the_pressure_in_its_place(comm, always, monkeypatch, shared_tmp_path):
    """A run that saves after each step saves, to a half, the pressure that it writes, each row in its place."""
    saved, shifts = [], []

    def save(self, index, pressure):
        saved.append(pressure)

    def moved(grid, fields, rows):
        shifts.append(rows)
        move_rows(grid, fields, rows)

    move_rows = balance.move_rows
    for owner, name, value in (
        (balance, "move_rows", moved),
        (Interruptions, "between_steps", lambda self, save=None: save and save()),
        (Checkpoints, "save", save),
    ):
        monkeypatch.setattr(owner, name, value)
    grid = SlabGrid(comm, (64, 48))
    heights = whole(grid, hill(grid))
    path = saved_to(comm, shared_tmp_path / "hill.npy", lambda path: np.save(path, heights))
    job = tables_as_toml({
        "grid": {"n": [64, 48]}, "surface": {"kind": "file", "path": str(path)}, "solid": {"contact_modulus": 1.0},
        "load": {"pressure": [0.01]}, "output": {"fields": ["pressure"]},
    })  # fmt: skip
    simulate(parse(job), comm, shared_tmp_path / "out")
    found = [whole(grid, pressure) for pressure in saved]
    assert bool(shifts) == (comm.size > 1) and len(saved) > 2
    if comm.rank == 0:
        written = Results(shared_tmp_path / "out").field("pressure", 0)
        assert all(np.linalg.norm(each - written) < 0.5 * np.linalg.norm(written) for each in found)

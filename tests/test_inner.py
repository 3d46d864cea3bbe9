"""The parts of the inner solver: sets with their halo, windows of rows, the mesh compliance and the preconditioner."""

import numpy as np
import pytest
from contacts import elastic, under_hard_wall
from mpi4py import MPI

from pgfmd.grid import grid_cost
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel import alone, layout
from pgfmd.parallel.layout import Exchange, Layout, RowPlan, RowWindow, hops
from pgfmd.physics.laws.hard import Hardness
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set import continuation, preconditioner
from pgfmd.solvers.active_set.contact_from_coarse import solve_hard_wall
from pgfmd.solvers.active_set.dual import GapSteps, near_compliance
from pgfmd.solvers.active_set.feasible import Feasible
from pgfmd.solvers.active_set.particle_mesh import FullResponse, MeshResponse, inner_response
from pgfmd.solvers.active_set.preconditioner import MultilevelStiffness
from pgfmd.solvers.active_set.primal import PressureSteps
from pgfmd.solvers.active_set.unknowns import HALO, SetVector, Unknowns

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]
comm = MPI.COMM_WORLD


def random_set(grid: SlabGrid, density: float):
    """A set, the same on any number of ranks, its mask on the whole grid, and values on it that sum to zero."""
    rng = np.random.default_rng(3)
    mask = rng.random(grid.shape) < density
    field = np.where(mask, rng.standard_normal(grid.shape), 0).astype(np.float32)
    field -= np.where(mask, field[mask].mean(), 0).astype(np.float32)
    points = Unknowns(grid, (mask[grid.rows].astype(float), np.ones(grid.local_shape)), -np.inf)
    return points, mask, field


def on(points: Unknowns, values: np.ndarray | None = None) -> SetVector:
    """A vector on the set, with those values."""
    vector = SetVector(points)
    if values is not None:
        vector.own[:] = values
    return vector


def everywhere(grid: SlabGrid, points: Unknowns, values: np.ndarray) -> np.ndarray:
    """Values on the set as a field on the whole grid, on every rank."""
    field = np.zeros(grid.local_shape)
    points.add(field, values.astype(float))
    return np.concatenate(comm.allgather(field))


@pytest.mark.parametrize("shape", [(64, 16), (9, 5), (6, 300)])
def test_unknowns(shape):
    """Points between the bounds, or at one of them with a gap that drives away from it.  Fields are read and changed
    there and nowhere else, exactly; level − field stays within 1e25; a transform and back gives values to 2⁻²⁴ · 10."""
    grid, rng = SlabGrid(comm, shape), np.random.default_rng(7)
    p = rng.choice([-0.5, 0.0, 0.3, 0.6, 1.0, 1.4], shape)[grid.rows]
    gap = rng.choice([-0.4, 0.0, 0.2, 0.5], shape)[grid.rows]
    p[:, 70:240], gap[:, 70:240] = 0.0, 0.2  # a long piece without unknowns
    mask = (p > 0) & (p < 1) | (p <= 0) & (gap < 0.1) | (p >= 1) & (gap > 0.1)
    points = Unknowns(grid, (p, gap), 0.1, 1.0)
    assert np.array_equal(points.lists[0], np.nonzero(mask)[1])
    assert np.array_equal(np.diff(points.lists[1]), mask.sum(axis=1)) and points.count == mask.sum()
    assert np.array_equal(points.below(0.1, gap).own, (0.1 - gap[mask]).astype(np.float32))
    assert set(points.below(0.1, gap * 1e30).own) <= {np.float32(0.1), np.float32(1e25), np.float32(-1e25)}
    values, field = rng.random(points.count).astype(np.float32), p.copy()
    points.add(field, values)
    assert np.array_equal(field[mask], p[mask] + values) and np.array_equal(field[~mask], p[~mask])

    def unchanged(block, first, stop):
        block *= np.float32(1 / grid.size)

    out = np.empty_like(values)
    FullResponse(unchanged).apply(on(points, values), out)
    assert np.allclose(out, values, rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", [(64, 16), (61, 7), (9, 5), (4, 3)])
def test_halo_of_a_set(shape):
    """The rows before and after a slab, around the ring, also where slabs are thinner than the halo."""
    grid = SlabGrid(comm, shape)
    points, mask, field = random_set(grid, 0.4)
    rows = np.arange(grid.rows.start - HALO, grid.rows.stop + HALO) % shape[0]
    columns, offsets = points.extended
    assert np.array_equal(np.diff(offsets), mask[rows].sum(axis=1))
    assert np.array_equal(columns, np.nonzero(mask[rows])[1])
    vector = on(points, field[grid.rows][mask[grid.rows]])
    vector.exchange()
    assert np.array_equal(vector.all, field[rows][mask[rows]])


@pytest.mark.parametrize("count", [1, (comm.size + 1) // 2, comm.size])
@pytest.mark.parametrize("beyond", [(0, 0), (-3, 2), (-40, 35)])
def test_window_of_rows(beyond, count):
    """Rows beyond the own ones, from any ranks and periods, each time anew; and back, added up, to their holders."""
    held, rank = Layout.spread(comm, 23, count), comm.rank
    rows = held.rows
    window = RowWindow(held, (23 * rank // comm.size + beyond[0], 23 * (rank + 1) // comm.size + beyond[1]), 4)
    numbers = np.arange(window.low, window.low + len(window.rows)) % 23
    for shift in (0, 1000):
        window.own[...] = shift + 10 * np.arange(rows.start, rows.stop)[:, None] + np.arange(4)
        window.fetch()
        assert np.array_equal(window.rows, shift + 10 * numbers[:, None] + np.arange(4))
    window.rows[...] = 1
    window.add()
    expected = np.bincount(np.concatenate(comm.allgather(numbers)), minlength=23)
    assert np.array_equal(window.own, np.repeat(expected[rows, None], 4, axis=1))


@pytest.mark.parametrize("radix", [2, layout.RADIX])
@pytest.mark.parametrize("count", [1, (comm.size + 1) // 2])
def test_rows_relayed_are_those_sent(monkeypatch, radix, count):
    """To few ranks and back, through ranks between if there are over `radix` times as many ranks as holders."""
    monkeypatch.setattr(layout, "RADIX", radix)
    all_ranks, few = SlabGrid(comm, (23, 6)).layout, Layout.spread(comm, 23, count)
    whole = np.random.default_rng(1).random((23, 6))
    for source, target in ((all_ranks, few), (few, all_ranks)):
        plans, exchange = hops(source, target), Exchange(comm)
        assert (len(plans) > 1) == (comm.size > radix * count)
        found = np.empty_like(whole[target.rows])
        exchange.relay(plans, whole[source.rows].copy(), found)
        exchange.carry_out()
        assert np.array_equal(found, whole[target.rows])


class Planned(alone.Comm):
    """A rank of many, of which only what it receives is planned."""

    def __init__(self, size: int, rank: int) -> None:
        self.size, self.rank = size, rank

    def Allgather(self, send, receive) -> None:
        """The others ask for nothing."""
        receive[...] = 0


# Three for each factor of 4: 64 → 16 → 4 → 1.
@pytest.mark.parametrize(("ranks", "most"), [(4, 3), (16, 6), (32, 7), (64, 9), (256, 12)])
def test_no_rank_meets_all_others(ranks, most):
    """Rows to one rank and back are few messages for any rank, 9 on 64 ranks, and less than 3 in the mean."""
    for back in (False, True):
        messages = np.zeros(ranks, int)
        for rank in range(ranks):
            held = [Layout.spread(Planned(ranks, rank), 256, count) for count in (ranks, 1)]
            for plan in hops(*(reversed(held) if back else held)):
                partners = {owner for owner, *_ in plan.receives}
                messages[rank] += len(partners)
                messages[list(partners)] += 1
        assert messages.max() == most and messages.mean() < 3


@pytest.mark.parametrize("joined", [layout.JOINED, 0])
def test_rows_travel_together(monkeypatch, joined):
    """What several plans bring and take back in one exchange is what each does alone, with at most one message to each
    partner and one from each; parts too large to be copied go by themselves."""
    monkeypatch.setattr(layout, "JOINED", joined)
    grid = SlabGrid(comm, (23, 6))
    first, stop = grid.rows.start, grid.rows.stop
    whole = np.arange(23.0)[:, None] * np.ones(6)
    few = Layout.spread(comm, 23, (comm.size + 1) // 2)
    plans = [RowPlan(grid.layout, [(first - 2, first), (stop, stop + 3)]), RowPlan(few, [(first, stop)])]
    targets = [np.empty((5, 6)), np.empty((stop - first, 6), np.float32)]
    exchange = Exchange(comm)
    exchange.fetch(plans[0], whole[first:stop], targets[0])
    exchange.fetch(plans[1], whole[few.rows].astype(np.float32), targets[1])
    back = np.ones((stop - first, 6), np.int64)
    pieces = exchange.give(plans[1], back)
    exchange.carry_out()
    assert np.array_equal(targets[0][:, 0], np.r_[first - 2 : first, stop : stop + 3] % 23)
    assert np.array_equal(targets[1], whole[first:stop])
    found = np.zeros(few.rows.stop - few.rows.start)
    for at, rows in pieces:
        found[at : at + len(rows)] += rows[:, 0]
    assert (found == 1).all()
    if joined:
        assert len(exchange.requests) <= 2 * (comm.size - 1)


@pytest.mark.parametrize(("shape", "sides", "most"), [
    ((64, 64), (1, 1), 0.009), ((96, 80), (1, 1), 0.009), ((61, 67), (1, 1), 0.009), ((50, 128), (1, 1), 0.009),
    ((32, 96), (1, 1), 0.009), ((64, 80), (2, 1), 0.011), ((96, 34), (1, 4), 0.012), ((33, 100), (8, 1), 0.014),
])  # fmt: skip
@pytest.mark.parametrize("density", [0.05, 0.5, 1.0])
def test_mesh_compliance(shape, sides, most, density):
    """Within .9 per cent of the response by full transforms, on any number of ranks; on oblong pixels within 1.4."""
    lengths = shape[0] * sides[0], shape[1] * sides[1]
    grid, elasticity = SlabGrid(comm, shape, lengths), elastic(1.3)
    mesh = MeshResponse(grid, lambda q: 2 / (1.3 * q), elasticity.compliance)
    off, exact = deviation(grid, density, mesh, elasticity.apply_compliance(grid, np.float32, 1 / grid.size))
    assert np.linalg.norm(off - off.mean()) < most * np.linalg.norm(exact - exact.mean())


@pytest.mark.parametrize("shape", [(64, 64), (96, 80), (61, 67), (50, 128)])
@pytest.mark.parametrize("side", [1, 2, 5])
@pytest.mark.parametrize("density", [0.05, 0.5, 1.0])
def test_mesh_stiffness(shape, side, density):
    """Within 2.5 per cent of the response by full transforms, on any number of ranks and pixels of any `side`."""
    grid, elasticity = SlabGrid(comm, shape, (shape[0], side * shape[1])), elastic(1.3)
    mesh = MeshResponse(grid, elasticity.stiffness, elasticity.stiffness)
    off, exact = deviation(grid, density, mesh, elasticity.apply_stiffness(grid, np.float32, 1 / grid.size))
    assert np.linalg.norm(off) < 0.025 * np.linalg.norm(exact)


@pytest.mark.parametrize("wave", [(1, 0), (2, 3), (5, 5)])
def test_mesh_is_exact_for_long_waves(wave):
    """To two per cent of the response itself, compliance and stiffness: what they get wrong there never converges."""
    grid, elasticity = SlabGrid(comm, (128, 128)), elastic(1.3)
    everything = Unknowns(grid, (np.ones(grid.local_shape), np.ones(grid.local_shape)), -np.inf)
    at = 2 * np.pi / 128 * (wave[0] * np.arange(128)[grid.rows, None] + wave[1] * np.arange(128))
    values, found = np.cos(at).ravel().astype(np.float32), np.empty(at.size, np.float32)
    q = 2 * np.pi / 128 * np.hypot(*wave)
    for response in (elasticity.stiffness, elasticity.compliance):
        near = elasticity.stiffness if response == elasticity.stiffness else lambda q: 2 / (1.3 * q)
        MeshResponse(grid, near, response).apply(on(everything, values), found)
        assert np.allclose(found, response(q) * values, rtol=0, atol=0.02 * response(q))


def deviation(grid: SlabGrid, density: float, mesh: MeshResponse, action) -> tuple[np.ndarray, np.ndarray]:
    """By how much the mesh's response is off on a random set, and the exact one, on every rank."""
    points, mask, field = random_set(grid, density)
    values = field[grid.rows][mask[grid.rows]]
    exact, found = np.empty_like(values), np.empty_like(values)
    mesh.apply(on(points, values), found)
    FullResponse(action).apply(on(points, values), exact)
    exact, found = (everywhere(grid, points, part)[mask] for part in (exact, found))
    return found - exact, exact


def test_mesh_is_where_it_serves():
    """Not on grids of a few points, of very oblong pixels, or for solids as thin as the mesh is wide; on strips too."""
    grid = SlabGrid(comm, (256, 256))

    def serves(grid, thickness=np.inf):
        solid = elastic(1.0, thickness)
        action = solid.apply_compliance(grid, np.float32, 1 / grid.size)
        found = inner_response(grid, lambda q: 2 / q, solid.compliance, action)
        found.free()
        return isinstance(found, MeshResponse)

    assert serves(grid)
    assert serves(grid, 20.0)
    assert not serves(grid, 2.0)
    assert not serves(SlabGrid(comm, (64, 64)))
    assert serves(SlabGrid(comm, (2048, 32))) and not serves(SlabGrid(comm, (8192, 16)))
    assert serves(SlabGrid(comm, (256, 256), (64, 256))) and not serves(SlabGrid(comm, (256, 256), (16, 256)))


@pytest.mark.parametrize("lengths", [(64, 64), (64, 16), (8, 64)])
def test_near_compliance_is_positive(lengths):
    """⟨a, M a⟩ > 0 for waves of every length, also on oblong pixels."""
    grid = SlabGrid(comm, (64, 64), lengths)
    everything = Unknowns(grid, (np.ones(grid.local_shape), np.ones(grid.local_shape)), -np.inf)
    near = near_compliance(grid, lambda q: 2 / q)
    for wave in ((1, 0), (0, 1), (32, 0), (0, 32), (32, 32), (16, 32), (16, 0), (0, 16), (32, 11), (11, 32)):
        phase = 2 * np.pi / 64 * (wave[0] * np.arange(64)[grid.rows, None] + wave[1] * np.arange(64))
        values, out = on(everything, np.cos(phase).ravel()), np.empty(everything.count, np.float32)
        near.apply(values, out)
        assert comm.allreduce(float(values.own @ out)) > 0


@pytest.mark.parametrize("shape", [(512, 384), (387, 386), (20, 20)])
@pytest.mark.parametrize("fewest", [64, 8])
@pytest.mark.parametrize("small", [grid_cost.SMALL, 0])
def test_preconditioner_is_symmetric_and_positive(monkeypatch, shape, fewest, small):
    """⟨a, M b⟩ = ⟨M a, b⟩ and ⟨a, M a⟩ > 0; and the same on any number of ranks, for any number of levels."""
    monkeypatch.setattr(preconditioner, "FEWEST", fewest)
    monkeypatch.setattr(grid_cost, "SMALL", small)
    grid, one = SlabGrid(comm, shape), SlabGrid(MPI.COMM_SELF, shape)
    kernels = (lambda q: q / 2,) * 2

    def applied(grid, field):
        points, mask, _ = random_set(grid, 0.4)
        out = np.empty(points.count, np.float32)
        MultilevelStiffness(grid, *kernels).apply(on(points, field[grid.rows][mask[grid.rows]]), out)
        return points, out

    a, b = np.random.default_rng(1).standard_normal((2, *shape))
    images = []
    for field in (a, b):
        points, found = applied(grid, field)
        whole = everywhere(grid, points, found)
        alone = np.zeros(shape)
        points, found = applied(one, field)
        points.add(alone, found.astype(float))
        assert np.abs(whole - alone).max() < 1e-5 * np.abs(alone).max()
        images.append(whole)
    mask = random_set(one, 0.4)[1]
    assert abs(np.vdot(a * mask, images[1]) - np.vdot(b * mask, images[0])) < 1e-4 * np.vdot(a * mask, images[0])
    assert np.vdot(a * mask, images[0]) > 0


@pytest.mark.parametrize("shape", [(64, 300), (37, 41), (600, 20), (5, 3)])
def test_means_over_blocks_of_the_residual(shape):
    """Blocks of 16, 64 and 256 pixels by definition, also beside a slab, for any number of ranks."""
    grid, rng = SlabGrid(comm, shape), np.random.default_rng(4)
    p = rng.choice([0.0, 0.5, 1.0], shape, p=[0.9, 0.08, 0.02])
    p[:, 64:200] = 0
    gap = rng.standard_normal(shape)
    values, start = continuation.BlockMeans(grid).of((p[grid.rows], gap[grid.rows]), (0.3, 1.0, np.inf))
    expected = np.zeros(shape)
    for side in (256, 64, 16):
        for i, j in np.ndindex(-(-shape[0] // side), -(-shape[1] // side)):
            part = slice(i * side, (i + 1) * side), slice(j * side, (j + 1) * side)
            own = (gap[part] - 0.3)[p[part] == 0.5]
            if own.size:
                weight = min(continuation.TRUST * np.sqrt(own.size) / side, 1)
                expected[part] += weight * (own.mean() - expected[part])
    low, high = -continuation.BESIDE, grid.local_shape[0] + continuation.BESIDE
    rows = np.arange(max(low, -grid.rows.start), min(high, shape[0] - grid.rows.start))
    found = np.repeat(values, 16, axis=1)[(start + rows) // 16, : shape[1]]
    assert np.allclose(found, expected[grid.rows.start + rows], rtol=0, atol=1e-6)
    assert len(values) * 16 >= start + high


@pytest.mark.parametrize("shape", [(128, 96), (67, 41), (5, 40)])
def test_tensions_are_cut_where_they_are(shape):
    """No tension is left; blocks of 32 × 32 pixels keep their load but for one factor; the whole is as asked."""
    grid = SlabGrid(comm, shape)
    points, mask, _ = random_set(grid, 0.4)
    old = np.where(mask, np.random.default_rng(4).standard_normal(shape) + 0.8, 0)
    pressure = old[grid.rows].copy()
    load = 1.1 * old.sum()
    problem = under_hard_wall(grid, np.zeros_like(pressure), load / grid.size)
    Feasible(grid).make(problem, points, (pressure, np.zeros_like(pressure)))
    new = np.concatenate(comm.allgather(pressure))
    assert new.min() == 0 and new.sum() == pytest.approx(load, rel=1e-12, abs=0)
    before, after = (
        np.add.reduceat(np.add.reduceat(a, range(0, shape[0], 32), 0), range(0, shape[1], 32), 1) for a in (old, new)
    )
    factor = load / np.maximum(before, 0).sum()
    assert np.allclose(after, factor * np.maximum(before, 0), rtol=1e-12, atol=0)


@pytest.mark.parametrize("load", [0.02, 0.3, 0.6, 0.99, 1.0])
def test_pressures_between_two_bounds_carry_the_load(load):
    """Cut at 0 and at the top, whatever is missing or too much is shared out without leaving the bounds."""
    grid = SlabGrid(comm, (67, 41))
    points, mask, _ = random_set(grid, 0.4)
    old = np.where(mask, np.random.default_rng(4).standard_normal(grid.shape) + 0.8, 0)
    pressure, gap = old[grid.rows].copy(), np.random.default_rng(5).standard_normal(grid.shape)[grid.rows].copy()
    problem = ContactProblem(grid, np.zeros_like(pressure), elastic(2.0), Hardness(hardness=1.0), load)
    Feasible(grid).make(problem, points, (pressure, gap))
    new = np.concatenate(comm.allgather(pressure))
    assert new.min() >= 0 and new.max() <= 1 + 1e-14
    assert new.sum() == pytest.approx(load * grid.size, rel=1e-12, abs=0)


def test_preconditioner_answers_long_waves_weakly(monkeypatch):
    """On a sparse set, the load that a wave asks for falls with its wave number, as the stiffness does; blocks of one
    size alone answer the longest as strongly as one eight times shorter."""
    grid = SlabGrid(comm, (512, 512))
    clumps = np.random.default_rng(4).random((128, 128)) < 0.3
    mask = np.repeat(np.repeat(clumps, 4, axis=0), 4, axis=1)[grid.rows]
    points = Unknowns(grid, (mask.astype(float), np.ones(grid.local_shape)), -np.inf)

    def answer(wave: int) -> float:
        phase = 2 * np.pi / 512 * wave * np.arange(512)[grid.rows, None] + np.zeros(512)
        values, out = on(points, np.cos(phase)[mask]), np.empty(points.count, np.float32)
        MultilevelStiffness(grid, lambda q: q / 2, lambda q: q / 2).apply(values, out)
        return comm.allreduce(float(values.own @ out))

    monkeypatch.setattr(preconditioner, "FEWEST", 8)
    assert 4 < answer(8) / answer(1) < 16
    monkeypatch.setattr(preconditioner, "FEWEST", 64)
    assert answer(8) / answer(1) < 2


@pytest.mark.parametrize("n", [256, 640])
def test_a_mountain_in_one_slab(n):
    """All contact in one slab: the pressure of one rank, also from a start; the monitor sees it where it belongs."""
    seen = []
    x, y = (np.arange(n) / n - 0.16)[:, None], (np.arange(n) / n - 0.5)[None, :]
    heights = -72.8 * n / 256 * (x**2 + y**2)
    grid, one = SlabGrid(comm, (n, n)), SlabGrid(MPI.COMM_SELF, (n, n))

    def monitor(level, state):
        if level is grid:
            seen.append(np.concatenate(comm.allgather(state.pressure)))

    mine = solve_hard_wall(under_hard_wall(grid, heights[grid.rows], 1e-3), 1e-9, monitor=monitor)
    alone = solve_hard_wall(under_hard_wall(one, heights, 1e-3), 1e-9)
    found = np.concatenate(comm.allgather(mine.pressure))
    assert np.abs(found - alone.pressure).max() < 1e-3 * alone.pressure.max()
    assert np.array_equal(seen[-1] > 0, found > 0)
    again = solve_hard_wall(under_hard_wall(grid, heights[grid.rows], 1e-3), 1e-9, start=mine.pressure)
    again = np.concatenate(comm.allgather(again.pressure))
    assert np.abs(again - alone.pressure).max() < 1e-3 * alone.pressure.max()


@pytest.mark.parametrize(("error", "goal"), [(np.inf, 6e-2), (0.8, 6e-2), (4e-3, 2e-4), (1e-14, 1e-8), (0.0, 1e-8)])
def test_coarse_grids_aim_at_a_part_of_their_first_error(error, goal):
    """Grids aim at a twentieth of their first error, at three times that from a rough start, at a tenth of it with gaps
    as unknowns, within limits; a start without error has an aim too."""
    assert PressureSteps.goal(error, 1e-12) == pytest.approx(goal)
    assert PressureSteps.goal(error, 1e-3) == pytest.approx(max(goal, 2.5e-4))
    assert GapSteps.goal(error, 1e-12) == pytest.approx(max(goal / 10, 1e-8))

"""Percolation of contact and gap around the periodic cell; the critical constriction against brute force."""

import numpy as np
import pytest
from contacts import elastic
from job_texts import rough_job
from test_patches import flood_fill

import pgfmd
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables import percolation
from pgfmd.observables.patch_table import label_patches
from pgfmd.observables.percolation import bottlenecks, percolates
from pgfmd.surfaces.self_affine import self_affine

pytestmark = pytest.mark.mpi


def flood(mask, connectivity):
    """Whether the set points wind along x and along y."""
    table = flood_fill(mask, 1.0 * mask, connectivity)[1]
    return tuple(bool(table[f"percolates_{axis}"].any()) for axis in "xy")


def widest(gap, mask):
    """The largest g with which {gap ≥ g} percolates along x, and along y, by trial of all values; 0 if none does."""
    found = [0.0, 0.0]
    for g in np.unique(gap[mask]):
        for axis, winds in enumerate(flood(mask & (gap >= g), 4)):
            found[axis] = float(g) if winds else found[axis]
    return tuple(found)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_masks_against_a_flood_fill(comm, connectivity):
    """Random masks of any density, oblong cells, spirals: as a serial flood fill with windings says."""
    rng = np.random.default_rng(12)
    for _ in range(60 if comm.size == 1 else 20):
        mask = rng.random(rng.integers(4, 12, 2)) < rng.uniform(0.2, 0.9)
        grid = SlabGrid(comm, mask.shape)
        found = percolates(label_patches(comm, mask[grid.rows].copy(), grid.starts, connectivity))
        assert found == flood(mask, connectivity)


def test_spiral(comm):
    """A line of slope 1/3 closes after three turns: it winds along both axes; one step short of that, along none."""
    line = np.zeros((12, 12), bool)
    for i in range(36):
        line[i % 12, (i // 3) % 12] = line[i % 12, (i // 3 + ((i + 1) % 3 == 0)) % 12] = True
    grid = SlabGrid(comm, line.shape)
    for cut in (False, True):
        line[5, :] &= not cut
        assert percolates(label_patches(comm, line[grid.rows].copy(), grid.starts, 4)) == 2 * (not cut,)


@pytest.mark.parametrize("gathered", [0, 20, 10**5])
def test_constriction_against_brute_force(comm, monkeypatch, gathered):
    """It is the largest g at which {gap ≥ g} percolates, and the gap at its place, wherever rank 0 takes over."""
    monkeypatch.setattr(percolation, "GATHERED", gathered)
    rng = np.random.default_rng(4)
    for _ in range(60 if comm.size == 1 else 20):
        shape = rng.integers(4, 13, 2)
        gap = np.round(rng.random(shape), 1 + rng.integers(3)) + 0.01  # with and without equal values
        mask = rng.random(shape) < rng.uniform(0.5, 0.9)
        grid = SlabGrid(comm, gap.shape)
        found = bottlenecks(grid, gap[grid.rows].copy(), mask[grid.rows].copy())
        assert tuple(each.value for each in found) == widest(gap, mask)
        assert all(gap[each.point] == each.value for each in found if each.value)


def test_stripes(comm):
    """A wave pressed flat along y: the gap's channels run along y and not along x; across waves it is the reverse."""
    grid = SlabGrid(comm, (32, 16))
    wave = np.cos(2 * np.pi * np.arange(32) / 32)[:, None] * np.ones(16)
    contact = pgfmd.solve(wave[grid.rows], 0.02, comm=comm, solid=elastic(1.0))
    found = contact.observables("percolation")["loads"]
    assert [found[f"{part}_percolates_{axis}"] for part in ("contact", "gap") for axis in "xy"] == [0, 1, 0, 1]
    largest = grid.reduction.max(contact.gap)
    assert found["constriction_y"] == largest and found["constriction_x"] == 0


def scene(comm, seed: int, n: int = 64):
    grid = SlabGrid(comm, (n, n))
    return self_affine(grid, 0.8, 8.0, 0.1, seed)


def test_a_wave_closes_at_full_contact(comm):
    """On a wave that varies along x, paths along y end where its trough is met: p̄ = π E' A/λ (Westergaard 1939)."""
    grid = SlabGrid(comm, (32, 16))
    heights = 0.7 * np.cos(2 * np.pi * np.arange(32)[grid.rows, None] / 32) * np.ones(16)
    found = pgfmd.solve(heights, percolation="gap", percolation_accuracy=1e-3, contact_modulus=2.0, comm=comm)
    lower, upper = (found.details[f"closing_pressure_{end}"] for end in ("lower", "upper"))
    assert lower <= np.pi * 2.0 * 0.7 / 32 * (1 + 1e-9) and np.pi * 2.0 * 0.7 / 32 <= upper * (1 + 1e-9)
    assert 0 < upper / lower - 1 <= 1.01e-3 and found.mean_pressure == pytest.approx(lower, rel=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_gap_closes_between_the_two_loads(comm, seed):
    """Contacts solved anew at 1 ± 2 accuracies of that load: a path winds around the cell below, none above."""
    heights = scene(comm, seed)
    found = pgfmd.solve(heights, percolation="gap", percolation_accuracy=1e-3, comm=comm)
    whole = np.concatenate(comm.allgather(found.pressure))
    assert any(flood(whole == 0, 4))
    for factor, winds in ((0.998, True), (1.002, False)):
        other = pgfmd.solve(heights, factor * found.mean_pressure, tolerance=1e-11, comm=comm)
        whole = np.concatenate(comm.allgather(other.pressure))
        assert any(flood(whole == 0, 4)) == winds


@pytest.mark.parametrize(
    ("keywords", "words"),
    [({"boundary": "open"}, "needs a period"), ({"percolation": "contact"}, 'must be one of "gap"'),
     ({"zeta": 0.1}, "touches everywhere"), ({"percolation_accuracy": 0.0}, "must be a number > 0 and < 1"),
     ({"pressure": 0.1}, "give exactly one of")],
)  # fmt: skip
def test_what_has_no_closing_load_is_refused(comm, keywords, words):
    """One line says what is allowed."""
    with pytest.raises(InputError, match=words):
        pgfmd.solve(scene(comm, 1), comm=comm, **({"percolation": "gap"} | keywords))


def test_flat_heights_do_not_close_a_gap(comm):
    """There is no gap at any load: refused, as for an area."""
    with pytest.raises(InputError):
        pgfmd.solve(np.zeros((16, 16))[SlabGrid(comm, (16, 16)).rows], percolation="gap", comm=comm)


def test_a_run_writes_both_loads(comm, tmp_path):
    """In the table, with the constrictions if these are asked for; a restart finds it complete."""
    if comm.size > 1:
        pytest.skip("once is enough")
    job = tmp_path / "job.toml"
    job.write_text(rough_job(48, load={"percolation": "gap"}, output={"observables": ["percolation"]}))
    results = pgfmd.run(job, tmp_path / "out")
    numbers = {name: values[0] for name, values in results.loads.items()}
    assert numbers["closing_pressure_lower"] == numbers["mean_pressure"] < numbers["closing_pressure_upper"]
    assert max(numbers["constriction_x"], numbers["constriction_y"]) > 0
    assert len(pgfmd.run(job, tmp_path / "out", restart=True)) == 1

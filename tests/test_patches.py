"""The patch labeller and the patch table against a flood fill that unrolls the torus, and against SciPy."""

import os
import subprocess
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage, sparse

from pgfmd.errors import InputError
from pgfmd.observables.patch_table import label_patches, patch_table
from pgfmd.observables.run_length import find_fragments, find_runs
from pgfmd.parallel.collectives import slab_starts

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]

SPACING = (0.75, 1.25)  # unequal, and exact in binary: areas and extents come out without rounding
EXACT = ("area", "perimeter", "extent_x", "extent_y", "peak_pressure", "percolates_x", "percolates_y")


def flood_fill(mask: np.ndarray, pressure: np.ndarray, connectivity: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Labels and table by walking from pixel to pixel on the unrolled plane, patch after patch in row-major order."""
    nx, ny = mask.shape
    sides = [(1, 0), (-1, 0), (0, 1), (0, -1)]
    steps = sides if connectivity == 4 else [*sides, (1, 1), (1, -1), (-1, 1), (-1, -1)]
    contact = mask.tolist()
    place: dict[tuple[int, int], tuple[int, int]] = {}  # pixel of the cell → where the walk found it on the plane
    labels = np.zeros(mask.shape, int)
    rows = []
    for first in zip(*np.nonzero(mask), strict=True):
        if labels[first]:
            continue
        label = len(rows) + 1
        place[first] = first
        labels[first] = label
        patch, edges, winds = [first], 0.0, [False, False]
        for at in patch:  # grows while it is walked
            x, y = place[at]
            for dx, dy in steps:
                target, pixel = (x + dx, y + dy), ((x + dx) % nx, (y + dy) % ny)
                if not contact[pixel[0]][pixel[1]]:
                    edges += (dx * dy == 0) * SPACING[1 if dx else 0]
                elif pixel not in place:
                    place[pixel] = target
                    labels[pixel] = label
                    patch.append(pixel)
                else:
                    winds = [w or here != there for w, here, there in zip(winds, target, place[pixel], strict=True)]
        inside = tuple(np.array(patch).T)
        rows.append((len(patch) * SPACING[0] * SPACING[1], edges, *(
            SPACING[axis] * shortest_interval(inside[axis], mask.shape[axis]) for axis in (0, 1)
        ), pressure[inside].sum() * SPACING[0] * SPACING[1], pressure[inside].max(), *winds))  # fmt: skip
    names = ("area", "perimeter", "extent_x", "extent_y", "load", "peak_pressure", "percolates_x", "percolates_y")
    return labels, dict(zip(names, np.array(rows).reshape(-1, len(names)).T, strict=True))


def shortest_interval(positions: np.ndarray, period: int) -> int:
    """Points of the shortest interval of a periodic axis that holds all positions: the axis less its widest gap."""
    held = np.unique(positions)
    return period - max(np.diff(held, append=held[0] + period)) + 1


def scipy_labels(mask: np.ndarray, connectivity: int) -> np.ndarray:
    """Periodic labels in row-major order of first pixels: `ndimage.label`, then the pairs across the edges joined."""
    planar, count = ndimage.label(mask, np.ones((3, 3)) if connectivity == 8 else None)
    pairs = []
    for axis in (0, 1):
        low, high = planar.take(0, axis), planar.take(-1, axis)
        pairs += [(high, np.roll(low, shift)) for shift in ((-1, 0, 1) if connectivity == 8 else (0,))]
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    joined = (a > 0) & (b > 0)
    graph = sparse.coo_array((np.ones(joined.sum()), (a[joined], b[joined])), shape=(count + 1, count + 1))
    merged = sparse.csgraph.connected_components(graph, directed=False)[1][planar]
    values, first, inverse = np.unique(np.where(mask, merged, -1), return_index=True, return_inverse=True)
    first[values == -1] = -1  # the background before all patches
    number = np.argsort(np.argsort(first)) + (values[0] != -1)
    return number[inverse].reshape(mask.shape)


PARTS = {}


def cut(comm, ranks: int):
    """The communicator of the first `ranks` ranks, made once; None on the others.  Collective."""
    if ranks not in PARTS:
        part = comm.Split(int(comm.rank >= ranks))
        PARTS[ranks] = part if comm.rank < ranks else None
    return PARTS[ranks]


def pressures(mask: np.ndarray, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).exponential(size=mask.shape) * mask


def differences(comm, mask, connectivity, starts, expected) -> list[str]:
    """What differs from `expected` (labels, table) on this rank, for a mask cut at `starts`.  Collective."""
    labels, table = expected
    rows = slice(starts[comm.rank], starts[comm.rank + 1])
    found = label_patches(comm, mask[rows], starts, connectivity)
    measured = patch_table(found, SPACING, pressures(mask)[rows])
    wrong = [] if np.array_equal(found.label_field(), labels[rows]) else ["labels"]
    if found.count != labels.max():
        wrong.append("count")
    if comm.rank == 0:
        wrong += [name for name in EXACT if not np.array_equal(measured[name], table[name])]
        # At most 6208 positive terms, each sum rounded to 1.1e-16 of itself.
        if not np.allclose(measured["load"], table["load"], rtol=1e-12, atol=0):
            wrong.append("load")
        if not np.allclose(measured["mean_pressure"], table["load"] / table["area"], rtol=1e-12, atol=0):
            wrong.append("mean_pressure")
    return wrong


def check(comm, mask, connectivities=(4, 8)):
    """Compare a mask, on all rank counts and moved over the seams, with its flood fill, and return it.  Collective."""
    nx, ny = mask.shape
    for moved in (mask, np.roll(mask, (nx // 2, ny // 2), (0, 1)), np.roll(mask, (1, 2), (0, 1))):
        for connectivity in connectivities:
            expected = flood_fill(moved, pressures(moved), connectivity)
            for ranks in range(1, min(comm.size, nx) + 1):
                part = cut(comm, ranks)
                if part:
                    assert not differences(part, moved, connectivity, slab_starts(nx, ranks), expected)
    return SimpleNamespace(**expected[1])


def random_case(seed: int, index: int):
    """A mask of any density and size, the connectivity, and a generator for where to cut it."""
    rng = np.random.default_rng([354013, seed, index])
    largest = (97, 64) if index % 50 == 0 else (30, 30) if index % 5 == 0 else (13, 13)
    shape = largest if index % 100 == 0 else rng.integers(1, largest, endpoint=True)
    return rng.random(shape) < rng.uniform(0.05, 0.95), (4, 8)[index % 2], rng


def test_random_masks(comm, request):
    """Random masks, from 1 × 1 to 97 × 64 and cut anywhere, have the patches that a flood fill finds.  1000 masks on
    one rank, 300 others on each further rank count; 3000 on each with --long."""
    count = 3000 if request.config.getoption("--long") else 1000 if comm.size == 1 else 300
    fills = {}
    for index in range(comm.rank, count, comm.size):
        mask, connectivity, _ = random_case(comm.size, index)
        fills[index] = flood_fill(mask, pressures(mask), connectivity)
    for part in comm.allgather(fills):
        fills |= part
    wrong = []
    for index in range(count):
        mask, connectivity, rng = random_case(comm.size, index)
        most = min(comm.size, len(mask))
        ranks = int(rng.integers(1, most, endpoint=True)) if index % 3 == 0 else most
        starts = np.array([0, *np.sort(rng.permutation(np.arange(1, len(mask)))[: ranks - 1]), len(mask)])
        part = cut(comm, ranks)
        if part:
            wrong += [(index, what) for what in differences(part, mask, connectivity, starts, fills[index])]
    assert not wrong


@pytest.mark.breadth
def test_five_ranks(comm):
    """The same on five ranks, whose tree of seams is uneven: a group of four joins a single one."""
    if comm.size > 1:
        pytest.skip("starts its own ranks")
    root = Path(__file__).parents[1]
    command = '. tools/env.sh && exec mpirun -n 5 "$0" -m mpi4py -m pytest -q -p no:cacheprovider -k random_masks "$1"'
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("OMPI_", "PMIX_"))}
    run = subprocess.run(
        ["bash", "-c", command, sys.executable, __file__],
        cwd=root, env=clean, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    assert run.stdout.count("1 passed") == 5


def test_empty_and_full(comm):
    """An empty mask has no patches; a full one has one, without perimeter, which percolates both ways."""
    for shape in [(1, 1), (1, 2), (2, 1), (2, 2), (5, 4), (12, 7)]:
        assert len(check(comm, np.zeros(shape, bool)).area) == 0
        full = check(comm, np.ones(shape, bool))
        assert full.area == shape[0] * shape[1] * SPACING[0] * SPACING[1]
        assert full.perimeter == 0
        assert full.percolates_x and full.percolates_y


@pytest.mark.parametrize("shape", [(16, 16), (31, 24)])
def test_spiral(comm, shape):
    """An arm that turns inwards is one patch, the space between its turns another one; neither percolates."""
    mask = np.zeros(shape, bool)
    x, y, step = 1, 1, (0, 1)
    legs = [shape[1] - 3]
    for turn in range(0, min(shape) - 4, 2):
        legs += [shape[0] - 3 - turn, shape[1] - 3 - turn]
    for leg in legs:
        mask[np.arange(leg + 1) * step[0] + x, np.arange(leg + 1) * step[1] + y] = True
        x, y, step = x + leg * step[0], y + leg * step[1], (step[1], -step[0])
    arm = check(comm, mask)
    assert len(arm.area) == 1
    assert arm.extent_x == SPACING[0] * (shape[0] - 2)
    assert not arm.percolates_x and not arm.percolates_y
    check(comm, ~mask)


def test_spiral_around_the_torus(comm):
    """A staircase that goes once around x and three times around y is one patch and percolates both ways."""
    mask = np.zeros((12, 4), bool)
    for i in range(12):
        mask[i, [i % 4, (i + 1) % 4]] = True
    stair = check(comm, mask)
    assert len(stair.area) == 1
    assert stair.percolates_x and stair.percolates_y


@pytest.mark.mpi("breadth")
def test_comb(comm):
    """Teeth that meet at the last row only, or at the first one, or at both in turn, are one patch."""
    teeth = np.zeros((18, 21), bool)
    teeth[1:-1, 1:-1:2] = True
    assert len(check(comm, teeth).area) == 10
    below, above, meander = teeth.copy(), teeth.copy(), teeth.copy()
    below[16, 1:-1] = True
    above[1, 1:-1] = True
    for number, column in enumerate(range(2, 19, 2)):
        meander[16 if number % 2 else 1, column] = True
    for mask in (below, above, meander, below.T, meander.T):
        assert len(check(comm, np.ascontiguousarray(mask)).area) == 1
        check(comm, np.ascontiguousarray(~mask))


def test_rings_around_both_seams(comm):
    """Rings centred on the corner of the cell keep their true extent, and percolate nowhere."""
    x, y = np.meshgrid(np.arange(24), np.arange(20), indexing="ij")
    distance = np.maximum(np.minimum(x, 24 - x), np.minimum(y, 20 - y))
    rings = check(comm, (distance % 3 == 2) & (distance < 9))
    rings_at_corner = flood_fill((distance % 3 == 2) & (distance < 9), np.zeros((24, 20)), 8)[1]
    for table in (rings, SimpleNamespace(**rings_at_corner)):
        assert sorted(table.extent_x / SPACING[0]) == [5, 11, 17]
        assert sorted(table.extent_y / SPACING[1]) == [5, 11, 17]
        assert not table.percolates_x.any() and not table.percolates_y.any()


def test_percolation_is_winding(comm):
    """A band along x percolates in x alone; interrupted by a single row it does not, although it crosses the seam."""
    mask = np.zeros((10, 12), bool)
    mask[:, 4:6] = True
    band = check(comm, mask)
    assert band.percolates_x and not band.percolates_y
    assert band.extent_x == 10 * SPACING[0] and band.extent_y == 2 * SPACING[1]
    mask[6] = False
    bar = check(comm, mask)
    assert not bar.percolates_x and bar.extent_x == 9 * SPACING[0]


def test_longer_than_the_cell(comm):
    """A helix of one and a half turns that does not close: its extent is the cell, and it does not percolate."""
    mask = np.zeros((20, 12), bool)
    steps = np.arange(30)
    mask[steps % 20, steps // 5] = True
    helix = check(comm, mask, connectivities=(8,))
    assert helix.area == 30 * SPACING[0] * SPACING[1]
    assert helix.extent_x == 20 * SPACING[0] and helix.extent_y == 6 * SPACING[1]
    assert not helix.percolates_x and not helix.percolates_y


def test_diagonal_chains_across_corners(comm):
    """Pixels that touch at corners alone, also that of the cell: one 8-connected patch, or single pixels."""
    for shape in [(7, 7), (6, 9), (2, 2), (1, 3), (3, 1), (2, 3)]:
        for direction in (1, -1):
            mask = np.zeros(shape, bool)
            steps = np.arange(np.lcm(*shape) // 3 + 1)
            mask[steps % shape[0], direction * steps % shape[1]] = True
            check(comm, mask)
    chain = np.eye(7, dtype=bool)
    table = check(comm, chain, connectivities=(8,))
    assert len(table.area) == 1
    assert table.percolates_x and table.percolates_y
    assert len(check(comm, chain, connectivities=(4,)).area) == 7


def test_checkerboard(comm):
    """The most runs a mask can have: as many patches as pixels, or a single one."""
    mask = np.indices((8, 10)).sum(0) % 2 == 0
    assert len(check(comm, mask, connectivities=(4,)).area) == 40
    assert len(check(comm, mask, connectivities=(8,)).area) == 1


def smooth_noise(shape, cover, seed=5):
    """A field with patches of all sizes, and the mask of its highest points that cover this fraction of the cell."""
    field = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(shape), 0.8, mode="wrap")
    return field, field > np.quantile(field, 1 - cover)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_labels_against_scipy(comm, connectivity):
    """On 405 × 512 points, thousands of patches, the labels are those of `scipy.ndimage` joined across the edges."""
    for cover in (0.05, 0.4, 0.6):
        mask = smooth_noise((405, 512), cover)[1]
        starts = slab_starts(405, comm.size)
        rows = slice(starts[comm.rank], starts[comm.rank + 1])
        found = label_patches(comm, mask[rows], starts, connectivity)
        assert np.array_equal(found.label_field(), scipy_labels(mask, connectivity)[rows])


def test_sums(comm):
    """Areas sum to the contact area, loads to the load, perimeters to the contact edges; float32 pressures too."""
    field, mask = smooth_noise((300, 257), 0.4)
    pressure = np.where(mask, field - field[mask].min() + 0.1, 0)
    starts = slab_starts(300, comm.size)
    rows = slice(starts[comm.rank], starts[comm.rank + 1])
    table = patch_table(label_patches(comm, mask[rows], starts), SPACING, pressure[rows])
    single = patch_table(label_patches(comm, mask[rows], starts), SPACING, pressure[rows].astype(np.float32))
    if comm.rank == 0:
        assert table["area"].sum() == mask.sum() * SPACING[0] * SPACING[1]
        edges = [np.count_nonzero(mask != np.roll(mask, 1, axis)) for axis in (0, 1)]
        assert table["perimeter"].sum() == edges[0] * SPACING[1] + edges[1] * SPACING[0]
        # 3e4 positive terms, in another order: a relative error below 3e4 × 1.1e-16.
        assert table["load"].sum() == pytest.approx(pressure.sum() * SPACING[0] * SPACING[1], rel=3e-12, abs=0)
        # Each pressure is rounded to 6e-8 of itself, and the sums are in double precision.
        assert np.allclose(single["load"], table["load"], rtol=6e-8, atol=0)


def test_no_pressure(comm):
    """Without a pressure, as for a bearing area, the shapes are measured and there are no loads."""
    mask = smooth_noise((40, 30), 0.3)[1]
    starts = slab_starts(40, comm.size)
    rows = slice(starts[comm.rank], starts[comm.rank + 1])
    table = patch_table(label_patches(comm, mask[rows], starts), SPACING)
    assert bool(table) == (comm.rank == 0)
    if table:
        assert not {"load", "mean_pressure", "peak_pressure"} & table.keys()
        assert np.array_equal(table["area"], flood_fill(mask, mask * 1.0, 8)[1]["area"])


def test_fragments_are_those_of_scipy():
    """The compiled union–find joins what `scipy.ndimage.label` joins in the plane, in the order of first pixels."""
    for reach, structure in ((0, None), (1, np.ones((3, 3)))):
        mask = smooth_noise((200, 150), 0.5, seed=8)[1]
        runs, first = find_runs(np.zeros(150, bool), mask)
        fragment, covered, below, count = find_fragments(runs, first, reach)
        planar, expected = ndimage.label(mask, structure)
        rows = np.repeat(np.arange(200), np.diff(first)[1:])
        assert below == count == expected
        assert np.array_equal(fragment, planar[rows, runs[:, 0]] - 1)
        assert covered.sum() == np.count_nonzero(mask[1:] & mask[:-1])
        assert (runs[:, 1] - runs[:, 0]).sum() == mask.sum()


def test_memory():
    """Labels and table of white noise, the worst case in practice, take at most 15 bytes per point."""
    from mpi4py import MPI

    n = 1024
    rng = np.random.default_rng(2)
    mask = rng.random((n, n)) < 0.4
    pressure = mask * 1.0
    tracemalloc.start()
    labels = label_patches(MPI.COMM_SELF, mask, np.array([0, n]))
    patch_table(labels, SPACING, pressure)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 15 * n * n


def test_wrong_input(comm):
    """A wrong connectivity, a mask or a pressure of another shape or type are refused on all ranks together."""
    starts = slab_starts(8, comm.size)
    mask = np.ones((starts[comm.rank + 1] - starts[comm.rank], 6), bool)
    with pytest.raises(InputError, match="connectivity = 6"):
        label_patches(comm, mask, starts, connectivity=6)
    for wrong in (mask[:, 0], mask.astype(np.uint8), mask[:, :0], np.vstack([mask, mask])):
        with pytest.raises((ValueError, RuntimeError), match="must be bool"):
            label_patches(comm, wrong if comm.rank == comm.size - 1 else mask, starts)
    with pytest.raises((ValueError, RuntimeError), match="the labels"):
        patch_table(label_patches(comm, mask, starts), SPACING, np.ones((1, 1)))

"""Slab transforms and the grid hierarchy, against NumPy on one process and mpi4py-fft on all."""

import os
import time
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

from pgfmd.errors import InputError, SolverError
from pgfmd.grid import aligned, grid_cost, slab_grid, transpose
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transfer import Interpolation, SubGrid, interpolate, restrict, restrict_locally
from pgfmd.parallel import collectives, mpi
from pgfmd.parallel.collectives import await_all, by_node, raise_together, shared, slab_starts

pytestmark = [pytest.mark.mpi, pytest.mark.uneven]

SHAPES = [(8, 8), (13, 10), (9, 7), (16, 6), (31, 1), (12, 2), (64, 48)]
# Rounding of an FFT grows like eps log N; the factor covers the norm used here.
EXACT = {np.float64: 1e-13, np.float32: 1e-5}


def field(shape, seed=0):
    """The same random field on all ranks."""
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
def test_forward_is_the_plain_sum(comm, shape, shared, dtype):
    """Spectra equal NumPy's rfft2, transposed, whether strips are shared or exchanged."""
    whole = field(shape)
    grid = SlabGrid(comm, shape, transform="blocked" if shared else "exchanged")
    found = grid.forward(whole[grid.rows].astype(dtype))
    expected = np.fft.rfft2(whole.astype(dtype)).T[grid.columns]
    assert found.shape == grid.spectral_shape
    assert np.abs(found - expected).max(initial=0) <= EXACT[dtype] * np.abs(whole).sum()
    grid.free()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("shape", [*SHAPES, (11, 600)])
def test_transforms_between_nodes(comm, monkeypatch, shape, dtype):
    """The same where each two ranks that follow each other share memory, and messages pass between these pairs."""
    pair = comm.Split(comm.rank // 2)
    monkeypatch.setattr(transpose, "node_of", lambda _: pair)
    whole = field(shape)
    if comm.size <= shape[0]:
        grid = SlabGrid(comm, shape)
        spectrum = grid.forward(whole[grid.rows].astype(dtype))
        expected = np.fft.rfft2(whole.astype(dtype)).T[grid.columns]
        assert np.abs(spectrum - expected).max(initial=0) <= EXACT[dtype] * np.abs(whole).sum()
        assert np.allclose(grid.backward(spectrum), whole[grid.rows], rtol=0, atol=100 * EXACT[dtype])
        grid.free()
    pair.Free()


def test_one_node_without_shared_memory(comm, monkeypatch, caplog):
    """Where one node lacks shared memory all strips are exchanged; rank 0 says so once for all grids."""
    if comm.size == 1:
        pytest.skip("one rank shares with nobody")
    transpose._warn.cache_clear()
    free = 100.0 if comm.rank == comm.size - 1 else 1e9
    monkeypatch.setattr(transpose, "shared_memory", lambda: ("/dev/shm", free))
    for shape in ((9, 8), (12, 10)):
        whole, grid = field(shape), SlabGrid(comm, shape)
        expected = np.fft.rfft2(whole).T[grid.columns]
        assert np.abs(grid.forward(whole[grid.rows]) - expected).max(initial=0) <= EXACT[np.float64] * 1e2
        assert isinstance(grid._strips, transpose.ExchangedStrips) and grid._strips.window is None
        grid.free()
    assert caplog.text.count("/dev/shm is too small") == (comm.rank == 0)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("shape", [(9, 8), (300, 290), (11, 600)])
def test_nodes_that_are_not_alike(comm, monkeypatch, caplog, shape, dtype):
    """Nodes of 1 and n − 1, n − 1 and 1, and 1, n − 2 and 1 ranks: spectra are right, each rank sends one message to
    every other node, and one line says so."""
    if comm.size < 3:
        pytest.skip("two nodes that differ have three ranks")
    caplog.set_level("INFO", "pgfmd")
    last = comm.size - 1
    for ends in ((1,), (last,), (1, last)):
        transpose._log_nodes.cache_clear()
        caplog.clear()
        number = int(np.searchsorted(ends, comm.rank, side="right"))
        node, separate = comm.Split(number), comm.Dup()
        sizes = np.diff([0, *ends, comm.size])
        monkeypatch.setattr(transpose, "node_of", lambda _, node=node: node)
        whole, grid = field(shape).astype(dtype), SlabGrid(separate, shape)
        spectrum = grid.forward(whole[grid.rows])
        expected = np.fft.rfft2(whole).T[grid.columns]
        assert np.abs(spectrum - expected).max(initial=0) <= EXACT[dtype] * np.abs(whole).sum()
        assert np.allclose(grid.backward(spectrum), whole[grid.rows], rtol=0, atol=100 * EXACT[dtype])
        targets, senders = (set(ranks.tolist()) for ranks in (grid._strips._targets, grid._strips._senders))
        assert len(targets) == len(sizes) and comm.rank in targets & senders
        known = comm.allgather((targets, senders))
        assert all((comm.rank in known[rank][0]) == (rank in senders) for rank in range(comm.size))
        said = f"{sizes.min()} to {sizes.max()} ranks" if sizes.min() < sizes.max() else "of 1 rank exchange"
        assert caplog.text.count(f"{len(sizes)} nodes of") == caplog.text.count(said) == (comm.rank == 0)
        grid.free()
        separate.Free()
        node.Free()


def test_ranks_are_numbered_by_node(comm, monkeypatch, caplog):
    """Ranks dealt to nodes in turn exchange all in messages, and one line says so, until they are numbered by node."""
    if comm.size < 3:
        pytest.skip("two nodes that are not consecutive have three ranks")
    node, separate = comm.Split(comm.rank % 2), comm.Dup()
    transpose._warn.cache_clear()
    monkeypatch.setattr(transpose, "node_of", lambda _: node)
    whole, grid = field((9, 8)), SlabGrid(separate, (9, 8))
    assert np.abs(grid.forward(whole[grid.rows]) - np.fft.rfft2(whole).T[grid.columns]).max(initial=0) <= 1e-13
    assert caplog.text.count("not numbered node by node") == (comm.rank == 0)
    grid.free()
    monkeypatch.setattr(collectives, "node_of", lambda _: node)
    ordered = by_node(separate)
    assert ordered.allgather(comm.rank) == sorted(range(comm.size), key=lambda rank: (rank % 2, rank))
    pair = comm.Split(comm.rank // 2)
    monkeypatch.setattr(collectives, "node_of", lambda _: pair)
    assert by_node(separate) is separate
    for made in (ordered, separate, node, pair):
        made.Free()


class Node:
    """Rank 0 of as many ranks as a node has, or of as many nodes, whose messages are kept."""

    def __init__(self, size: int):
        self.size, self.rank = size, 0

    def Alltoallv(self, *messages) -> None:
        self.messages = messages


@pytest.mark.parametrize(("n", "nodes"), [(65536, 2), (131072, 2), (131072, 8)])
@pytest.mark.parametrize("kind", ["c8", "c16"])
def test_messages_between_nodes_have_32_bit_counts(tmp_path, monkeypatch, n, nodes, kind):
    """Of grids that fill two nodes, counts and displacements are below 2³¹, in blocks of items that make up whole rows:
    of this rank's rows those columns that each other node has, one node after another; and rows of the strip where they
    belong."""
    ranks, path, pieces = 64 * nodes, tmp_path / "memory", []

    def allocate(self, node, count, any_shared):
        path.touch()
        os.truncate(path, count)  # a sparse file: no byte is touched
        pieces.append(np.memmap(path, np.uint8, "r+"))
        self.node, self.flat = node, pieces[0]

    monkeypatch.setattr(transpose.ExchangedStrips, "_allocate", allocate)
    monkeypatch.setattr(transpose, "datatype", lambda dtype, count: count)
    monkeypatch.setattr(transpose, "peers_of", lambda *_: Node(nodes))
    strips = transpose.ExchangedStrips(Node(ranks), (n, n), Node(64), np.arange(0, ranks + 1, 64))
    dtype = np.dtype(kind)
    strips._exchange(dtype, False)
    columns, rows = slab_starts(n // 2 + 1, ranks)[::64], slab_starts(n, ranks)
    widths = [aligned.row_stride(int(width), dtype.itemsize) for width in np.diff(columns)]
    (packed, sizes, begins, block), (strip, of_peers, places, same) = strips.peers.messages
    assert max(map(np.max, (sizes, begins, of_peers, places))) < 2**31 and block == same
    assert packed.ctypes.data - strip.ctypes.data == strips._packed and strip.ctypes.data == pieces[0].ctypes.data
    assert list(block * sizes) == [0, *(int(rows[1]) * width for width in widths[1:])]
    assert list(block * begins)[1:] == [int(rows[1]) * sum(widths[1:node]) for node in range(1, nodes)]
    assert list(block * of_peers) == [0, *(np.diff(rows)[64::64] * widths[0])]
    assert list(block * places) == list(rows[:-1:64] * widths[0])


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("shape", SHAPES + [(300, 290)])
def test_backward_undoes_forward(comm, shape, threads):
    """backward(forward(u)) = u, with several threads too."""
    grid = SlabGrid(comm, shape, threads=threads)
    mine = field(shape)[grid.rows].copy()
    assert np.abs(grid.backward(grid.forward(mine)) - mine).max() < 1e-13 * np.sqrt(grid.size)
    grid.free()


def test_parseval_with_hermitian_weights(comm):
    """Σ u² = Σ w |ũ|²/N, which fixes the weights for even and odd ny."""
    for shape in ((12, 10), (12, 9)):
        grid = SlabGrid(comm, shape)
        mine = field(shape)[grid.rows].copy()
        power = grid.reduction.sum(grid.hermitian_weight * np.abs(grid.forward(mine)) ** 2) / grid.size
        assert power == pytest.approx(grid.reduction.sum(mine**2), rel=1e-13, abs=0)


def test_wave_numbers_are_those_of_the_cell(comm):
    """q² of each mode on a stretched cell, by NumPy's frequencies; to rounding of a sum of squares."""
    grid = SlabGrid(comm, (12, 8), (3.0, 5.0))
    qx, qy = 2 * np.pi * np.fft.fftfreq(12, 3 / 12), 2 * np.pi * np.fft.rfftfreq(8, 5 / 8)
    np.testing.assert_allclose(grid.q_squared(), (qx**2 + qy[:, None] ** 2)[grid.columns], rtol=1e-14)


def test_more_ranks_than_rows_are_refused_by_all(comm):
    """Empty slabs are not supported; every rank says so."""
    if comm.size == 1:
        pytest.skip("one rank always has a row")
    with pytest.raises(InputError, match="at most one rank per row"):
        SlabGrid(comm, (comm.size - 1, 8))


def test_a_slow_rank_gets_its_rows(comm):
    """One rank may begin the next field, or the next fetch of rows, while another is not through with this one."""
    grid = SlabGrid(comm, (600 * comm.size, 64))  # several blocks of rows for each rank
    spectra = [grid.forward(factor * field(grid.shape)[grid.rows]) for factor in (1.0, 2.0)]
    expected = [grid.backward(spectrum).copy() for spectrum in spectra]
    found = []
    for spectrum in spectra:
        out = np.empty(grid.local_shape)

        def drain(first, stop, rows, out=out):
            out[first:stop] = rows / grid.size
            time.sleep(0.05 * comm.rank)

        def make(block, first, stop, spectrum=spectrum):
            block[...] = spectrum[first:stop]

        grid.make_field(make, drain)
        found.append(out)
    assert all(np.allclose(*pair, rtol=0, atol=1e-12) for pair in zip(found, expected, strict=True))


def test_nobody_goes_on_before_the_last_has_come(comm, shared_tmp_path):
    """What rank 0 did before `await_all`, the others find after it."""
    if comm.rank == 0:
        (shared_tmp_path / "here").touch()
    await_all(comm)
    assert (shared_tmp_path / "here").exists()


def test_waiting_for_those_who_work_takes_no_processor(monkeypatch):
    """While the others work for a second a rank polls for less than a third of it.  Each poll takes 10 µs."""
    now, asleep = [0.0], [0.0]

    def sleep(seconds):
        now[0] += seconds
        asleep[0] += seconds

    def arrived():
        now[0] += 1e-5
        return now[0] > 1

    monkeypatch.setattr(collectives, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    await_all(SimpleNamespace(Ibarrier=lambda: SimpleNamespace(Test=arrived)))
    assert asleep[0] > 2 / 3


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("shape", [(23, 6), (8, 40), (9, 1)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rows_cross_the_ranks(comm, shared, shape, dtype):
    """In messages, or through the memory of transforms once that is there, as often as one likes."""
    grid = SlabGrid(comm, shape, transform="blocked" if shared else "exchanged")
    whole = field(shape).astype(dtype)
    for _ in range(3):
        for first, stop in ((-3 - comm.rank, 5), (4, 4), (9, 9 + 25 + comm.rank), (-30, -2)):
            found = grid.fetch(whole[grid.rows].copy(), first, stop)
            assert np.array_equal(found, whole[np.arange(first, stop) % shape[0]])
        assert np.allclose(grid.backward(grid.forward(whole[grid.rows])), whole[grid.rows], rtol=0, atol=1e-5)


@pytest.mark.parametrize(("fine", "coarse"), [((64, 48), (32, 24)), ((33, 30), (17, 15)), ((37, 41), (19, 21))])
@pytest.mark.parametrize("least", [1, 16])
def test_restriction_keeps_the_long_waves(comm, monkeypatch, fine, coarse, least):
    """Waves that both grids resolve come through exactly, shorter ones vanish; on any number of ranks."""
    monkeypatch.setattr(grid_cost, "SMALL", 0)
    big = SlabGrid(comm, fine, (3.0, 4.0))
    small = SubGrid(big, coarse, big.lengths, least)

    def waves(grid, also):
        x = np.arange(grid.shape[0])[grid.layout.rows, None] / grid.shape[0]
        y = np.arange(grid.shape[1])[None, :] / grid.shape[1]
        long = 2 + np.cos(2 * np.pi * (3 * x - 2 * y) + 0.3) + np.sin(2 * np.pi * 5 * x)
        return long + (np.cos(2 * np.pi * (fine[0] // 2 - 1) * x) if also else 0)

    assert np.abs(restrict(big, small, waves(big, True)) - waves(small, False)).max(initial=0) < 1e-12


@pytest.mark.parametrize("shape", [(12, 8), (9, 7), (6, 1), (5, 2)])
@pytest.mark.parametrize("factor", [2, 3])
def test_fourier_interpolation_keeps_points_and_modes(comm, shape, factor):
    """The coarser points stay; no mode lies beyond their Nyquist frequencies, where each sign has as much."""
    coarse, fine = (SlabGrid(comm, (k * shape[0], k * shape[1]), (3.0, 4.0)) for k in (1, factor))
    whole = field(shape)
    found = fine.fetch(interpolate(coarse, fine, whole[coarse.rows].copy()), 0, fine.shape[0])
    np.testing.assert_allclose(found[::factor, ::factor], whole, atol=1e-12)
    spectrum = np.fft.fft2(found)
    kx, ky = np.meshgrid(*(np.abs(np.fft.fftfreq(n, 1 / n)) for n in fine.shape), indexing="ij")
    assert np.abs(spectrum[(kx > shape[0] / 2) | (ky > shape[1] / 2)]).max(initial=0) < 1e-9
    mirrored = np.roll(spectrum[::-1], 1, 0)
    edge = (kx == shape[0] / 2) & (ky < shape[1] / 2)
    np.testing.assert_allclose(spectrum[edge], mirrored[edge], atol=1e-9)


@pytest.mark.parametrize(("fine", "coarse"), [((64, 48), (32, 24)), ((33, 30), (17, 15)), ((37, 41), (19, 21))])
@pytest.mark.parametrize("least", [1, 16])
def test_local_restriction_is_the_adjoint_of_interpolation(comm, monkeypatch, fine, coarse, least):
    """Each coarse point is the mean of the fine ones with the weights by which interpolation takes a peak there to
    them, here from `Interpolation` itself; in single precision, on any number of ranks, the field far from 0 or not."""
    monkeypatch.setattr(grid_cost, "SMALL", 0)
    big = SlabGrid(comm, fine, (3.0, 4.0))
    small = SubGrid(big, coarse, big.lengths, least)
    whole = 3 + field(fine)
    found = restrict_locally(big, small, whole[big.rows])

    def means(i: int, j: int) -> float:
        peak = np.zeros(coarse)
        peak[i, j] = 1
        rows = Interpolation(small, big, [peak[small.layout.rows]]).rows(0, 0, big.local_shape[0])
        total, weight = comm.allreduce(np.array([np.vdot(rows, whole[big.rows]), rows.sum()]))
        return total / weight

    for i, j in ((0, 0), (coarse[0] - 1, coarse[1] - 1), (5, 7)):
        mean, own = means(i, j), i - small.layout.rows.start
        if 0 <= own < len(found):
            assert found[own, j] == pytest.approx(mean, rel=1e-6)
    assert np.allclose(restrict_locally(big, small, np.full(big.local_shape, 3.0)), 3, rtol=1e-6, atol=0)


@pytest.mark.parametrize("shape", [(35, 29), (32, 24)])
def test_interpolation_is_exact_for_cubics(comm, shape):
    """Cubic interpolation reproduces cubics away from the wrap, for any ratio of points."""
    fine = SlabGrid(comm, shape, (1.0, 1.0))
    coarse = SubGrid(fine, (16, 12), fine.lengths)

    def values(grid, power):
        x = np.arange(grid.shape[0])[grid.layout.rows, None] / grid.shape[0]
        y = np.arange(grid.shape[1])[None, :] / grid.shape[1]
        return (1 + x) ** power * (2 - y) ** power

    found = Interpolation(coarse, fine, [values(coarse, 3), values(coarse, 1)])
    inner = np.arange(fine.shape[0])[fine.rows] / fine.shape[0]
    rows, columns = (inner > 1.01 / 16) & (inner < 13.9 / 16), slice(3, 19)
    for which, power in ((0, 3), (1, 1)):
        whole = np.vstack([found.rows(which, i, i + 1).copy() for i in range(fine.local_shape[0])])
        assert np.abs(whole - values(fine, power))[rows, columns].max(initial=0) < 1e-12


def test_coarser_grids_lie_on_fewer_ranks(comm):
    """Ranks hold each grid once, rank 0 as much as `check` knows; others learn the result, or its failure."""
    fine = SlabGrid(comm, (1024, 300))
    shares, place = grid_cost.largest_shares(fine.shape, comm.size), SubGrid.coarse(fine)
    for share in shares[1:]:
        points = place.comm.allgather(place.local_shape[0] * place.local_shape[1])
        assert sum(points) == place.size and max(points) == points[0] == share
        assert place.on_all(lambda grid: grid.comm.size) == grid_cost.holders(place.shape, place.comm.size)
        if place.grid is None:
            break
        place = SubGrid.coarse(place.grid)

    def fail(grid):
        raise InputError("no")

    with pytest.raises(InputError, match="no"):
        SubGrid(fine, (10, 10), fine.lengths).on_all(fail)


def test_fields_do_not_share_cache_lines_of_a_page():
    """Any five fields made one after the other begin at places of a page, modulo 4096 bytes, that differ by more than a
    cache line either way, on whole lines; five are what a loop takes, and one line apart is as slow as none."""
    fields = [SlabGrid(MPI.COMM_SELF, (512, 512)).new_field() for _ in range(70)]
    places = [field.ctypes.data for field in fields]
    for first in range(66):
        lines = np.array(places[first : first + 5]) // 64
        apart = np.abs(lines[:, None] - lines)[~np.eye(5, dtype=bool)] % 64
        assert 1 < apart.min() and apart.max() < 63
    assert all(place % 64 == 0 for place in places)
    assert all(field.shape == (512, 512) and field.dtype == float and field.flags.c_contiguous for field in fields)


@pytest.mark.parametrize("kind", [SolverError, MemoryError])
def test_error_of_all_ranks_of_a_smaller_grid(comm, kind):
    """An error that the ranks with rows raise together is raised on all ranks, of its kind."""
    place = SubGrid(SlabGrid(comm, (32, 2100)), (32, 2100), (1.0, 1.0))  # on two ranks

    def work(grid):
        with raise_together(grid.comm):
            if grid.comm.rank == grid.comm.size - 1:
                raise kind("together")

    with pytest.raises(kind, match="together") as caught:
        place.on_all(work)
    assert shared(comm, caught.value)


@pytest.mark.parametrize("error", [SolverError, MemoryError])
def test_error_of_one_rank_of_a_smaller_grid(comm, monkeypatch, error):
    """An error of the last rank with rows is raised there; no message disturbs those that wait elsewhere."""
    monkeypatch.setattr(mpi, "PATIENCE", 0.1)
    place = SubGrid(SlabGrid(comm, (32, 2100)), (32, 2100), (1.0, 1.0))  # on two ranks

    def work(grid):
        if grid.comm.rank == grid.comm.size - 1:
            raise error("alone")

    if place.grid is None or place.grid.comm.rank < place.grid.comm.size - 1:
        place.on_all(work)
        return
    with pytest.raises(error, match="alone"):
        place.on_all(work)
    if 1 < place.grid.comm.size < comm.size:
        await_all(comm)  # for which the others wait
        comm.bcast(None)


def test_small_transforms_are_kept_for_the_next_grid():
    """A grid that is freed leaves them to one like it, and to one only; no more than `SPARES` are kept."""
    field = np.random.default_rng(4).standard_normal((12, 10))
    first, second, third = (SlabGrid(MPI.COMM_SELF, (12, 10)) for _ in range(3))
    spectrum, made = first.forward(field), first.transform()
    first.free()
    assert np.array_equal(second.forward(field), spectrum) and second.transform() is made
    assert np.array_equal(third.forward(field), spectrum) and third.transform() is not made
    for n in range(2 * slab_grid.SPARES):
        grid = SlabGrid(MPI.COMM_SELF, (12, 11 + n))
        grid.transform()
        grid.free()
    assert len(slab_grid._spares) == slab_grid.SPARES
    assert SlabGrid(MPI.COMM_SELF, (12, 10)).transform() is not made

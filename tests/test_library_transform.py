"""Transforms by mpi4py-fft give what the blocked ones give."""

import numpy as np
import pytest
from conftest import python
from job_texts import SOLID, rough_job
from mpi4py import MPI

from pgfmd.errors import InputError
from pgfmd.grid import slab_grid
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import sink, source

pytest.importorskip("mpi4py_fft")


@pytest.mark.mpi
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(24, 20), (17, 13), (9, 64), (6, 2), (5, 1)])
def test_both_transforms_agree(comm, shape, dtype):
    """Spectrum, field and a convolution in place agree to rounding: √(log N) ε of the largest value."""
    ours, theirs = SlabGrid(comm, shape), SlabGrid(comm, shape, transform="mpi4py-fft")
    field = np.random.default_rng(20).normal(size=shape)[ours.rows].astype(dtype)
    close = {"rtol": 0, "atol": 20 * np.finfo(dtype).eps}
    expected = ours.forward(field)
    found = theirs.forward(field)
    scale = np.sqrt(ours.size)
    np.testing.assert_allclose(found / scale, expected / scale, **close)
    np.testing.assert_allclose(theirs.backward(found), field, **close)

    results = []
    for grid in (ours, theirs):
        factor = (1 / (1 + grid.q_squared()) / grid.size).astype(dtype)

        def smooth(block, first, stop, factor=factor):
            block *= factor[first:stop]

        out = np.empty(grid.local_shape)
        grid.convolve(source(field), smooth, sink(out), dtype)
        results.append(out)
    np.testing.assert_allclose(*results, **close)


@pytest.mark.mpi
def test_a_job_solves_alike(comm, shared_tmp_path):
    """A whole run with either transform gives the same fields to 1e-12 of their size."""
    from pgfmd.application.job import parse
    from pgfmd.application.results import Results
    from pgfmd.application.simulate import simulate

    parts = {"solid": {"contact_modulus": 1.0}, "load": {"pressure": [0.02]}, "output": {"fields": ["pressure", "gap"]}}
    text = rough_job(128, {"lambda_s": 8.0}, solver={"tolerance": 1e-20}, **parts)
    for name in ("blocked", "mpi4py-fft"):
        simulate(parse(text, "job", [f"solver.transform={name}"]), comm, shared_tmp_path / name)
    for name in ("pressure", "gap"):
        expected, found = (Results(shared_tmp_path / by).field(name, 0) for by in ("blocked", "mpi4py-fft"))
        assert np.abs(found - expected).max() <= 1e-6 * expected.max()  # far above √tolerance, to which both agree
        assert np.linalg.norm(found - expected) <= 1e-6 * np.linalg.norm(expected)


@pytest.mark.mpi
def test_too_many_ranks_are_refused(comm):
    """Ranks without a column of the spectrum: one line instead of an assertion inside the library."""
    if comm.size < 3:
        pytest.skip("needs three ranks")
    with pytest.raises(InputError, match=r"mpi4py-fft.*at most 2 can take part"):
        SlabGrid(comm, (8, 3), transform="mpi4py-fft").transform()


def test_no_pyfftw_is_needed():
    """With the library's transforms a contact is solved where pyfftw is not installed; the blocked ones say so."""
    code = """
import sys
sys.modules["pyfftw"] = None
import numpy as np
from mpi4py import MPI
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.application.simulate import simulate
grid = SlabGrid(MPI.COMM_SELF, (8, 8), transform="mpi4py-fft")
assert abs(grid.forward(np.ones((8, 8)))[0, 0] - 64) < 1e-12
try:
    SlabGrid(MPI.COMM_SELF, (8, 8)).forward(np.ones((8, 8)))
except InputError as error:
    assert "pyfftw" in str(error)
else:
    raise AssertionError
"""
    done = python(code)
    assert done.returncode == 0, done.stderr


def test_it_is_named_where_it_is_missing(tmp_path):
    """Where mpi4py-fft cannot be imported, a job that chooses it is refused in one line."""
    code = "import sys; sys.modules['mpi4py_fft'] = None; from pgfmd.application.cli import main; sys.exit(main())"
    (tmp_path / "job.toml").write_text(
        SOLID + "[grid]\nn = 8\n[surface]\nkind = 'paraboloid'\nradius = 9\n[load]\npressure = 0.1\n"
        "[solver]\ntransform = 'mpi4py-fft'\n"
    )
    done = python(code, "run", tmp_path / "job.toml", "--output", tmp_path / "out")
    assert done.returncode == 2 and "needs that package" in done.stderr.splitlines()[-1]


def test_what_is_freed_does_not_stay():
    """A grid that is freed has freed its library transforms and their communicators, also where others are kept."""
    kept = len(slab_grid._spares)
    grid = SlabGrid(MPI.COMM_SELF, (12, 10), transform="mpi4py-fft")
    made = grid.transform()
    grid.free()
    assert len(slab_grid._spares) == kept
    assert grid.transform() is not made
    grid.free()

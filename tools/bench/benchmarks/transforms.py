"""One forward + backward pair of real two-dimensional transforms: ours, the libraries', and mpi4py-fft's PFFT.

All reuse their plans (FFTW_MEASURE, as in pgfmd) and buffers; only the pair is timed.
"""

import json
import sys
import time
from pathlib import Path

import csv_rows
import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import sink, source
from pgfmd.parallel.collectives import slab
from pgfmd.parallel.mpi import world

from .case import launch

KINDS = (np.float32, np.float64)
PLAN = [  # (name, ranks, threads)
    ("pgfmd", 1, 1),
    ("pyFFTW", 1, 1),
    ("MKL", 1, 1),
    ("scipy", 1, 1),
    ("PFFT", 1, 1),
    ("pgfmd", 1, 2),
    ("pyFFTW", 1, 2),
    ("MKL", 1, 2),
    ("pgfmd", 2, 1),
    ("PFFT", 2, 1),
]
UNNORMALISED = ("pgfmd", "pyFFTW")
ROUNDS = 3  # of all in turn, so that a disturbance hits all; the best counts


def main(folder: Path, n: int = 4096) -> None:
    """Measure all of PLAN, print the table and write DIR/transforms.csv."""
    best: dict[tuple, float] = {}
    for _ in range(ROUNDS):
        for name, ranks, threads in PLAN:
            for kind, seconds in _run(name, ranks, threads, n).items():
                key = (name, ranks, threads, kind)
                best[key] = min(seconds, best.get(key, float("inf")))
    names = ("n", "library", "ranks", "threads", "precision", "seconds")
    rows = [dict(zip(names, (n, *key, seconds), strict=True)) for key, seconds in best.items()]
    csv_rows.write(folder / "transforms.csv", rows, digits=4)
    _print(best, n)


def _run(name: str, ranks: int, threads: int, n: int) -> dict[str, float]:
    process = launch("transforms", [name, str(threads), str(n)], ranks, threads)
    output, errors = process.communicate()
    if process.returncode:
        print(f"{name}: {errors.strip().splitlines()[-1:]}", file=sys.stderr)
        return {}
    return json.loads(output.strip().splitlines()[-1])


def _print(best: dict[tuple, float], n: int) -> None:
    print(f"\nForward + backward pair at {n}², seconds")
    print(f"{'':8} {'ranks':>5} {'threads':>7} {'float32':>9} {'float64':>9}")
    for name, ranks, threads in PLAN:
        values = [best.get((name, ranks, threads, np.dtype(kind).name), float("nan")) for kind in KINDS]
        print(f"{name:8} {ranks:5d} {threads:7d} {values[0]:9.4f} {values[1]:9.4f}")
    print(f"\n{'':44} {'float32':>8} {'float64':>8}  asked")
    ratios = {"one thread / best of pyFFTW and MKL": 1.2, "two threads / one thread": 0.6, "two ranks / one rank": 0.65}
    for what, limit in ratios.items():
        values = []
        for kind in KINDS:
            of = {key[:3]: seconds for key, seconds in best.items() if key[3] == np.dtype(kind).name}
            one = of.get(("pgfmd", 1, 1), np.nan)
            library = min(of.get(("pyFFTW", 1, 1), np.inf), of.get(("MKL", 1, 1), np.inf))
            two = of.get(("pgfmd", 1, 2) if "threads" in what else ("pgfmd", 2, 1), np.nan)
            values.append(one / library if "best of" in what else two / one)
        print(f"{what:44} {values[0]:8.2f} {values[1]:8.2f}  ≤ {limit}")


# ---- in the process that measures: each returns a function that does one pair --------------------------------------


def _pgfmd(n: int, kind, threads: int, field: np.ndarray):
    grid = SlabGrid(world(), (n, n), threads=threads)

    def pair():
        grid.convolve(source(field), lambda block, first, stop: None, sink(field), kind)
        return field

    grid.transform(kind)
    return pair


def _pyfftw(n: int, kind, threads: int, field: np.ndarray):
    import pyfftw

    real = pyfftw.empty_aligned((n, n), kind)
    half = pyfftw.empty_aligned((n, n // 2 + 1), np.result_type(kind, np.complex64))
    options = {"axes": (0, 1), "flags": ("FFTW_MEASURE", "FFTW_DESTROY_INPUT"), "threads": threads}
    forward = pyfftw.FFTW(real, half, **options)
    backward = pyfftw.FFTW(half, real, direction="FFTW_BACKWARD", **options)
    real[...] = field

    def pair():
        forward.execute()
        backward.execute()
        return real

    return pair


def _mkl(n: int, kind, threads: int, field: np.ndarray):
    import mkl_fft

    return lambda: mkl_fft.irfftn(mkl_fft.rfftn(field), s=(n, n))


def _scipy(n: int, kind, threads: int, field: np.ndarray):
    import scipy.fft

    def pair():
        spectrum = scipy.fft.rfft2(field, workers=threads)
        return scipy.fft.irfft2(spectrum, s=(n, n), workers=threads, overwrite_x=True)

    return pair


def _pfft(n: int, kind, threads: int, field: np.ndarray):
    from mpi4py_fft import PFFT

    transform = PFFT(world(), (n, n), axes=(0, 1), dtype=kind)
    transform.forward.input_array[...] = field

    def pair():
        transform.forward()
        return transform.backward()

    return pair


def _measure(name: str, threads: int, n: int) -> dict[str, float]:
    comm = world()
    rows = slab(n, comm.size, comm.rank)
    makers = {"pgfmd": _pgfmd, "pyFFTW": _pyfftw, "MKL": _mkl, "scipy": _scipy, "PFFT": _pfft}
    seconds = {}
    for kind in KINDS:
        field = np.random.default_rng(comm.rank).standard_normal((rows.stop - rows.start, n)).astype(kind)
        pair, times = makers[name](n, kind, threads, field), []
        for _ in range(6):
            comm.Barrier()
            began = time.perf_counter()
            result = pair()
            comm.Barrier()
            times.append(time.perf_counter() - began)
            if name in UNNORMALISED:
                result *= kind(1 / n**2)  # else they overflow
        seconds[np.dtype(kind).name] = min(times)
    return seconds


if __name__ == "__main__":
    result = _measure(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
    if world().rank == 0:
        print(json.dumps(result))

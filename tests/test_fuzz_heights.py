"""Height files that are damaged in any way: heights or one line, never a traceback, a crash, or a hang."""

import subprocess
import sys
from collections import Counter

import campaign_heights
import h5py
import numpy as np
import pytest
from conftest import ROOT
from job_texts import SOLID

from pgfmd.errors import InputError
from pgfmd.surfaces.file import FromFile

SHAPE = (12, 10)
SAID = "cannot be read as heights (.npy or HDF5), perhaps truncated: "

# Another process, since a damaged file may crash HDF5 itself; it says which file it is at.
WORKER = """
import sys
from mpi4py import MPI
from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.surfaces.file import FromFile
import numpy as np
grid = SlabGrid(MPI.COMM_SELF, (12, 10))
for path in sys.stdin.read().splitlines():
    try:
        heights = FromFile(path=path).heights(grid, None)
        assert heights.shape == (12, 10) and heights.dtype == float and np.isfinite(heights).all()
        verdict = "heights"
    except InputError as error:
        verdict = str(error)
        assert verdict.isprintable() and len(verdict) < 1000
    print(verdict, flush=True)
"""


def read_all(paths) -> list[str]:
    """What the reader says to each file, "heights" if it is content; asserts that it survives all of them."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", WORKER], input="\n".join(map(str, paths)), capture_output=True, text=True,
        timeout=3000, check=False, cwd=ROOT,
    )  # fmt: skip
    verdicts = done.stdout.splitlines()
    at = f"at {paths[min(len(verdicts), len(paths) - 1)]}: {done.stderr[-2000:]}"
    assert done.returncode == 0 and len(verdicts) == len(paths), at
    return verdicts


def originals(folder) -> list:
    """Good files of every sort that is read."""
    heights = np.random.default_rng(1).normal(size=SHAPE)
    paths = [folder / "a.npy", folder / "fortran.npy", folder / "small.npy", folder / "a.h5", folder / "packed.h5"]
    np.save(paths[0], heights)
    np.save(paths[1], np.asfortranarray(heights))
    np.save(paths[2], heights.astype(np.float32))
    with h5py.File(paths[3], "w") as file:
        file["heights"] = heights
    paths += [folder / "a.txt", folder / "a.csv", folder / "a.xyz"]
    np.savetxt(paths[5], heights, fmt="%.6g")
    np.savetxt(paths[6], heights, fmt="%.6g", delimiter=";")
    np.savetxt(paths[7], [[i, j, heights[i, j]] for i, j in np.ndindex(SHAPE)], fmt="%.6g")
    with h5py.File(paths[4], "w", libver="latest") as file:
        file.create_dataset("x/y", data=heights, chunks=(5, 5), compression="gzip", shuffle=True, fletcher32=True)
    return paths


def damaged(content: bytes, chance: np.random.Generator) -> bytes:
    """The content with some of its bytes changed, lost, doubled or made up."""
    data = bytearray(content)
    for _ in range(chance.choice([1, 1, 1, 2, 3])):
        at = int(chance.integers(0, min(len(data), 10 ** int(chance.integers(1, 5))) or 1))  # headers most
        way = chance.choice(6, p=[0.4, 0.25, 0.05, 0.05, 0.05, 0.2])
        if way == 0 and data:
            data[at % len(data)] ^= 1 << int(chance.integers(0, 8))
        elif way == 1 and data:
            data[at % len(data)] = int(chance.integers(0, 256))
        elif way == 2:
            del data[at:]
        elif way == 3:
            data[at:at] = chance.bytes(int(chance.integers(1, 20)))
        elif way == 4:
            del data[at : at + int(chance.integers(1, 20))]
        else:
            data[at : at + 8] = int(chance.integers(-(2**62), 2**62)).to_bytes(8, "little", signed=True)
    return bytes(data)


def test_damaged_height_files(tmp_path, request):
    """Bytes changed, lost, inserted anywhere in .npy and HDF5 files: each ends in finite heights or one line."""
    good = originals(tmp_path)
    assert read_all(good) == len(good) * ["heights"]
    count = 4000 if request.config.getoption("--long") else 80
    chance = np.random.default_rng(2)
    folder = tmp_path / "damagéd files"
    folder.mkdir()
    paths = []
    for number in range(count):
        source = good[number % len(good)]
        paths.append(folder / f"{number} {source.name}")
        paths[-1].write_bytes(damaged(source.read_bytes(), chance))
    verdicts = read_all(paths)
    kinds = Counter(verdict.partition(": ")[2].removeprefix(SAID)[:50] or verdict for verdict in verdicts)
    print(*(f"{number:5} {kind}" for kind, number in kinds.most_common(40)), sep="\n")
    assert 0 < kinds["heights"] < count


def odd_npy(folder):
    """NumPy files that are whole, but not heights: (path, words of the message)."""
    arrays = {
        "objects": (np.array([[1, None]], object), "cannot be read"),
        "complex": (np.ones(SHAPE, complex), "real numbers"),
        "text": (np.full(SHAPE, "x"), "real numbers"),
        "flags": (np.ones(SHAPE, bool), "real numbers"),
        "dates": (np.zeros(SHAPE, "datetime64[s]"), "real numbers"),
        "records": (np.zeros(SHAPE, [("a", float)]), "real numbers"),
        "scalar": (np.float64(3), "shape ()"),
        "flat": (np.ones(120), "shape (120,)"),
        "turned": (np.ones(SHAPE[::-1]), "holds 10 x 12 points"),
        "deep": (np.ones((*SHAPE, 1)), "shape (12, 10, 1)"),
        "empty": (np.ones((0, 10)), "shape (0, 10)"),
        "nan": (np.full(SHAPE, np.nan), "no point was measured"),
        "inf": (np.full(SHAPE, -np.inf, np.float16), "is -inf"),
    }
    for name, (array, words) in arrays.items():
        np.save(folder / f"{name}.npy", array)
        yield folder / f"{name}.npy", words


def odd_hdf5(folder):
    """HDF5 files that are whole, but not heights."""
    makers = {
        "nothing": (lambda file: None, "found: none"),
        "two": (lambda file: file.update({"a": np.ones(SHAPE), "b": np.ones(SHAPE)}), "found: a, b"),
        "text": (lambda file: file.create_dataset("height", data="high"), "say which dataset"),
        "strings": (lambda file: file.create_dataset("height", SHAPE, h5py.string_dtype()), "real numbers"),
        "records": (lambda file: file.create_dataset("height", SHAPE, [("a", float)]), "real numbers"),
        "null": (lambda file: file.create_dataset("height", data=h5py.Empty(float)), "say which dataset"),
        "shape": (lambda file: file.create_dataset("height", (3, 3), float), "holds 3 x 3 points"),
        "elsewhere": (lambda file: file.update({"height": h5py.ExternalLink("none.h5", "x")}), "found: none"),
        "loop": (lambda file: file.update({"height": h5py.SoftLink("/height")}), "found: none"),
        "virtual": (_virtual, ""),
    }
    for name, (make, words) in makers.items():
        with h5py.File(folder / f"{name}.h5", "w") as file:
            make(file)
        yield folder / f"{name}.h5", words


def _virtual(file):
    layout = h5py.VirtualLayout(SHAPE, float)
    layout[:] = h5py.VirtualSource("missing.h5", "x", SHAPE)
    file.create_virtual_dataset("height", layout)


def test_whole_files_that_are_no_heights(tmp_path):
    """Each is refused with what is wrong with it."""
    cases = [*odd_npy(tmp_path), *odd_hdf5(tmp_path)]
    for (path, words), verdict in zip(cases, read_all([path for path, _ in cases]), strict=True):
        assert words in verdict and (verdict.startswith(str(path)) or not words), f"{path.name}: {verdict}"


@pytest.mark.mpi
def test_things_that_are_no_files(comm, tmp_path):
    """A folder, a missing file, a device, an empty name: one line."""
    from pgfmd.grid.slab_grid import SlabGrid

    grid = SlabGrid(comm, SHAPE)
    for path in (tmp_path, tmp_path / "none.npy", "/dev/null", "", "nul\0.npy", "/proc/self/mem"):
        with pytest.raises(InputError) as caught:
            FromFile(path=str(path)).heights(grid, None)
        assert "\n" not in str(caught.value)


@pytest.mark.mpi
def test_no_folder_is_left(comm, shared_tmp_path):
    """A run whose heights cannot be read leaves no output folder behind, made or half-made."""
    from pgfmd.application import job as config
    from pgfmd.application.simulate import simulate

    path = shared_tmp_path / "cut é.npy"
    if comm.rank == 0:
        np.save(path, np.ones(SHAPE))
        path.write_bytes(path.read_bytes()[:-1])
    comm.Barrier()
    job = config.parse(
        SOLID + f'[grid]\nn = [12, 10]\n[surface]\nkind = "file"\npath = "{path}"\n[load]\npressure = 1\n'
    )  # fmt: skip
    with pytest.raises(InputError, match="truncated"):
        simulate(job, comm, shared_tmp_path / "out")
    comm.Barrier()  # rank 0 takes the folder away on its way out
    assert not (shared_tmp_path / "out").exists()


@pytest.mark.mpi
def test_symbolic_link_as_output_folder(comm, shared_tmp_path):
    """A link to a folder is written through; the link stays one."""
    from pgfmd.application import job as config
    from pgfmd.application.results import Results
    from pgfmd.application.simulate import simulate

    target, link = shared_tmp_path / "on the big disk", shared_tmp_path / "out"
    if comm.rank == 0:
        target.mkdir()
        link.symlink_to(target)
    comm.Barrier()
    job = config.parse(SOLID + '[grid]\nn = 16\n[surface]\nkind = "sinusoid"\namplitude = 1\n[load]\npressure = 0.01\n')
    simulate(job, comm, link)
    assert link.is_symlink() and Results(target).status == "complete"


pytest.importorskip("mpi4py")


def test_random_files(tmp_path):
    """300 of them: the heights that were written, to the rounding of their format, or one line."""
    verdicts, bad = campaign_heights.campaign(7, range(300), tmp_path)
    assert not bad, "\n".join(bad[:5])
    assert verdicts["right"] > 150 and verdicts["refused"] > 20


@pytest.mark.parametrize(
    "spoil", [np.transpose, lambda heights: heights * (1 + 1e-12), lambda heights: np.nan_to_num(heights) * 1e6]
)
def test_wrong_heights_are_seen(tmp_path, monkeypatch, spoil):
    """A reader that turns its heights, rounds them or mistakes their unit is called wrong."""
    read = FromFile.heights

    def spoilt(self, grid, unit):
        found = spoil(read(self, grid, unit))
        return found if found.shape == grid.shape else np.resize(found, grid.shape)

    monkeypatch.setattr(FromFile, "heights", spoilt)
    _, bad = campaign_heights.campaign(7, range(20), tmp_path)
    assert len(bad) > 5

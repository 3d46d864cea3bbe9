"""Random heights files of all kinds: the reader gives the heights that were written, or refuses in one line.

    python tools/bench/campaign_heights.py --files 5000 --seed 1
    python tools/bench/campaign_heights.py --seed 1 --only 17 --keep DIR     # that file alone, kept in DIR
"""

import argparse
import json
import tempfile
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.surfaces.file import FromFile

METRES = {"m": 1.0, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "nm": 1e-9, "Å": 1e-10, "micrometer": 1e-6}
KINDS = ("float64", "float32", "float16", "int16", "uint8", "int64", ">f8", "<f4", ">i2")


@dataclass
class File:
    """What was written: heights (nx, ny) as the job should see them, NaN where they are missing, or None if the file
    must be refused; keys of [surface], the job's length_unit, and the relative rounding of the format."""

    path: Path
    expected: np.ndarray | None
    keys: dict = field(default_factory=dict)
    unit: str | None = None
    rounding: float = 1e-15
    lengths: tuple[float, float] | None = None
    may_refuse: bool = False


def draw(seed: int, number: int, folder: Path) -> File:
    """Write the file of that number into the folder."""
    chance = np.random.default_rng([seed, number])
    shape = tuple(int(side) for side in chance.integers(2, 14, 2))
    heights = chance.standard_normal(shape) * 10.0 ** chance.uniform(-9, 3)
    way = chance.choice(["npy", "hdf5", "matrix", "points", "masked", "other"], p=[0.25, 0.25, 0.2, 0.2, 0.05, 0.05])
    made = MAKERS[str(way)](chance, heights, folder)
    if made.expected is not None and chance.random() < 0.2 and way != "points":
        made.keys["first_axis"] = "y"
        made.expected = made.expected.T
        made.lengths = made.lengths and made.lengths[::-1]
    if made.expected is not None:
        if np.isnan(made.expected).any() and chance.random() < 0.7:
            made.keys["missing"] = str(chance.choice(["interpolate", "refuse"]))
        if chance.random() < 0.2:
            made.keys["height_scale"] = float(chance.choice([-1.0, 2.0, 1e-3]))
    return made


def _npy(chance, heights, folder) -> File:
    dtype = np.dtype(str(chance.choice(KINDS)))
    values = heights if dtype.kind == "f" else np.rint(heights / np.abs(heights).max() * 100)
    values = np.abs(values) if dtype.kind == "u" else values
    with np.errstate(over="ignore", under="ignore"):
        values = values.astype(dtype)
    if chance.random() < 0.2:
        values = np.asfortranarray(values)
    if dtype.kind == "f" and chance.random() < 0.2:
        values[chance.integers(values.shape[0]), chance.integers(values.shape[1])] = chance.choice([np.nan, np.inf])
    path = folder / f"{chance.choice(['heights', 'ä b', 'x.y'])}.npy"
    np.save(path, values)
    return File(path, values.astype(float) if not np.isinf(values).any() else None)


def _hdf5(chance, heights, folder) -> File:
    made = _npy(chance, heights, folder)
    values = np.load(made.path)
    path = folder / f"a{chance.choice(['.h5', '.hdf5'])}"
    name = str(chance.choice(["height", "heights", "z", "scan/topography"]))
    unit, job_unit = None, None
    with h5py.File(path, "w") as file:
        options = {"chunks": True, "compression": "gzip"} if chance.random() < 0.3 else {}
        dataset = file.create_dataset(name, data=values, **options)
        if chance.random() < 0.5:
            unit = str(chance.choice(list(METRES)))
            dataset.attrs[str(chance.choice(["unit", "units"]))] = unit
            job_unit = str(chance.choice(["m", "µm", "nm"]))
        if chance.random() < 0.3:
            file["other"] = np.ones((3, 3))
        several = "other" in file and name not in ("height", "heights")
    keys = {"dataset": name} if chance.random() < 0.5 or several else {}
    expected = made.expected
    if several and not keys:
        expected = None
    if expected is not None and unit:
        expected = expected * (METRES[unit] / METRES[job_unit])
    return File(path, expected, keys, job_unit, 1e-14)


def _matrix(chance, heights, folder) -> File:
    if heights.shape[1] < 4:  # three columns are coordinates
        heights = np.hstack([heights, heights, heights])[:, :5]
    separator = str(chance.choice([" ", "\t", ",", ";"]))
    digits = int(chance.integers(4, 18))
    comma = separator in ";\t " and chance.random() < 0.15
    rows = [[f"{value:.{digits}e}" for value in row] for row in heights]
    expected = np.array([[float(entry) for entry in row] for row in rows])
    if chance.random() < 0.2:
        i, j = chance.integers(heights.shape[0]), chance.integers(1, heights.shape[1] - 1)
        rows[i][j], expected[i, j] = str(chance.choice(["nan", "NaN", "BAD"])), np.nan
    lines = [separator.join(row) for row in rows]
    text = "\n".join(lines) + "\n"
    text = text.replace(".", ",") if comma else text
    if chance.random() < 0.3:
        text = "# a surface\n" + text
    if chance.random() < 0.1:
        text = text.replace("\n", "\r\n")
    path = folder / f"a{chance.choice(['.txt', '.csv', '.asc', '.dat'])}"
    path.write_bytes((b"\xef\xbb\xbf" if chance.random() < 0.1 else b"") + text.encode())
    if chance.random() < 0.1:  # a line is cut
        path.write_text("\n".join([*lines[:-1], separator.join(rows[-1][:-1])]) + "\n")
        expected = None
    return File(path, expected, rounding=1e-15)


def _points(chance, heights, folder) -> File:
    steps = 10.0 ** chance.uniform(-6, 2) * chance.uniform(0.5, 2, 2)
    origin = chance.normal(size=2) * steps * 10
    i, j = np.indices(heights.shape)
    points = np.stack([origin[0] + steps[0] * i, origin[1] + steps[1] * j, heights], -1).reshape(-1, 3)
    expected = heights.copy()
    if chance.random() < 0.4:
        lost = chance.random(len(points)) < 0.1
        inner = expected.reshape(-1)
        inner[lost] = np.nan
        if chance.random() < 0.5:
            points[lost, 2] = np.nan
        else:
            points = points[~lost]
    if chance.random() < 0.5:
        points = chance.permutation(points)
    path = folder / f"a{chance.choice(['.xyz', '.txt', '.csv'])}"
    np.savetxt(path, points, delimiter=str(chance.choice([" ", ",", "\t"])), fmt="%.17g")
    lengths = tuple(float(n * a) for n, a in zip(heights.shape, steps, strict=True))
    fine = ~np.isnan(expected)
    whole = fine.any(1)[[0, -1]].all() and fine.any(0)[[0, -1]].all() and 2 * fine.sum() >= fine.size
    return File(path, expected, lengths=lengths, may_refuse=not whole)


def _masked(chance, heights, folder) -> File:
    """What np.ma.dump writes, a pickle, is no heights file; neither is an archive of arrays."""
    path = folder / str(chance.choice(["a.npz", "a.pkl", "a.npy"]))
    array = np.ma.masked_greater(heights, np.median(heights))
    if path.suffix == ".npz":
        np.savez(path, heights=heights)
    else:
        array.dump(path)
    return File(path, None)


def _other(chance, heights, folder) -> File:
    """Instruments' texts, which another package reads, or nothing at all."""
    path = folder / str(chance.choice(["a.sdf", "a.x3p", "a.tif", "a.txt"]))
    head = "aBCR-1.0\nManufacID = x\nNumPoints = 4\nNumProfiles = 4\nXscale = 1e-6\nYscale = 1e-6\nZscale = 1e-6\n*\n"
    body = {".sdf": head + "1 2 3 4\n" * 4 + "*\n", ".txt": "", ".tif": "II*\0", ".x3p": "PK\3\4"}[path.suffix]
    path.write_text(body)
    return File(path, None, may_refuse=True)


MAKERS = {"npy": _npy, "hdf5": _hdf5, "matrix": _matrix, "points": _points, "masked": _masked, "other": _other}


def too_many_holes(file: File) -> bool:
    """Whether the reader must refuse the missing points."""
    missing, asked = np.isnan(file.expected).mean(), file.keys.get("missing", "few")
    return bool(missing > {"few": 1 / 3, "refuse": 0, "interpolate": 1}[asked])


def judge(file: File) -> tuple[str, str]:
    """("right" | "refused" | "wrong" | "traceback", what the reader says or what is wrong)."""
    shape = (4, 4) if file.expected is None else file.expected.shape
    grid = SlabGrid(MPI.COMM_SELF, shape, file.lengths or tuple(map(float, shape)))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = FromFile(path=str(file.path), **file.keys).heights(grid, file.unit)
    except InputError as error:
        message = str(error)
        if not (message.isprintable() and len(message) < 1200):
            return "wrong", f"message {message!r}"
        right = file.expected is None or file.may_refuse or too_many_holes(file)
        return ("refused" if right else "wrong"), message
    except Exception:
        return "traceback", traceback.format_exc()
    finally:
        grid.free()
    if file.expected is None:
        return ("right" if file.may_refuse else "wrong"), "heights of a file that holds none"
    expected = file.expected * file.keys.get("height_scale", 1.0)
    known = ~np.isnan(expected)
    if too_many_holes(file):
        return "wrong", "missing points were accepted"
    apart = np.abs(found - expected)[known].max(initial=0)
    size = np.abs(expected[known]).max(initial=0)
    if apart > file.rounding * size:
        return "wrong", f"heights are {apart / size:.1e} off"
    if not (np.isfinite(found).all() and found.min() >= expected[known].min() - size):
        return "wrong", "interpolated heights are not between their neighbours"
    return "right", ""


def campaign(seed: int, numbers, folder: Path) -> tuple[Counter, list[str]]:
    """Verdicts of these files, and what went wrong."""
    verdicts, bad = Counter(), []
    for number in numbers:
        place = folder / str(number)
        place.mkdir()
        file = draw(seed, number, place)
        verdict, detail = judge(file)
        verdicts[verdict] += 1
        if verdict in ("wrong", "traceback"):
            keys = json.dumps(file.keys, ensure_ascii=False)
            bad.append(f"seed {seed}, file {number}, {file.path.name} {keys}: {verdict}: {detail}")
        for path in place.iterdir():
            path.unlink()
    return verdicts, bad


def main(arguments: list[str] | None = None) -> int:
    """The command line; 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="number of a single file")
    parser.add_argument("--keep", type=Path, help="folder in which that file is kept")
    options = parser.parse_args(arguments)
    if options.only is not None:
        folder = options.keep or Path(tempfile.mkdtemp(prefix="pgfmd-heights-"))
        folder.mkdir(exist_ok=True)
        file = draw(options.seed, options.only, folder)
        print(file, *judge(file), sep="\n")
        return 0
    with tempfile.TemporaryDirectory(prefix="pgfmd-heights-") as folder:
        verdicts, bad = campaign(options.seed, range(options.files), Path(folder))
    print(*bad, sep="\n")
    print(f"seed {options.seed}: {options.files} files: {dict(verdicts)}")
    return int(bool(bad))


if __name__ == "__main__":
    raise SystemExit(main())

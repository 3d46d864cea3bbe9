"""The reference set as NetCDF, for programs that read no CSV: python tools/release/netcdf.py FOLDER

Writes reference.nc from the table in the package, the only copy; each variable has its unit and its meaning, which
jobs/reference/reference.json gives.
"""

import csv
import json
import sys
from pathlib import Path

import h5netcdf
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
ENDINGS = ("_error", "_scatter")


def write(folder: Path) -> Path:
    """Write FOLDER/reference.nc; its path."""
    about = json.loads((ROOT / "jobs/reference/reference.json").read_text(encoding="utf-8"))
    with open(ROOT / "pgfmd/theory/reference.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "reference.nc"
    with h5netcdf.File(path, "w") as out:
        out.dimensions = {"row": len(rows)}
        out.attrs["title"] = "Contacts of self-affine surfaces: the reference set of pgfmd"
        out.attrs["Conventions"] = "CF-1.11"
        out.attrs["comment"] = (
            f"rms slope g = {about['slope']:g}, {about['lambda_s']:g} points on the shortest wave; E' is the contact "
            f"modulus. SHA-256 of the table: {about['sha256']}"
        )
        for name in rows[0]:
            kind = "i8" if name == "seeds" else "f8"
            variable = out.create_variable(name, ("row",), kind, data=np.array([row[name] for row in rows], kind))
            variable.attrs["units"] = "1"
            variable.attrs["long_name"] = meaning(name, about["columns"])
    return path


def meaning(name: str, columns: dict[str, str]) -> str:
    """What a column is; of an error, of which column it is one."""
    ending = next((each for each in ENDINGS if name.endswith(each)), "")
    return f"{columns[name.removesuffix(ending)]}: {columns[ending]}" if ending else columns[name]


if __name__ == "__main__":
    print(write(Path(*sys.argv[1:])))

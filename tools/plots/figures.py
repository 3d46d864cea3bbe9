"""The table of figures and the command that draws one: `pgfmd plot`.

A figure is a file tools/plots/NAME.py with
    a docstring        what it shows; its first line stands in the list
    CAPTION            the text below the figure, for readers who do not know the paper
    NEEDS              what a load must have, names of `choosing.NEEDS`; other loads are left out, with a note
    OPTIONS            (may be missing) options of the command line: "--name" → keywords of argparse's add_argument
    draw(loads, **)    draws the loads, a list of `reading.Load`; returns a `plotting.Sheet`
and a line in FIGURES.  tools/README.md goes through an example.
"""

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from pgfmd.errors import InputError
from pgfmd.options.text import printable

FIGURES = (
    "overview",
    "area_load",
    "pressure_distribution",
    "autocorrelations",
    "stress_contact_spectra",
    "bearing_area",
    "exponents",
    "persson_spectrum",
    "field_theory",
    "contact_patches",
    "resolution",
    "dependence",
    "energy_by_scale",
    "correlation_decay",
    "force_approach",
    "contact_stiffness",
    "percolation",
    "leakage",
    "partial_slip",
    "subsurface",
)


def module(figure: str) -> ModuleType:
    """The module of a figure.  Raises InputError if there is no such figure."""
    if figure not in FIGURES:
        raise InputError(f"{figure!r}: neither a folder nor a figure; figures are {', '.join(FIGURES)}")
    return importlib.import_module(figure)


def draw(figure: str, folders: Sequence[Path | str], targets: Sequence[float] = (), **options):
    """The figure of the loads in result folders that have what it needs: a `plotting.Sheet`.

    targets : only the loads at which the job imposed one of these values (pressure, area, …)
    Raises InputError if none is left, or the options do not fit.
    """
    import choosing
    import reading

    drawn = module(figure)
    found, left_out = choosing.suitable(choosing.imposed(reading.loads(folders), targets), drawn.NEEDS, figure)
    sheet = drawn.draw(found, **options)
    sheet.notes[:0] = left_out + [note for folder in folders if (note := _seeds(folder))]
    return sheet


def _seeds(folder: Path | str) -> str:
    """How many seeds of an ensemble the means are over, and of which loads there are fewer; "" for one surface."""
    from pgfmd.application import ensemble

    if not ensemble.is_ensemble(folder):
        return ""
    found = ensemble.Ensemble(folder)
    counts, asked = ensemble.solved_runs(found.runs).tolist(), len(found.seeds)
    listed = ", ".join(f"load {index}: {count}" for index, count in enumerate(counts) if count < asked)
    if not listed:
        return f"{folder}: {asked} seeds"
    return f"{folder}: not all of {asked} seeds have solved each load, which biases the means ({listed})"


def listing() -> str:
    """The list of figures, and what each needs."""
    import choosing

    lines = ["pgfmd plot [FIGURE] DIR… [--output FOLDER]   draws one of these (FIGURE --help: its options):", ""]
    for figure in FIGURES:
        drawn = module(figure)
        needs = "; ".join(choosing.NEEDS[need][1] for need in drawn.NEEDS)
        lines += [f"{figure:<24}{drawn.__doc__.splitlines()[0]}", f"{'':<24}needs {needs or 'no observable'}"]
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """The command line after `pgfmd plot`; exit code 0, or 2 for wrong input, with one line on stderr."""
    try:
        print(plot(arguments))
    except InputError as error:
        print(f"pgfmd: error: {printable(' '.join(str(error).split()), 1000)}", file=sys.stderr)
        return 2
    return 0


class _Parser(argparse.ArgumentParser):
    def error(self, message: str):
        raise InputError(f"{message} (see {self.prog} --help)")


def plot(arguments: Sequence[str]) -> str:
    """Draw and save the figure that the arguments name; what to print.  Raises InputError."""
    if not arguments:
        return listing()
    figure, *rest = arguments
    if figure in ("-h", "--help"):
        return listing()
    if figure not in FIGURES and Path(figure).is_dir():  # no figure is named
        figure, rest = FIGURES[0], list(arguments)
    drawn = module(figure)
    parser = _Parser(prog=f"pgfmd plot {figure}", description=drawn.__doc__, allow_abbrev=False,
                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("results", nargs="+", type=Path, metavar="DIR", help="result folders")
    parser.add_argument("--output", type=Path, metavar="FOLDER",
                        help="folder of the pictures (default: figures/ in the first result folder)")  # fmt: skip
    parser.add_argument("--targets", nargs="+", type=float, default=(), metavar="VALUE",
                        help="only the loads at which the job imposed these pressures, areas, …")  # fmt: skip
    for name, keywords in getattr(drawn, "OPTIONS", {}).items():
        parser.add_argument(name, default=argparse.SUPPRESS, **keywords)
    options = vars(parser.parse_args(rest))
    folders, output = options.pop("results"), options.pop("output")
    sheet = draw(figure, folders, **options)
    output = output or folders[0] / "figures"
    try:
        pages = [path for path in sheet.save(output, figure) if path.suffix == ".html"]
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}") from None
    width = max(map(len, sheet.findings), default=0)
    lines = [f"{name:<{width}}  {sheet.findings.text(name)}" for name in sheet.findings]
    lines += [*(f"note: {note}" for note in sheet.notes), f"pictures and tables: {output}"]
    lines += [f"page for a browser: {path}" for path in pages]
    return "\n".join(printable(line, 1000) for line in lines)

"""The command line: `python -m pgfmd COMMAND …`, under `mpirun -n P python -m mpi4py` for `run`.

Exit codes: 0; 2 for wrong input, with one line on stderr; 3 if a solver cannot certify its answer, or no load gives
what was asked for; 75 (EX_TEMPFAIL) if the run was asked to stop, and can be continued by --restart; 130 if it was
interrupted twice, or before there was anything to save; 1 for anything else.
"""

import argparse
import atexit
import contextlib
import gc
import importlib
import io
import json
import logging
import os
import sys
import traceback
import warnings
from pathlib import Path
from typing import NoReturn

from pgfmd import __version__
from pgfmd.errors import InputError, NoProgress, SolverError, Stopped
from pgfmd.options.text import printable, readable, reason
from pgfmd.parallel.mpi import MPI, launched_rank, patiently, world

INTERRUPTED = 130
REPAIR = "; remove a damaged file of fields, and a run with --restart writes it again"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code.  `run` is collective over COMM_WORLD, the others need no MPI."""
    for stream in (sys.stdout, sys.stderr):  # a terminal without × shows ?
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        words = sys.argv[1:] if arguments is None else arguments
        if words[:1] == ["plot"]:  # each figure has options of its own
            _show(_plot(words[1:]))
            return 0
        options = _parser().parse_args(words)
        if options.command == "run":
            return _run(options)
        commands = {"new": _new, "check": _check, "info": _info, "certify": _certify, "export": _export}
        commands |= {"compare": _compare, "cite": _cite}
        _show(commands[options.command](options))
        return 0
    except KeyboardInterrupt as error:
        return _complain(error) if launched_rank() == 0 else INTERRUPTED
    except BrokenPipeError:  # the reader, such as `head`, has closed the pipe
        sys.stdout = open(os.devnull, "w")
        return 0
    except (InputError, SolverError, OSError) as error:
        return _complain(error) if launched_rank() == 0 else _code(error)


def _show(text: str) -> None:
    """Print lines, without the control characters that texts from files may hold."""
    print("\n".join(printable(line, len(line)) for line in text.split("\n")))


class _Parser(argparse.ArgumentParser):
    """An argument parser that raises InputError with one line, as for any wrong input."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="pgfmd", description="Elastic contact of randomly rough surfaces.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"pgfmd {__version__}")
    names = "new | run | check | info | plot | compare | export | certify | cite"
    commands = parser.add_subparsers(dest="command", required=True, metavar=names)

    new = commands.add_parser("new", help="print a commented job to start from", allow_abbrev=False)
    new.add_argument("kinds", nargs="*", metavar="KIND", help='of surface or wall; "all": every key of every kind')
    new.add_argument("--schema", action="store_true", help="the JSON Schema of a job, for editors")
    new.add_argument("--heights", metavar="FILE", help="a job on this file of heights")

    run = commands.add_parser("run", help="run a job, under mpirun or as one process", allow_abbrev=False)
    run.add_argument("job", metavar="JOB.toml")
    run.add_argument("--output", required=True, type=_folder, metavar="DIR", help="folder of the result files")
    existing = run.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace the results in DIR")
    existing.add_argument("--restart", action="store_true", help="continue the run in DIR where it was broken off")

    check = commands.add_parser("check", help="validate a job; estimate memory, files and time", allow_abbrev=False)
    check.add_argument("job", metavar="JOB.toml")
    check.add_argument("--ranks", type=_count, default=1, metavar="P", help="MPI ranks to estimate for")
    check.add_argument("--ranks-per-node", type=_count, metavar="K", help="how many of them on a node; default: all")

    certify = commands.add_parser("certify", help="bound the error of a pressure from any program", allow_abbrev=False)
    certify.add_argument("heights", metavar="HEIGHTS", help="their file (FILE.h5:dataset), or a job or result folder")
    certify.add_argument("pressure", metavar="PRESSURE", help="a file of the same points, or a result folder (DIR:2)")
    certify.add_argument("--mean-pressure", type=float, metavar="P", help="to scale the pressure to; default: its own")
    certify.add_argument("--json", action="store_true", help="the numbers as JSON")
    for command in (run, check, certify):
        command.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="section.key=value",
            help="change the job; the value as in TOML, quotes around a single text may be left out; paths count from "
            "the working directory, not from the job's folder (repeatable)",
        )

    info = commands.add_parser("info", help="what was run, and the table of loads", allow_abbrev=False)
    info.add_argument("directory", metavar="DIR")
    how = info.add_mutually_exclusive_group()
    how.add_argument("--verify", action="store_true", help="read every file, and say which are damaged")
    how.add_argument("--csv", action="store_true", help="the table of loads in full precision, separated by commas")
    how.add_argument("--json", action="store_true", help="the job, where it ran, and the table of loads")
    export = commands.add_parser("export", help="results as NetCDF, heights as .x3p", allow_abbrev=False)
    export.add_argument("directory", metavar="DIR")
    export.add_argument("--output", type=_folder, metavar="FOLDER", help="of the files; default: DIR/export")
    export.add_argument("--format", choices=("nc", "x3p"), default="nc", help="a .nc for each load, or heights as .x3p")
    compare = commands.add_parser("compare", help="differences between runs, beside their errors", allow_abbrev=False)
    compare.add_argument("directories", nargs="+", metavar="DIR", help="each other one less the first")
    how = compare.add_mutually_exclusive_group()
    how.add_argument("--csv", action="store_true", help="in full precision, separated by commas")
    how.add_argument("--json", action="store_true", help="the same as JSON")
    cite = commands.add_parser("cite", help="what to cite for a run, as BibTeX", allow_abbrev=False)
    cite.add_argument("directory", metavar="DIR")
    commands.add_parser("plot", help="draw a figure of result folders; without arguments: the list of figures")
    return parser


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number ≥ 1")
    return int(text)


def _folder(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("must name a folder")
    return text


def _new(options: argparse.Namespace) -> str:
    if options.heights:
        from pgfmd.application.one_process import job_on_file

        return job_on_file(options.heights)
    from pgfmd.application.job import SECTIONS
    from pgfmd.options.key_reference import example, json_schema, reference

    tables = SECTIONS.values()
    if options.schema:
        return json_schema(tables)
    return reference(tables) if options.kinds == ["all"] else example(tables, *options.kinds)


def _check(options: argparse.Namespace) -> str:
    from pgfmd.application.estimate import explored
    from pgfmd.application.job import load
    from pgfmd.application.machine import largest_memory
    from pgfmd.application.one_process import doubts

    job = load(options.job, options.set)
    nx, surfaces = job.grid.n[0], max(1, len(job.surface.seeds))
    if options.ranks > nx * surfaces:
        each = f", of each of {surfaces} surfaces" * (surfaces > 1)
        raise InputError(f"--ranks {options.ranks}: more ranks than the {nx} rows of the grid{each}")
    here = largest_memory()
    plan = explored(job)
    size = plan.estimate(options.ranks, here / options.ranks, options.ranks_per_node).node
    limit = "" if size <= here else f", but too large for this machine, which has {readable(here)}"
    report = plan.report(options.ranks, options.ranks_per_node)  # opens the files that the job names
    against = "".join(f"\n{line}" for line in job.doubts + doubts(job))
    return f"{options.job}: valid{limit}{against}\n{report}"


def _info(options: argparse.Namespace) -> str:
    from pgfmd.application import ensemble, info
    from pgfmd.application.results import Results, Runs

    several = ensemble.is_ensemble(options.directory)
    runs = [Results(folder) for folder in ensemble.folders(options.directory)]
    if options.csv:
        return info.as_csv(Runs(runs) if several else runs[0])
    if options.json:
        return f"[{', '.join(map(info.as_json, runs))}]" if several else info.as_json(runs[0])
    if not options.verify:
        return info.summary_of_ensemble(ensemble.Ensemble(options.directory)) if several else info.summary(runs[0])
    faults = {path: fault for run in runs for path, fault in info.damage(run).items()}
    if faults:
        raise InputError("; ".join(f"{path}: {fault}" for path, fault in faults.items()) + REPAIR)
    return f"{options.directory}: every byte of the tables and every row of the fields is as it was written"


def _export(options: argparse.Namespace) -> str:
    from pgfmd.application import ensemble
    from pgfmd.application.export import export
    from pgfmd.application.results import Results

    top = Path(options.output or Path(options.directory) / "export")
    several = ensemble.is_ensemble(options.directory)
    written = []
    for folder in ensemble.folders(options.directory):
        written += export(Results(folder), top / folder.name if several else top, options.format)
    return "\n".join(map(str, written))


def _compare(options: argparse.Namespace) -> str:
    from pgfmd.application import compare

    rows, notes = compare.compare(options.directories)
    if options.csv:
        return compare.as_csv(rows)
    return compare.as_json(rows, notes) if options.json else compare.as_text(rows, notes, options.directories[0])


def _cite(options: argparse.Namespace) -> str:
    from pgfmd.application import ensemble
    from pgfmd.application.info import bibtex
    from pgfmd.application.results import Results

    runs = ensemble.folders(options.directory)
    if not runs:
        raise InputError(f"{options.directory}: no seed has results")
    return bibtex(Results(runs[0]))


def _certify(options: argparse.Namespace) -> str:
    from pgfmd.application.info import known
    from pgfmd.application.one_process import certify_file, job_on, line

    job, mean = job_on(options.heights, options.set), options.mean_pressure
    if mean is not None and not 0 < mean < float("inf"):
        raise InputError(f"--mean-pressure {mean:g}: must be positive and finite")
    contact = certify_file(job, options.pressure, mean)
    if options.json:  # null for what is not known
        return json.dumps(known(contact.summary()), indent=2)
    return f"{options.pressure}: {line(contact)}"


def _plot(words: list[str]) -> str:
    """Draw a figure; returns what to print.  The figures are in pgfmd_plots/ or tools/plots/, next to the package."""
    here = Path(__file__).resolve().parents[2]
    folders = [here / name for name in ("pgfmd_plots", "tools/plots") if (here / name / "figures.py").is_file()]
    if not folders:
        raise InputError("plot: the figures are not installed; they are the folder tools/plots/ of a checkout of pgfmd")
    sys.path.insert(0, str(folders[0]))
    try:
        return importlib.import_module("figures").plot(words)
    except ImportError as error:
        raise InputError(f"plot: {error}; figures need matplotlib: pip install 'pgfmd[plot]'") from None


def _run(options: argparse.Namespace) -> int:
    """Run a job; returns the exit code.  Collective."""
    atexit.register(gc.freeze)  # no garbage collection at exit: it takes a tenth of a second with numba loaded
    gc.disable()  # nor during imports: it takes a tenth of their time
    comm = world()
    end_comm = comm.Dup()  # made now: a rank that has failed may never join a collective call on `comm`
    _log_on_root(comm.rank)
    try:
        from pgfmd.application.job import load
        from pgfmd.application.simulate import run_job
        from pgfmd.parallel.collectives import by_node, from_root

        gc.enable()
        comm = by_node(comm)
        job = from_root(comm, load, options.job, options.set)
        run_job(job, comm, options.output, overwrite=options.overwrite, restart=options.restart)
    except (Exception, KeyboardInterrupt) as error:  # any error must end all ranks, and one of them must report it
        return _end_all_ranks(end_comm, error)
    return 0


def _end_all_ranks(comm: MPI.Comm, error: BaseException) -> int:
    """End all ranks with the error's exit code; rank 0 prints it.  Aborts if other ranks do not fail.  Collective."""
    if vars(error).get("ranks") == 0 or not patiently(comm, comm.Ibarrier().Test):  # 0: no other rank has the error
        _complain(error)
        comm.Abort(_code(error))
    if comm.rank == 0:
        _complain(error)
    comm.Barrier()  # a rank that left before rank 0 has printed would make mpirun end the others
    if comm.size > 1:
        MPI.Finalize()  # while MPI is active, `python -m mpi4py` aborts on an exit code other than 0
    return _code(error)


def _code(error: BaseException) -> int:
    codes = {InputError: 2, SolverError: 3, Stopped: 75, KeyboardInterrupt: INTERRUPTED}
    return next((code for kind, code in codes.items() if isinstance(error, kind)), 1)


def _complain(error: BaseException) -> int:
    """Print the error in one line, after its traceback if it is not meant for users; returns the exit code."""
    message = reason(error)
    if isinstance(error, KeyboardInterrupt):
        message = "interrupted"
    elif isinstance(error, MemoryError):
        message = f"the memory does not suffice; take more nodes, or a smaller grid ({message})"
    elif not isinstance(error, (InputError, SolverError, Stopped, NoProgress, OSError)):
        traceback.print_exception(error)
    kind = "" if isinstance(error, (Stopped, KeyboardInterrupt)) else "error: "
    with contextlib.suppress(OSError):  # the terminal may have been closed
        # One write, not the two of `print`, between which mpirun may put its own words.
        sys.stderr.write(f"pgfmd: {kind}{printable(message, 4000)}\n")
        sys.stderr.flush()
    return _code(error)


def _log_on_root(rank: int) -> None:
    """Log messages and library warnings of rank 0 to stderr, with the time; the other ranks log nothing."""
    from pgfmd.application.progress import STEP, updates

    warnings.showwarning = lambda message, kind, *_: log.warning("%s: %s", kind.__name__, message)
    log = logging.getLogger("pgfmd")
    log.setLevel(STEP if rank == 0 else logging.CRITICAL + 1)
    log.propagate = False
    if not log.handlers:
        handler = _Terminal()
        handler.setLevel(logging.INFO if updates() else STEP)
        handler.setFormatter(logging.Formatter("%(asctime)s  %(message)s", "%H:%M:%S"))
        log.addHandler(handler)


class _Terminal(logging.StreamHandler):
    """Prints lines to stderr, above a progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        from tqdm import tqdm

        try:
            tqdm.write(self.format(record), file=sys.stderr)
        except Exception:  # as in logging: the run goes on
            self.handleError(record)

"""Where a result comes from: version, commit, command, libraries, ranks, threads, date."""

from __future__ import annotations

import functools
import json
import platform
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from datetime import datetime
from importlib import metadata
from pathlib import Path

from pgfmd import __version__
from pgfmd.application.files import FORMAT_VERSION
from pgfmd.parallel.threads import threads_per_rank

LIBRARIES = ("numpy", "scipy", "numba", "pyfftw", "mpi4py", "mpi4py-fft", "h5py")


def command_line() -> str:
    """The command that started this process, quoted for a shell."""
    return shlex.join(sys.orig_argv)


@functools.cache
def git_commit() -> str:
    """The commit of the checkout that the package lies in, with "+" if it was changed since; else "unknown"."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) != root:
            return "unknown"
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def now() -> str:
    """The time in ISO 8601, to the second, with the zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


@functools.cache
def versions() -> str:
    """Versions of Python and of the libraries, one per line: "name version"."""
    lines = [f"python {platform.python_version()}"]
    for name in LIBRARIES:
        try:
            lines.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return "\n".join(lines)


@dataclass(frozen=True)
class Origin:
    """What a run was asked for: the TOML text, the effective job, the number of its loads, digests of the files that it
    names, and the command (None: that of this process).
    """

    job_toml: str = ""
    effective_toml: str = ""
    loads: int = 0
    inputs: dict[str, str] = field(default_factory=dict)
    command: str | None = None


def gather(ranks: int, extra_versions: dict[str, str], origin: Origin) -> dict[str, str | int]:
    """Everything as attributes of a result file's root."""
    extra = "".join(f"\n{name} {version}" for name, version in extra_versions.items())
    return {
        "software": "pgfmd",
        "softwareVersion": __version__,
        "format_version": FORMAT_VERSION,
        "commit": git_commit(),
        "command": command_line() if origin.command is None else origin.command,
        "job_toml": origin.job_toml,
        "effective_toml": origin.effective_toml,
        "inputs": json.dumps(origin.inputs),
        "libraries": versions() + extra,
        "ranks": ranks,
        "threads": threads_per_rank(),
        "host": platform.node(),
        "date": now(),
    }

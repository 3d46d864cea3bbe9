"""Where a result comes from: version, commit, command, libraries, ranks, threads, date."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from datetime import datetime
from importlib import metadata
from pathlib import Path

from pgfmd import __version__
from pgfmd.io.schema import FORMAT_VERSION

LIBRARIES = ("numpy", "scipy", "numba", "pyfftw", "mpi4py", "mpi4py-fft", "h5py")


def command_line() -> str:
    """The command that started this process, quoted for a shell."""
    return shlex.join(sys.orig_argv)


def threads() -> int:
    """Threads per rank: OMP_NUM_THREADS, or else the cores that this process may use."""
    asked = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    return int(asked) if asked.isdigit() and int(asked) > 0 else len(os.sched_getaffinity(0))


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


def versions() -> str:
    """Versions of Python and of the libraries, one per line: "name version"."""
    found = [f"python {platform.python_version()}"]
    for name in LIBRARIES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return "\n".join(found)


def gather(ranks: int, extra_versions: dict[str, str], job_toml: str, effective_toml: str, command: str | None) -> dict:
    """Everything as attributes (str and int) of a result file's root."""
    extra = "".join(f"\n{name} {version}" for name, version in extra_versions.items())
    return {
        "software": "pgfmd",
        "softwareVersion": __version__,
        "format_version": FORMAT_VERSION,
        "commit": git_commit(),
        "command": command_line() if command is None else command,
        "job_toml": job_toml,
        "effective_toml": effective_toml,
        "libraries": versions() + extra,
        "ranks": ranks,
        "threads": threads(),
        "host": platform.node(),
        "date": now(),
    }

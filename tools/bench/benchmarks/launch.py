"""A module of this folder in processes of its own, on so many ranks and threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]


def launch(module: str, arguments: list[str], ranks: int, threads: int) -> subprocess.Popen:
    """Start `python -m benchmarks.<module> arguments`; its output goes to pipes, as text."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, str(threads))
    folders = [str(ROOT / "tools" / "bench"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(folders)
    command = [sys.executable, "-m", "mpi4py", "-m", f"benchmarks.{module}", *arguments]
    if ranks > 1:
        command = ["mpirun", "-n", str(ranks), *command]
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )

"""The memory of this machine, and numbers of bytes in words.  No MPI here."""

from __future__ import annotations

import os

CGROUPS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def available_memory() -> float:
    """Bytes that this process can still get: what the system says is available, or its control group allows."""
    return min([_physical(), *_meminfo("MemAvailable"), *(limit - used for limit, used in _control_groups())])


def largest_memory() -> float:
    """Bytes that this machine has, swap included, or that its control group allows: nobody can get more."""
    return min([_physical() + sum(_meminfo("SwapTotal")), *(limit for limit, _ in _control_groups())])


def readable(size: float) -> str:
    """A number of bytes with a decimal prefix."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if size < 1000:
            return f"{float(f'{size:.3g}'):g} {unit}"
        size /= 1000
    return f"{size:.3g} PB"


def _physical() -> float:
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def _meminfo(name: str) -> list[float]:
    return [1024.0 * int(line.split()[1]) for line in _lines("/proc/meminfo") if line.startswith(f"{name}:")]


def _control_groups() -> list[tuple[float, float]]:
    """(limit, used) of those that say both."""
    found = [[line.strip() for name in names for line in _lines(name)] for names in CGROUPS]
    return [(float(pair[0]), float(pair[1])) for pair in found if len(pair) == 2 and all(map(str.isdigit, pair))]


def _lines(name: str) -> list[str]:
    try:
        with open(name) as file:
            return file.readlines()
    except OSError:
        return []

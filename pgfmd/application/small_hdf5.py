"""Small HDF5 files, changed in memory and replaced as a whole."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import h5py

from pgfmd.application import atomic
from pgfmd.application.files import LIBVER

Change = Callable[[h5py.File], None]
"""Adds to or changes an open file."""


def revise(path: Path, change: Change, blank: bytes = b"", **options: bool) -> None:
    """Let `change` modify a small, sealed HDF5 file, or fill a new one that begins as `blank`.

    options: `keep`, `anew` and `sync` of `atomic.revise`.  Raises OSError; the old file stays then.
    """

    def modify(content: io.BytesIO) -> None:
        if not content.getbuffer().nbytes:
            content.write(blank)
        with h5py.File(content, "r+" if content.getbuffer().nbytes else "w", libver=LIBVER) as file:
            change(file)

    atomic.revise(path, modify, **options)

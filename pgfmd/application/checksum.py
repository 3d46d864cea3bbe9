"""Seals: checksums of all bytes of a file, at its end, so that a damaged file is recognised.

    content | description of the content (JSON) | length of the description, its digest | magic word

Readers of HDF5 take no notice of bytes behind the end that the superblock names.  The description has the length of the
content, the place of each array in it with one checksum for every 16 MiB of its rows, and a digest of all other bytes.
The checksum of a block of rows is the sum of (2 i + 1) CRC32(row i), modulo 2⁶⁴: it can be added up by ranks that hold
different rows, from memory, while the rows are written, so that no file is read again.  It changes if one row changes
(its weight is odd) and if two rows change places.  Digests: BLAKE2b (RFC 7693).  No HDF5 and no MPI here.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

BLOCK = 2**24  # bytes of an array with one checksum
DIGEST = 16
ANY_MAGIC, MAGIC = b"pgfmd seal ", b"pgfmd seal 2\r\n\x1a\n"
_LENGTH = struct.Struct("<Q")
_FOOTER = _LENGTH.size + DIGEST + len(MAGIC)


@dataclass(frozen=True)
class SealedArray:
    """An array of `rows` rows of `row_bytes` bytes in a file, from byte `start`; `sums`: one for each block of rows."""

    start: int
    row_bytes: int
    rows: int
    block: int
    sums: list[int] = field(default_factory=list)

    @property
    def stop(self) -> int:
        """The first byte behind it."""
        return self.start + self.rows * self.row_bytes

    def blank_sums(self) -> np.ndarray:
        """A zero for each block, to add to."""
        return np.zeros(-(-self.rows // self.block), np.uint64)

    def add(self, sums: np.ndarray, first: int, rows: np.ndarray) -> None:
        """Add the contiguous `rows`, as they are in the file from row `first` on, to the sums of their blocks."""
        data = rows.reshape(len(rows), -1).view(np.uint8).data.cast("B")
        for number, row in enumerate(range(first, first + len(rows))):
            crc = zlib.crc32(data[number * self.row_bytes : (number + 1) * self.row_bytes])
            sums[row // self.block] = (int(sums[row // self.block]) + (2 * row + 1) * crc) % 2**64

    def difference(self, sums: np.ndarray) -> str | None:
        """Which bytes of the file are not those that were written, from sums taken anew; None if all are."""
        for number, (found, expected) in enumerate(zip(map(int, sums), self.sums, strict=True)):
            if found != expected:
                first = self.start + number * self.block * self.row_bytes
                last = min(first + self.block * self.row_bytes, self.stop) - 1
                return f"its bytes {first} to {last} are not those that were written"
        return None


def array_at(start: int, row_bytes: int, rows: int) -> SealedArray:
    """An array in a file, its blocks chosen, without sums."""
    return SealedArray(start, row_bytes, rows, max(1, BLOCK // row_bytes))


@dataclass(frozen=True)
class Seal:
    """What a seal says of a file: length of its content, its arrays by name, digest of the bytes outside of them."""

    size: int
    arrays: dict[str, SealedArray]
    rest: str


def sealed(content: bytes | memoryview) -> bytes:
    """The content of a small file with its seal."""
    return b"".join([content, _tail(Seal(len(content), {}, _hex(content)))])


def unsealed(data: bytes, strict: bool = True) -> bytes:
    """The content of a small sealed file; raises OSError if it is damaged or has no seal (unless not `strict`)."""
    if not strict and ANY_MAGIC not in data[-len(MAGIC) :]:
        return data
    seal, fault = _parse(data, len(data))
    if seal is not None and seal.rest != _hex(data[: seal.size]):
        fault = "its bytes are not those that were written"
    if seal is None or fault is not None:
        raise OSError(fault)
    return data[: seal.size]


def is_sealed(path: Path) -> bool:
    """Whether a file ends as those written by this program, in any version, do."""
    try:
        with open(path, "rb") as file:
            file.seek(-min(len(MAGIC), os.path.getsize(path)), os.SEEK_END)
            return file.read().startswith(ANY_MAGIC)
    except OSError:
        return False


def add_seal(path: Path, arrays: dict[str, SealedArray]) -> None:
    """Append the seal to a finished file with these arrays.  Reads the bytes outside of them; raises OSError."""
    size = os.path.getsize(path)
    with open(path, "r+b") as file:
        rest = _rest(file, size, arrays)
        file.seek(size)
        file.write(_tail(Seal(size, arrays, rest)))


def read_seal(path: Path) -> tuple[Seal | None, str | None]:
    """(seal, None) or, if the seal, the length or a byte outside of arrays is wrong, (None, what is wrong).  Arrays are
    not read.
    """
    total = os.path.getsize(path)
    with open(path, "rb") as file:
        file.seek(total - min(total, _FOOTER))
        footer = file.read()
        length = _description_length(footer)
        file.seek(total - min(total, _FOOTER + length))
        seal, fault = _parse(file.read(), total)
        if seal is not None and _rest(file, seal.size, seal.arrays) != seal.rest:
            return None, "bytes outside the fields are not those that were written"
    return seal, fault


def damage(path: Path) -> str | None:
    """What is wrong with a sealed file, in words; None if every byte is the one that was written.  Reads all of it."""
    seal, fault = read_seal(path)
    if seal is None:
        return fault
    with open(path, "rb") as file:
        for array in seal.arrays.values():
            sums = array.blank_sums()
            file.seek(array.start)
            for first in range(0, array.rows, array.block):
                count = min(array.block, array.rows - first)
                data = np.frombuffer(file.read(count * array.row_bytes), np.uint8)
                array.add(sums, first, data.reshape(count, array.row_bytes))
            if (fault := array.difference(sums)) is not None:
                return fault
    return None


def _tail(seal: Seal) -> bytes:
    body = json.dumps(dataclasses.asdict(seal)).encode()
    return body + _LENGTH.pack(len(body)) + _digest(body) + MAGIC


def _description_length(footer: bytes) -> int:
    return _LENGTH.unpack_from(footer)[0] if len(footer) == _FOOTER and footer.endswith(MAGIC) else 0


def _parse(end: bytes, total: int) -> tuple[Seal | None, str | None]:
    """The seal in the last bytes of a file of `total` bytes, or what is wrong with it."""
    footer = end[-_FOOTER:]
    if not footer.endswith(MAGIC):
        other = footer[-len(MAGIC) :].startswith(ANY_MAGIC)
        return None, "it was sealed by another version" if other else "it has no seal, or was cut short"
    length = _description_length(footer)
    body = end[-_FOOTER - length : -_FOOTER] if length <= len(end) - _FOOTER else b""
    if _digest(body) != footer[_LENGTH.size : -len(MAGIC)]:
        return None, "its seal is broken"
    found = json.loads(body)
    seal = Seal(found["size"], {name: SealedArray(**array) for name, array in found["arrays"].items()}, found["rest"])
    if seal.size + length + _FOOTER != total:
        return None, "its length is not that which was written"
    return seal, None


def _gaps(size: int, arrays: dict[str, SealedArray]) -> Iterator[tuple[int, int]]:
    """Start and stop of the bytes outside of arrays."""
    at = 0
    for array in sorted(arrays.values(), key=lambda array: array.start):
        yield at, array.start
        at = array.stop
    yield at, size


def _rest(file: BinaryIO, size: int, arrays: dict[str, SealedArray]) -> str:
    """Digest of the bytes of the content outside of arrays."""
    digest = hashlib.blake2b(digest_size=DIGEST)
    for start, stop in _gaps(size, arrays):
        file.seek(start)
        digest.update(file.read(max(0, stop - start)))
    return digest.hexdigest()


def _hex(data: bytes | memoryview) -> str:
    return hashlib.blake2b(data, digest_size=DIGEST).hexdigest()


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=DIGEST).digest()

"""Seals: checksums of every byte of a file, at its end, so that a damaged file is recognised.

    content | 16-byte digest of each 16 MiB of it | length of the content, block size, digest of the seal | magic word

Readers of HDF5 take no notice of bytes behind the end that the superblock names.  Blocks count from the file's start,
so a seal does not depend on how many ranks make or check it.  Digests: BLAKE2b (RFC 7693).  No HDF5 and no MPI here.
"""

from __future__ import annotations

import hashlib
import os
import struct
from pathlib import Path

BLOCK = 2**24
DIGEST = 16
MAGIC = b"pgfmd seal 1\r\n\x1a\n"
_NUMBERS = struct.Struct("<QQ")
_FOOTER = _NUMBERS.size + DIGEST + len(MAGIC)


def sealed(content: bytes | memoryview) -> bytes:
    """The content of a small file with its seal."""
    return b"".join([content, tail(len(content), _digests(content))])


def unsealed(data: bytes, strict: bool = True) -> bytes:
    """The content of a sealed file; raises OSError if it is damaged or has no seal (unless not `strict`)."""
    if not strict and not data.endswith(MAGIC):
        return data
    size, digests, fault = _parse(data[-_longest(len(data)) :], len(data))
    if fault is None and digests != _digests(data[:size]):
        fault = "not the bytes that were written"
    if fault is not None:
        raise OSError(f"damaged: {fault}")
    return data[:size]


def tail(size: int, digests: list[bytes]) -> bytes:
    """The seal of a content of `size` bytes, its blocks having those digests."""
    body = b"".join(digests) + _NUMBERS.pack(size, BLOCK)
    return body + _digest(body) + MAGIC


def read_tail(path: Path) -> tuple[int, list[bytes], str | None]:
    """Length of a sealed file's content, the digests of its blocks, and what is wrong with the seal (else None)."""
    total = os.path.getsize(path)
    with open(path, "rb") as file:
        file.seek(total - _longest(total))
        return _parse(file.read(), total)


def digest_blocks(path: Path, starts: range, size: int) -> dict[int, bytes]:
    """Digests of those blocks of a file that begin at `starts`; its content has `size` bytes."""
    found = {}
    with open(path, "rb") as file:
        for start in starts:
            file.seek(start)
            found[start] = _digest(file.read(min(BLOCK, size - start)))
    return found


def _longest(total: int) -> int:
    """A seal in a file of `total` bytes is no longer than this."""
    return min(total, _FOOTER + DIGEST * -(-total // BLOCK))


def _parse(end: bytes, total: int) -> tuple[int, list[bytes], str | None]:
    if len(end) < _FOOTER or not end.endswith(MAGIC):
        return 0, [], "it has no seal, or was cut short"
    size, block = _NUMBERS.unpack_from(end, len(end) - _FOOTER)
    table = DIGEST * -(-size // BLOCK)
    if block != BLOCK or size + table + _FOOTER != total:
        return 0, [], "its length is not that which was written"
    body, digest = end[-_FOOTER - table : -DIGEST - len(MAGIC)], end[-DIGEST - len(MAGIC) : -len(MAGIC)]
    if _digest(body) != digest:
        return 0, [], "its seal is broken"
    return size, [body[at : at + DIGEST] for at in range(0, table, DIGEST)], None


def _digests(content: bytes | memoryview) -> list[bytes]:
    return [_digest(content[start : start + BLOCK]) for start in range(0, len(content), BLOCK)]


def _digest(data: bytes | memoryview) -> bytes:
    return hashlib.blake2b(data, digest_size=DIGEST).digest()

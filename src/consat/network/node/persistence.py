"""Crash-safe storage of an agent's state: a file with two halves that are written alternately, each with a number and a checksum.

The file is mapped into memory, so that a write takes microseconds and survives the process. It does not survive a crash of the machine.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import Final
from zlib import crc32

from consat.errors import NetworkError

_HEAD: Final = struct.Struct("<8sQQI")
_MAGIC: Final = b"csatmem1"


class Store:
    """A file with one record that can be replaced.

    Args:
        path: path of the file; created if missing.
        size: largest size of the record, in bytes.

    Raises:
        NetworkError: the file has another size, so that it is not the memory of this agent.
    """

    def __init__(self, path: Path, size: int) -> None:
        self._half = _HEAD.size + size
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and path.stat().st_size != 2 * self._half:
            raise NetworkError(f"{path} is not the memory of this agent (its size is another); remove it, or name another file")
        with path.open("a+b") as file:
            file.truncate(2 * self._half)
            self._map = mmap.mmap(file.fileno(), 2 * self._half)
        self._number = 0

    def load(self) -> bytes | None:
        """The newest complete record, or None."""
        best: tuple[int, bytes] | None = None
        for start in (0, self._half):
            magic, number, length, check = _HEAD.unpack_from(self._map, start)
            begin = start + _HEAD.size
            if magic != _MAGIC or length > self._half - _HEAD.size:
                continue
            record = bytes(self._map[begin : begin + length])
            if crc32(record, number) == check and (best is None or number > best[0]):
                best = number, record
        if best is None:
            return None
        self._number = best[0]
        return best[1]

    def save(self, record: bytes) -> None:
        """Write a record over the older half."""
        self._number += 1
        start = self._half * (self._number % 2)
        self._map[start + _HEAD.size : start + _HEAD.size + len(record)] = record
        _HEAD.pack_into(self._map, start, _MAGIC, self._number, len(record), crc32(record, self._number))

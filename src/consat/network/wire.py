"""The wire format: a header, two names, the shapes of a few arrays, their numbers, a checksum. Little-endian, version 4.

    offset  bytes  what
    0       4      b"csat"
    4       1      version
    5       1      kind
    6       1      number of arrays
    7       1      0
    8       8      hash of the problem's public parameters
    16      24     incarnation, sequence, ack                unsigned, 8 bytes each
    40      24     sent, echo, ν_β                           float64
    64      4      length of source, of destination          unsigned, 2 bytes each
    68             source, destination                       UTF-8
                   for each array: dimensions (1 byte; 4 more where numbers are of 32 bits), rows, columns (4 bytes each; columns is 0 for
                   a vector)
                   for each array: its numbers, float64 or float32, row by row
    −4      4      CRC-32 of all before it

Nothing received is ever unpickled or evaluated. A message has exactly one encoding; anything else is refused. The checksum detects
accidents, not forgeries: the transport authenticates the sender (`consat.network.keys`).
"""

from __future__ import annotations

import math
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np

from consat.errors import NetworkError, shown

MAGIC: Final = b"csat"
VERSION: Final = 4
"""Version of the format; messages of other versions are refused. Version 4 added 32-bit numbers and `Kind.SAME`."""
LONGEST: Final = 2**22
"""Largest size of a message, bytes."""
MOST_ARRAYS: Final = 32
LONGEST_NAME: Final = 1024
"""Largest size of an agent's id, bytes."""
AHEAD: Final = 2**20
"""Largest step of a sequence number that is accepted at once."""
QUIET: Final = 1.0
"""Time without an accepted message, s, after which a neighbour's sequence numbers may restart."""
SUPPORT: Final = 3
"""Number of consecutive consistent messages that are needed for this restart."""

_HEADER: Final = struct.Struct("<4sBBBB8sQQQdddHH")
_ZERO: Final = 7
"""Offset of the zero byte in the header."""
_SHAPE: Final = struct.Struct("<BII")
_CHECKSUM: Final = struct.Struct("<I")
_SINGLE: Final = 4
"""Added to the number of dimensions of a 32-bit array."""
_TYPES: Final = {False: "<f8", True: "<f4"}


class Kind(IntEnum):
    """Kind of a message."""

    HELLO = 1
    STATE = 2
    GOODBYE = 3
    RESEND = 4
    SAME = 5


class Reason(StrEnum):
    """Reason why a message was dropped."""

    SIZE = "size"
    MAGIC = "magic"
    VERSION = "version"
    CHECKSUM = "checksum"
    HEADER = "header"
    SOURCE = "source"
    DESTINATION = "destination"
    PROBLEM = "problem"
    KIND = "kind"
    SHAPE = "shape"
    NUMBER = "number"
    SENSE = "sense"
    DUPLICATE = "duplicate"
    STALE = "stale"
    JUMP = "jump"


@dataclass(frozen=True, eq=False)
class Message:
    """A message from an agent to a neighbour.

    Attributes:
        kind: its kind.
        problem: hash (8 bytes) of public parameters. Messages of agents that solve other problems are dropped.
        source: id of the sender.
        destination: id of the receiver.
        incarnation: a number that is larger after each restart of the sender.
        sequence: a number that increases with each message of this incarnation to this neighbour, of any kind.
        sent: time by the sender's clock, s.
        echo: `sent` of the last message that the sender received from this neighbour, plus the time since then; NaN without one.
        ack: `sequence` of that message; 0 without one.
        nu_beta: ν_β that the sender uses.
        arrays: float64 vectors or matrices; read-only in a received message.
    """

    kind: Kind
    problem: bytes
    source: str
    destination: str
    incarnation: int
    sequence: int
    sent: float
    echo: float
    ack: int
    nu_beta: float
    arrays: tuple[np.ndarray, ...] = ()


class Numbers(NamedTuple):
    """Validity conditions of an array of a message.

    Attributes:
        shape: (n,) or (rows, columns).
        largest: largest magnitude, of all or of each column. If it is infinite, infinities are valid. NaN is never valid.
        sound: function that tells whether the flat numbers are consistent; None if all within the limits are.
        single: whether the numbers have 32 bits.
    """

    shape: tuple[int, ...]
    largest: float | tuple[float, ...] = sys.float_info.max
    sound: Callable[[np.ndarray], bool] | None = None
    single: bool = False


Expected = Mapping[Kind, Sequence[Numbers | tuple[int, ...]]]
"""For each kind of message its arrays; other kinds are refused. A plain shape allows all finite numbers."""


def encode(message: Message, single: Container[int] = ()) -> bytes:
    """The message as bytes. `single`: indices of the arrays that are written in 32 bits."""
    source, destination = _name(message.source), _name(message.destination)
    arrays = [np.ascontiguousarray(array, dtype=_TYPES[k in single]) for k, array in enumerate(message.arrays)]
    if len(message.problem) != 8 or len(arrays) > MOST_ARRAYS:
        raise NetworkError(
            f"a message must have a problem hash of 8 bytes and at most {MOST_ARRAYS} arrays, not {len(message.problem)} and {len(arrays)}"
        )
    try:
        header = _HEADER.pack(
            MAGIC, VERSION, message.kind, len(arrays), 0, message.problem,
            message.incarnation, message.sequence, message.ack, message.sent, message.echo, message.nu_beta,
            len(source), len(destination),
        )  # fmt: skip
    except struct.error as error:
        numbers = message.incarnation, message.sequence, message.ack
        raise NetworkError(f"incarnation, sequence and ack must be integers in 0 … 2⁶⁴ − 1, not {numbers}: {error}") from None
    shapes = [_shape(array.shape, single=k in single) for k, array in enumerate(arrays)]
    body = b"".join((header, source, destination, *shapes, *(array.tobytes() for array in arrays)))
    if len(body) + _CHECKSUM.size > LONGEST:
        raise NetworkError(f"a message has {len(body)} bytes, but the longest allowed has {LONGEST}")
    return body + _CHECKSUM.pack(crc32(body))


def claims(payload: bytes, source: str) -> bool:
    """Whether the sender field of a message names `source`; nothing else is checked.

    A transport that has authenticated the sender uses this, so that no neighbour can send in another's name.
    """
    name = _name(source)
    at = _HEADER.size
    return payload[at - 4 : at - 2] == len(name).to_bytes(2, "little") and payload.startswith(name, at)


class Checker:
    """Accepts the messages to an agent that are well-formed, from a neighbour, of the same problem, and new. Counts the others by reason.

    Its memory is bounded by the number of neighbours: it keeps the newest (incarnation, sequence) of each, and refuses older ones.
    A forged huge number must not block a neighbour for good: a step of more than `AHEAD` is refused; but after `quiet` seconds without an
    accepted message, `SUPPORT` consecutive messages with consistent numbers restart the sequence.

    Args:
        me: id of the agent.
        neighbours: for each neighbour the expected arrays.
        problem: see `Message`.
        quiet: time, s, longer than the longest delay of messages.
        clock: clock, s.
    """

    def __init__(
        self,
        me: str,
        neighbours: Mapping[str, Expected],
        problem: bytes,
        *,
        quiet: float = QUIET,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counts: Counter[Reason] = Counter()
        self._me = _name(me)
        self._problem = problem
        self._quiet = quiet
        self._clock = clock
        self._neighbours = {
            _name(name): _Neighbour(name, {int(kind): _Layout.of(arrays) for kind, arrays in expected.items()}, _Window())
            for name, expected in neighbours.items()
        }
        each = (len(name) + layout.bytes for name, about in self._neighbours.items() for layout in about.layouts.values())
        self._longest = _HEADER.size + len(self._me) + max(each, default=0) + _CHECKSUM.size

    def accept(self, payload: bytes) -> Message | None:
        """The decoded message; None if it is dropped."""
        found = self._check(payload)
        if isinstance(found, Reason):
            self.counts[found] += 1
            return None
        return found

    def _broken(self, payload: bytes) -> Reason | None:
        """Reason why the bytes are not a message for this agent, from size, header and checksum; None if there is none."""
        size = len(payload)
        if not _HEADER.size + _CHECKSUM.size <= size <= self._longest:
            return Reason.SIZE
        if not payload.startswith(MAGIC):
            return Reason.MAGIC
        if payload[len(MAGIC)] != VERSION:
            return Reason.VERSION
        end = size - _CHECKSUM.size
        if crc32(memoryview(payload)[:end]) != _CHECKSUM.unpack_from(payload, end)[0]:
            return Reason.CHECKSUM
        return Reason.HEADER if payload[_ZERO] else None

    def _check(self, payload: bytes) -> Message | Reason:
        if (broken := self._broken(payload)) is not None:
            return broken
        _, _, kind, count, _, problem, *counters, sent, echo, nu_beta, long, far = _HEADER.unpack_from(payload)
        incarnation, sequence, ack = counters
        end = len(payload) - _CHECKSUM.size
        at = _HEADER.size
        if payload[at + long : at + long + far] != self._me:
            return Reason.DESTINATION
        if (neighbour := self._neighbours.get(payload[at : at + long])) is None:
            return Reason.SOURCE
        if problem != self._problem:
            return Reason.PROBLEM
        if (layout := neighbour.layouts.get(kind)) is None:
            return Reason.KIND
        at += long + far
        if at + layout.bytes != end or count != layout.count or not payload.startswith(layout.shapes, at):
            return Reason.SHAPE
        numbers = layout.read(memoryview(payload), at + len(layout.shapes))
        if not (math.isfinite(sent) and not math.isinf(echo) and 0 <= nu_beta < math.inf):
            return Reason.NUMBER
        if (wrong := layout.wrong(numbers)) is not None:
            return wrong
        if (refused := neighbour.window.refuse(incarnation, sequence, self._clock(), self._quiet)) is not None:
            return refused
        return Message(
            Kind(kind), problem, neighbour.name, self._me.decode(), incarnation, sequence, sent, echo, ack, nu_beta, layout.cut(numbers),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Layout:
    """Layout of the arrays in a message of one kind.

    Attributes:
        count: number of arrays.
        shapes: encoded shapes.
        slices: for each array the begin and end of its numbers among all, and its shape.
        single: indices of the 32-bit arrays.
        numbers: total count of numbers.
        largest: largest magnitude of each number, or of all.
        sound: for each array with a check of consistency the begin and end of its numbers, and the check.
        bytes: size of shapes and numbers.
    """

    count: int
    shapes: bytes
    slices: tuple[tuple[int, int, tuple[int, ...]], ...]
    single: tuple[int, ...]
    numbers: int
    largest: np.ndarray
    sound: tuple[tuple[int, int, Callable[[np.ndarray], bool]], ...]
    bytes: int

    @classmethod
    def of(cls, arrays: Sequence[Numbers | tuple[int, ...]]) -> _Layout:
        each = [array if isinstance(array, Numbers) else Numbers(array) for array in arrays]
        shapes = b"".join(_shape(array.shape, single=array.single) for array in each)
        sizes = [math.prod(array.shape) for array in each]
        ends = np.cumsum(sizes, dtype=int).tolist()
        slices = tuple((end - size, end, array.shape) for end, size, array in zip(ends, sizes, each, strict=True))
        limits = [np.broadcast_to(np.asarray(array.largest, dtype=float), array.shape).ravel() for array in each]
        largest = np.concatenate([np.zeros(0), *limits])
        if len(set(largest.tolist())) == 1:
            largest = largest[:1]
        total = len(shapes) + sum(size * (4 if array.single else 8) for size, array in zip(sizes, each, strict=True))
        single = tuple(k for k, array in enumerate(each) if array.single)
        if len(each) > MOST_ARRAYS or total > LONGEST:
            raise NetworkError(f"a message may have at most {MOST_ARRAYS} arrays and {LONGEST} bytes, not {len(each)} and {total}")
        sound = tuple((begin, end, array.sound) for (begin, end, _), array in zip(slices, each, strict=True) if array.sound is not None)
        return cls(len(each), shapes, slices, single, sum(sizes), largest, sound, total)

    def read(self, payload: memoryview, at: int) -> np.ndarray:
        """All numbers as an aligned copy. `at`: offset of the first."""
        if not self.single:
            return np.frombuffer(payload, _TYPES[False], self.numbers, at).astype(float)
        parts = [np.zeros(0)]
        for k, (begin, end, _) in enumerate(self.slices):
            part = np.frombuffer(payload, _TYPES[k in self.single], end - begin, at)
            with np.errstate(invalid="ignore"):  # a signalling NaN is refused later, as any NaN
                parts.append(part.astype(float))
            at += part.nbytes
        return np.concatenate(parts)

    def wrong(self, numbers: np.ndarray) -> Reason | None:
        """Reason why numbers are refused; None if they are valid."""
        if not (np.abs(numbers) <= self.largest).all():
            return Reason.NUMBER
        return None if all(sound(numbers[begin:end]) for begin, end, sound in self.sound) else Reason.SENSE

    def cut(self, numbers: np.ndarray) -> tuple[np.ndarray, ...]:
        numbers.flags.writeable = False
        return tuple(numbers[start:end].reshape(shape) for start, end, shape in self.slices)


class _Window:
    """The newest (incarnation, sequence) of a neighbour, and a candidate that may replace it."""

    __slots__ = ("_heard", "_newest", "_rival", "_support")

    def __init__(self) -> None:
        self._newest: tuple[int, int] | None = None
        self._heard = -math.inf
        self._rival = (0, 0)
        self._support = 0

    def refuse(self, incarnation: int, sequence: int, now: float, quiet: float) -> Reason | None:
        """Reason why a message is refused; None if it is accepted."""
        if (newest := self._newest) is None:
            self._take(incarnation, sequence, now)
            return None
        if newest == (incarnation, sequence):
            return Reason.DUPLICATE
        restarted, later = incarnation > newest[0], (incarnation, sequence) > newest
        if restarted or (later and sequence - newest[1] <= AHEAD):
            self._take(incarnation, sequence, now)
            return None
        agrees = incarnation == self._rival[0] and 0 <= sequence - self._rival[1] <= AHEAD
        self._support = self._support + 1 if agrees else 1
        self._rival = incarnation, sequence
        if self._support >= SUPPORT and now - self._heard > quiet:
            self._take(incarnation, sequence, now)
            return None
        return Reason.JUMP if later else Reason.STALE

    def _take(self, incarnation: int, sequence: int, now: float) -> None:
        self._newest, self._heard, self._support = (incarnation, sequence), now, 0


class _Neighbour(NamedTuple):
    name: str
    layouts: Mapping[int, _Layout]
    window: _Window


def _name(text: str) -> bytes:
    try:
        name = text.encode()
    except UnicodeEncodeError:
        raise NetworkError(f"an agent's id must be text that UTF-8 can write, but {shown(text)} is not") from None
    if not 0 < len(name) <= LONGEST_NAME:
        raise NetworkError(f"an agent's id must have 1 to {LONGEST_NAME} bytes in UTF-8, but {shown(text)} has {len(name)}")
    return name


def _shape(shape: tuple[int, ...], *, single: bool = False) -> bytes:
    if len(shape) not in {1, 2} or max(shape) > LONGEST:
        raise NetworkError(f"arrays of a message must be vectors or matrices of at most {LONGEST} bytes, not of shape {shape}")
    return _SHAPE.pack(len(shape) + (_SINGLE if single else 0), shape[0], shape[1] if len(shape) == 2 else 0)

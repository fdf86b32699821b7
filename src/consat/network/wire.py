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

Nothing received is ever unpickled or evaluated. There is one way to write a message, and whatever differs is refused. The checksum finds
accidents, not forgeries: who wrote a message is for the transport to prove (`consat.network.keys`).
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
"""Since numbers may be of 32 bits, and a message may say that there is nothing new. Others are refused."""
LONGEST: Final = 2**22
"""No message has more bytes."""
MOST_ARRAYS: Final = 32
LONGEST_NAME: Final = 1024
"""Bytes of an agent's id."""
AHEAD: Final = 2**20
"""A sequence number that runs ahead by more is not believed at once."""
QUIET: Final = 1.0
"""Seconds without an accepted message after which a neighbour's numbers may start anew."""
SUPPORT: Final = 3
"""So many messages on end must agree before they do."""

_HEADER: Final = struct.Struct("<4sBBBB8sQQQdddHH")
_ZERO: Final = 7
"""Where in the header 0 stands."""
_SHAPE: Final = struct.Struct("<BII")
_CHECKSUM: Final = struct.Struct("<I")
_SINGLE: Final = 4
"""Added to the dimensions of an array of 32 bits."""
_TYPES: Final = {False: "<f8", True: "<f4"}


class Kind(IntEnum):
    """What a message is for."""

    HELLO = 1
    STATE = 2
    GOODBYE = 3
    RESEND = 4
    SAME = 5


class Reason(StrEnum):
    """Why a message was dropped."""

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
    """What one agent tells a neighbour.

    Attributes:
        kind: what it is for.
        problem: 8 bytes, a hash over public parameters only: agents that solve different problems don't listen to each other.
        source: who sends it.
        destination: for whom it is.
        incarnation: larger after each restart of the sender.
        sequence: larger in each message of this incarnation to this neighbour, whatever its kind; a repetition is dropped as a duplicate.
        sent: the sender's clock, in s.
        echo: `sent` of the last message that the sender got from this neighbour, NaN if none.
        ack: `sequence` of that message, 0 if none.
        nu_beta: ν_β that the sender uses.
        arrays: float64, vectors or matrices. As received they are read-only.
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
    """What an array of a message must be.

    Attributes:
        shape: (n,) or (rows, columns).
        largest: no magnitude is above it, or above that of its column. With inf, infinities may stand there; NaN may stand nowhere.
        sound: whether numbers within these limits, flat, make sense together; None where any do.
        single: whether they are of 32 bits.
    """

    shape: tuple[int, ...]
    largest: float | tuple[float, ...] = sys.float_info.max
    sound: Callable[[np.ndarray], bool] | None = None
    single: bool = False


Expected = Mapping[Kind, Sequence[Numbers | tuple[int, ...]]]
"""For each kind, its arrays; a kind that is missing is refused. A plain shape allows all finite numbers."""


def encode(message: Message, single: Container[int] = ()) -> bytes:
    """The message as bytes; single: which of its arrays are written in 32 bits."""
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
    """Whether the message says that it is from `source`. Nothing else of it is looked at.

    A transport that knows who wrote a message asks this, so that no neighbour can speak in another's name.
    """
    name = _name(source)
    at = _HEADER.size
    return payload[at - 4 : at - 2] == len(name).to_bytes(2, "little") and payload.startswith(name, at)


class Checker:
    """Stands at the door of one agent: hands on what is well-formed, for it, from a neighbour, of this problem, and new; counts the rest.

    Its memory is bounded by the number of neighbours, whatever arrives. Of a neighbour it remembers the newest (incarnation, sequence) and
    refuses older ones. A forged huge number must not mute the neighbour for good: a sequence that runs far ahead is not believed, and when
    for `quiet` seconds nothing was accepted from the neighbour, `SUPPORT` messages on end that agree on where they are start it anew.

    Args:
        me: this agent.
        neighbours: for each neighbour, what to expect from it.
        problem: see `Message`.
        quiet: longer than the network holds messages back.
        clock: in s.
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
        """The message, or None if it is to be dropped."""
        found = self._check(payload)
        if isinstance(found, Reason):
            self.counts[found] += 1
            return None
        return found

    def _broken(self, payload: bytes) -> Reason | None:
        """What tells, without a look inside, that this is no message that anybody could have sent here."""
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
    """How the arrays of one kind of message lie in it.

    Attributes:
        count: of arrays.
        shapes: the bytes that tell them.
        slices: of each array, where its numbers begin and end among all, and its shape.
        single: which arrays are of 32 bits.
        numbers: how many, in all arrays.
        largest: the largest magnitude of each number, or of all.
        sound: of arrays that are to make sense, where their numbers begin and end, and what tells.
        bytes: of shapes and numbers.
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
        """All numbers, from where they begin; a copy, aligned."""
        if not self.single:
            return np.frombuffer(payload, _TYPES[False], self.numbers, at).astype(float)
        parts = [np.zeros(0)]
        for k, (begin, end, _) in enumerate(self.slices):
            part = np.frombuffer(payload, _TYPES[k in self.single], end - begin, at)
            with np.errstate(invalid="ignore"):  # of signalling NaN, which is refused like any other
                parts.append(part.astype(float))
            at += part.nbytes
        return np.concatenate(parts)

    def wrong(self, numbers: np.ndarray) -> Reason | None:
        """What is, with the numbers of a message."""
        if not (np.abs(numbers) <= self.largest).all():
            return Reason.NUMBER
        return None if all(sound(numbers[begin:end]) for begin, end, sound in self.sound) else Reason.SENSE

    def cut(self, numbers: np.ndarray) -> tuple[np.ndarray, ...]:
        numbers.flags.writeable = False
        return tuple(numbers[start:end].reshape(shape) for start, end, shape in self.slices)


class _Window:
    """The newest numbers of a neighbour, and those of a rival that may replace them."""

    __slots__ = ("_heard", "_newest", "_rival", "_support")

    def __init__(self) -> None:
        self._newest: tuple[int, int] | None = None
        self._heard = -math.inf
        self._rival = (0, 0)
        self._support = 0

    def refuse(self, incarnation: int, sequence: int, now: float, quiet: float) -> Reason | None:
        """Why not to take it; None takes it."""
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

"""Mutated messages against a second opinion: what `wire.Checker` accepts must pass a check that shares no code with it, and the other way.

The second opinion reads the format off the table in `consat.network.wire`'s docstring with nothing but integers, and has its own CRC.
"""

from __future__ import annotations

import gc
import math
import random
import struct
import sys
import time
import types
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from consat.network.node.pairs import INDEFINITE, MessageLayout
from consat.network.wire import Checker, Kind, Message, Numbers, Reason, encode

PROBLEM = bytes(range(8))
ME = "änn"
INF = math.inf
LAYOUT = MessageLayout(names=(("x", 0), None), level=True)
"""Mail of the interior-point protocol about one coordinate and the level: count, μ, t and the least margin, then L11, L12, L22, e1, e2; and
Σλ, c, the error, L11 and e1 of the proof."""
QUADRATIC = 8
"""Numbers of its half of 32 bits, see `consat.network.node.pairs.halves`."""
EXPECTED: dict[str, dict[Kind, list[Any]]] = {
    "bob": {Kind.HELLO: [], Kind.STATE: [(2, 2), Numbers((3,), INF)], Kind.GOODBYE: [(1,)], Kind.RESEND: [(1, 2), LAYOUT.numbers()]},
    "carol": {Kind.STATE: [Numbers((2, 6), (9.0, 9.0, INF, 100.0, 100.0, 1e6))]},  # as of estimates, a margin, a body, and its age
    "the 3rd/*": {Kind.STATE: [Numbers((4, 1), 100.0)], Kind.RESEND: [(0,), (0, 3)], Kind.SAME: [(1,)]},
    "dave": {Kind.STATE: [(1, 2), *LAYOUT.half_numbers()], Kind.SAME: [Numbers((3,), 100.0, single=True)]},
}
WINDOW = {Reason.DUPLICATE, Reason.STALE, Reason.JUMP}
INTERESTING = (0, 1, 2, 255, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
FLOATS = (math.nan, INF, -INF, -0.0, 5e-324, 1.7976931348623157e308, 100.0, 100.00000000000001, -1.0)

_TABLE = []
for byte in range(256):
    for _ in range(8):
        byte = byte >> 1 ^ (0xEDB88320 if byte & 1 else 0)  # noqa: PLW2901
    _TABLE.append(byte)


def crc(data: bytes) -> int:
    """CRC-32 (IEEE 802.3), from its definition."""
    rest = 0xFFFFFFFF
    for byte in data:
        rest = rest >> 8 ^ _TABLE[(rest ^ byte) & 255]
    return rest ^ 0xFFFFFFFF


def fix(payload: bytes) -> bytes:
    """With the checksum that belongs to it."""
    return payload[:-4] + crc(payload[:-4]).to_bytes(4, "little")


class Read(NamedTuple):
    """A message that is in order, apart from its age."""

    kind: int
    source: str
    counters: tuple[int, int, int]
    floats: tuple[float, float, float]
    arrays: list[tuple[tuple[int, ...], list[float]]]


def _integer(data: bytes) -> int:
    return sum(byte << 8 * place for place, byte in enumerate(data))


def _double(data: bytes) -> float:
    bits = _integer(data)
    sign, exponent, fraction = (-1.0 if bits >> 63 else 1.0), bits >> 52 & 2047, bits & (1 << 52) - 1
    if exponent == 2047:
        return math.nan if fraction else sign * INF
    if exponent == 0:
        return sign * math.ldexp(fraction, -1074)
    return sign * math.ldexp(fraction + (1 << 52), exponent - 1075)


def second_opinion(payload: bytes) -> Read | None:
    """What the message says, or None if it must not be accepted, whatever came before."""
    if len(payload) < 72 or payload[:5] != b"csat\x04" or payload[7] or payload[8:16] != PROBLEM:
        return None
    if crc(payload[:-4]) != _integer(payload[-4:]):
        return None
    long, far = _integer(payload[64:66]), _integer(payload[66:68])
    if 68 + long + far > len(payload) - 4:
        return None
    source, destination, rest = payload[68 : 68 + long], payload[68 + long : 68 + long + far], payload[68 + long + far : -4]
    known = {name.encode(): name for name in EXPECTED}
    if source not in known or destination != ME.encode() or payload[5] not in EXPECTED[known[source]]:
        return None
    arrays = _arrays(rest, payload[6], EXPECTED[known[source]][Kind(payload[5])])
    sent, echo, nu = (_double(payload[place : place + 8]) for place in (40, 48, 56))
    if arrays is None or abs(sent) == INF or math.isnan(sent) or abs(echo) == INF or not 0 <= nu < INF:
        return None
    counters = _integer(payload[16:24]), _integer(payload[24:32]), _integer(payload[32:40])
    return Read(payload[5], known[source], counters, (sent, echo, nu), arrays)


def _arrays(data: bytes, count: int, expected: list[Any]) -> list[tuple[tuple[int, ...], list[float]]] | None:
    wanted = [each if isinstance(each, Numbers) else Numbers(each) for each in expected]
    sizes = [math.prod(array.shape) for array in wanted]
    told = [data[9 * place : 9 * place + 9] for place in range(count)]
    due = [
        bytes([len(array.shape) + 4 * array.single]) + b"".join(n.to_bytes(4, "little") for n in (*array.shape, 0)[:2]) for array in wanted
    ]
    widths = [4 if array.single else 8 for array in wanted for _ in range(math.prod(array.shape))]
    if told != due or len(data) != 9 * count + sum(widths):
        return None
    values, at = [], 9 * count
    for width in widths:
        values.append(_double(data[at : at + 8]) if width == 8 else _float(data[at : at + 4]))
        at += width
    arrays = []
    for array, size in zip(wanted, sizes, strict=True):
        limits = array.largest if isinstance(array.largest, tuple) else (array.largest,)
        if not all(abs(value) <= limits[place % len(limits)] for place, value in enumerate(values[:size])):
            return None
        if array.sound and not makes_sense(in_full(values[:size])):
            return None
        arrays.append((array.shape, values[:size]))
        del values[:size]
    return arrays


def _float(data: bytes) -> float:
    bits = _integer(data)
    sign, exponent, fraction = (-1.0 if bits >> 31 else 1.0), bits >> 23 & 255, bits & (1 << 23) - 1
    if exponent == 255:
        return math.nan if fraction else sign * INF
    return sign * (math.ldexp(fraction, -149) if exponent == 0 else math.ldexp(fraction + (1 << 23), exponent - 150))


def in_full(numbers: list[float]) -> list[float]:
    """Mail as in `LAYOUT`: a half of it with another that makes sense."""
    if len(numbers) == QUADRATIC:
        return [0.0, *numbers, 0.0, 0.0, 0.0, 0.0, 0.0]
    return numbers if len(numbers) > QUADRATIC else [numbers[0], *[0.0] * QUADRATIC, *numbers[1:]]


def makes_sense(numbers: list[float]) -> bool:
    """Whether mail is what an agent of sense can have sent; see `LAYOUT`. The eigenvalues of 2 × 2 are known in closed form."""
    changes, barrier, _, _, a, b, c, _, _, weight, _, error, proof, _ = numbers
    scale = max(abs(a), abs(b), abs(c)) or 1.0
    a, b, c = a / scale, b / scale, c / scale
    middle, apart = (a + c) / 2, math.hypot((a - c) / 2, b)
    return (
        changes >= 0 and changes.is_integer()
        and (barrier >= 0 or barrier == -1) and (weight >= 0 or weight == -1) and error >= 0 and proof >= 0
        and middle - apart >= -INDEFINITE * max(middle + apart, 0.0)
    )  # fmt: skip


def agrees(message: Message, read: Read) -> bool:
    """Whether both read the same out of it, to the last bit."""

    def bits(values: Any) -> bytes:
        return struct.pack(f"<{len(values)}d", *values)

    return (
        (message.kind, message.source, message.destination, message.problem) == (read.kind, read.source, ME, PROBLEM)
        and (message.incarnation, message.sequence, message.ack) == read.counters
        and bits([v for v in (message.sent, message.echo, message.nu_beta) if not math.isnan(v)])
        == bits([v for v in read.floats if not math.isnan(v)])
        and [array.shape for array in message.arrays] == [shape for shape, _ in read.arrays]
        and all(bits(a.ravel().tolist()) == bits(values) for a, (_, values) in zip(message.arrays, read.arrays, strict=True))
    )


class Mutator:
    """An endless stream of messages: some good, most not quite."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)  # noqa: S311
        self.sequence = 0
        self.last = b""

    def good(self) -> bytes:
        """One that must be accepted, unless something newer was."""
        draw = self.random
        source = draw.choice(list(EXPECTED))
        kind = draw.choice(list(EXPECTED[source]))
        arrays = tuple(self._array(each if isinstance(each, Numbers) else Numbers(each)) for each in EXPECTED[source][kind])
        self.sequence += 1
        echo = draw.choice([math.nan, 12.5])
        single = tuple(k for k, each in enumerate(EXPECTED[source][kind]) if isinstance(each, Numbers) and each.single)
        message = Message(kind, PROBLEM, source, ME, 1, self.sequence, draw.uniform(0, 99), echo, self.sequence, 5.0, arrays)
        self.last = encode(message, single)
        return self.last

    def _array(self, expected: Numbers) -> np.ndarray:
        draw = self.random
        size = math.prod(expected.shape)
        values = [draw.uniform(-9, 9) for _ in range(14 if expected.sound else size)]
        if expected.sound:
            root, side = draw.uniform(0, 3), draw.uniform(-3, 3)
            values[0], values[1] = float(draw.randrange(5)), draw.choice([-1.0, draw.uniform(0, 9)])
            values[4:7] = root * root, root * side, side * side + draw.choice([0.0, 1.0])
            values[9], values[11:13] = draw.choice([-1.0, 0.0, 2.5]), (draw.uniform(0, 1), draw.uniform(0, 9))
            values = {14: values, QUADRATIC: values[1:9], 6: [values[0], *values[9:]]}[size]
        return np.asarray(values).reshape(expected.shape)

    def astray(self) -> bytes:
        """Well-formed, but not for us, or not from whom or of what we expect."""
        draw = self.random
        shape = draw.choice([(3,), (2, 2), (4, 1), (0,), (1, 0), (7,), (2000,)])
        arrays = tuple(np.full(shape, draw.choice(FLOATS)) for _ in range(draw.randrange(4)))
        who = draw.choice([*EXPECTED, "mallory", ME]), draw.choice([ME, ME, "bob", "x" * 300])
        problem = draw.choice([PROBLEM, PROBLEM, b"another."])
        floats = draw.choice([1.0, *FLOATS]), draw.choice([1.0, *FLOATS])
        return encode(
            Message(draw.choice(list(Kind)), problem, *who, draw.choice(INTERESTING), draw.choice(INTERESTING), *floats, 0, 5.0, arrays)
        )

    def mutated(self) -> bytes:
        """A good one, spoilt in one to three ways; often with a checksum that fits."""
        draw = self.random
        data = bytearray(self.good())
        for _ in range(draw.choice([1, 1, 1, 2, 3])):
            draw.choice(
                [self._flip, self._flip, self._set, self._set, self._count, self._float, self._cut, self._grow, self._delete, self._repeat,
                 self._splice]
            )(data)  # fmt: skip
        return fix(bytes(data)) if len(data) >= 4 and draw.random() < 0.7 else bytes(data)

    def __iter__(self) -> Iterator[bytes]:
        draw = self.random
        while True:
            yield draw.choices(
                [self.mutated, self.good, self.astray, lambda: self.last, lambda: draw.randbytes(draw.choice([0, 1, 71, 72, 142, 5000]))],
                [82, 9, 5, 2, 2],
            )[0]()

    def _place(self, data: bytearray, width: int = 1) -> int:
        """Somewhere; half of the time in the header."""
        end = max(len(data) - width, 0)
        return self.random.randint(0, min(end, 67) if self.random.random() < 0.5 else end)

    def _flip(self, data: bytearray) -> None:
        if data:
            data[self._place(data)] ^= 1 << self.random.randrange(8)

    def _set(self, data: bytearray) -> None:
        if data:
            data[self._place(data)] = self.random.choice([0, 1, 2, 3, 4, 5, 127, 128, 255])

    def _count(self, data: bytearray) -> None:
        width = self.random.choice([2, 4, 8])
        at = self._place(data, width)
        data[at : at + width] = (self.random.choice(INTERESTING) % 256**width).to_bytes(width, "little")

    def _float(self, data: bytearray) -> None:
        at = len(data) - 4 - 8 * self.random.randint(1, 7) if self.random.random() < 0.7 else self.random.choice([40, 48, 56])
        if at >= 0:
            data[at : at + 8] = struct.pack("<d", self.random.choice(FLOATS))

    def _cut(self, data: bytearray) -> None:
        del data[self._place(data) :]

    def _grow(self, data: bytearray) -> None:
        data += self.random.randbytes(self.random.choice([1, 2, 4, 8, 100, 70000 if self.random.random() < 0.02 else 9]))

    def _delete(self, data: bytearray) -> None:
        at = self._place(data)
        del data[at : at + self.random.choice([1, 4, 8, 9])]

    def _repeat(self, data: bytearray) -> None:
        at = self._place(data)
        data[at:at] = data[at : at + self.random.choice([1, 8, 9, 16])]

    def _splice(self, data: bytearray) -> None:
        data[self._place(data) :] = self.good()[self._place(data) :]


@dataclass
class Tally:
    """What came of it.

    Attributes:
        messages: sent.
        accepted: of them.
        reasons: for which the others were dropped.
        seconds: that the checker took.
        held: bytes that the checker that saw all of them holds, as they went by.
    """

    messages: int = 0
    accepted: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    held: list[int] = field(default_factory=list)


def run(count: int, seed: int, batch: int = 100) -> Tally:
    """Send `count` messages through two checkers, one of which starts anew with each batch, so that its numbers don't run out.

    Raises:
        AssertionError: on any disagreement with the second opinion.
    """
    tally = Tally()
    stream = iter(Mutator(seed))
    veteran = Checker(ME, EXPECTED, PROBLEM, quiet=0.0)
    while tally.messages < count:
        checker, newest = Checker(ME, EXPECTED, PROBLEM, clock=lambda: 0.0), {}
        payloads = [next(stream) for _ in range(min(batch, count - tally.messages))]
        began = time.perf_counter()
        answers = [_ask(checker, payload) for payload in payloads]
        tally.seconds += time.perf_counter() - began
        for payload, (message, reason) in zip(payloads, answers, strict=True):
            veteran.accept(payload)
            _judge(payload, message, reason, newest)
            tally.accepted += message is not None
        tally.messages += len(payloads)
        tally.reasons.update(checker.counts)
        tally.held.append(held(veteran))
    assert tally.accepted + tally.reasons.total() == count
    return tally


def held(thing: Any) -> int:
    """Bytes of all that it refers to, apart from code."""
    seen: dict[int, Any] = {}
    waiting = [thing]
    while waiting:
        each = waiting.pop()
        if id(each) not in seen and not isinstance(each, type | types.FunctionType | types.BuiltinFunctionType | types.ModuleType):
            seen[id(each)] = each
            waiting += gc.get_referents(each)
    return sum(map(sys.getsizeof, seen.values()))


def _ask(checker: Checker, payload: bytes) -> tuple[Message | None, Reason | None]:
    """What it makes of the message, and the reason that it counts."""
    before = dict(checker.counts)
    message = checker.accept(payload)
    new = [reason for reason, times in checker.counts.items() if times != before.get(reason, 0)]
    assert len(new) == (message is None), (payload, new)
    return message, new[0] if new else None


def _judge(payload: bytes, message: Message | None, reason: Reason | None, newest: dict[str, tuple[int, int]]) -> None:
    read = second_opinion(payload)
    if read is None:
        assert message is None, f"accepted, but must not be: {payload.hex()}"
        assert reason not in WINDOW, f"counted as {reason}, but is not even well-formed: {payload.hex()}"
        return
    incarnation, sequence, _ = read.counters
    last = newest.get(read.source)
    new = last is None or incarnation > last[0] or (incarnation == last[0] and 0 < sequence - last[1] <= 2**20)
    if new:
        assert message is not None, f"dropped as {reason}, but is in order: {payload.hex()}"
        assert agrees(message, read), f"read otherwise than it says: {payload.hex()}"
        newest[read.source] = incarnation, sequence
    else:
        assert message is None, f"accepted, though not new: {payload.hex()}"
        assert reason in WINDOW, f"counted as {reason}, but only its numbers are old: {payload.hex()}"

"""The wire format, field by field, and what a checker makes of age."""

from __future__ import annotations

import dataclasses
import math
import pickle
import struct
import sys
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from consat.errors import NetworkError
from consat.network.wire import AHEAD, LONGEST, QUIET, SUPPORT, Checker, Kind, Message, Numbers, Reason, claims, encode
from consat.protocols.sending import HEADER

PROBLEM = b"problem1"
EXPECTED = {
    "a1": {Kind.STATE: [(2,)], Kind.HELLO: []},
    "a3": {Kind.STATE: [(1, 2), Numbers((2,), math.inf)]},
    "a4": {Kind.STATE: [Numbers((2,), sound=lambda numbers: bool(numbers[0] >= numbers[1]))]},
}


def message(**changes: Any) -> Message:
    plain = Message(Kind.STATE, PROBLEM, "a1", "a2", 1, 7, 0.5, math.nan, 0, 5.0, (np.array([1.0, -2.0]),))
    return dataclasses.replace(plain, **changes)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def checker(expected: Mapping[str, Any] = EXPECTED, **options: Any) -> Checker:
    return Checker("a2", expected, PROBLEM, **options)


def test_bytes_are_as_documented() -> None:
    """Written down by hand: whoever changes the format must change the version."""
    body = (
        b"csat\x04\x02\x03\x00problem1"
        + struct.pack("<QQQ", 3, 2**40, 9)
        + struct.pack("<ddd", 1.5, 0.25, 5.0)
        + b"\x02\x00\x03\x00a1\xc3\xa4x"
        + b"\x01\x02\x00\x00\x00\x00\x00\x00\x00"
        + b"\x02\x02\x00\x00\x00\x01\x00\x00\x00"
        + b"\x05\x01\x00\x00\x00\x00\x00\x00\x00"
        + struct.pack("<dddd", 1.0, 2.0, 3.0, 4.0)
        + struct.pack("<f", 0.1)
    )
    arrays = np.array([1.0, 2.0]), np.array([[3.0], [4.0]]), np.array([0.1])
    told = Message(Kind.STATE, PROBLEM, "a1", "äx", 3, 2**40, 1.5, 0.25, 9, 5.0, arrays)
    assert encode(told, single=(2,)) == body + struct.pack("<I", zlib.crc32(body))


@given(
    counters=st.tuples(*[st.integers(0, 2**64 - 1)] * 3),
    times=st.tuples(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_infinity=False), st.floats(0, 1e300)),
    names=st.lists(st.text(min_size=1, max_size=20), min_size=2, max_size=2, unique=True),
    kind=st.sampled_from(Kind),
    values=st.lists(
        arrays(np.float64, array_shapes(min_dims=1, max_dims=2, min_side=0, max_side=5), elements=st.floats(allow_nan=False)), max_size=4
    ),
)
def test_what_is_sent_is_what_arrives(counters: Any, times: Any, names: list[str], kind: Kind, values: list[np.ndarray]) -> None:
    (incarnation, sequence, ack), (sent, echo, nu) = counters, times
    told = Message(kind, PROBLEM, *names, incarnation, sequence, sent, echo, ack, nu, tuple(values))
    door = Checker(names[1], {names[0]: {kind: [Numbers(value.shape, math.inf) for value in values]}}, PROBLEM)
    got = door.accept(encode(told))
    assert got is not None, door.counts
    for field in dataclasses.fields(Message)[:-1]:
        expected, found = getattr(told, field.name), getattr(got, field.name)
        assert found == expected or (field.name == "echo" and math.isnan(found) and math.isnan(expected)), field.name
    assert [value.tobytes() for value in got.arrays] == [value.tobytes() for value in told.arrays]
    assert [value.shape for value in got.arrays] == [value.shape for value in told.arrays]
    assert got.kind is kind


def test_arrays_are_safe_to_keep() -> None:
    got = checker().accept(encode(message()))
    assert got is not None
    (array,) = got.arrays
    assert array.dtype == np.float64
    assert array.flags.aligned
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1.0


def test_other_dtypes_and_orders_are_written_as_float64_row_by_row() -> None:
    door = Checker("a2", {"a1": {Kind.STATE: [(2, 3), (2,)]}}, PROBLEM)
    columns = np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3))
    got = door.accept(encode(message(arrays=(columns, np.array([1, 2], dtype=">f4")))))
    assert got is not None
    assert got.arrays[0].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert got.arrays[1].tolist() == [1, 2]


@pytest.mark.parametrize("value", [0.1, -3.4e38, 1e-45, math.inf])
def test_numbers_of_32_bits_arrive_rounded_and_are_checked_like_others(value: float) -> None:
    due = Numbers((2,), (math.inf, 10.0), sound=lambda numbers: bool(numbers[1] >= 0), single=True)
    door = Checker("a2", {"a1": {Kind.STATE: [(1,), due, (1,)]}}, PROBLEM)

    def sent(second: float, sequence: int) -> Message | None:
        arrays = np.array([0.1]), np.array([value, second]), np.array([0.3])
        return door.accept(encode(message(arrays=arrays, sequence=sequence), single=(1,)))

    got = sent(1.0, 1)
    assert got is not None
    assert [array.tolist() for array in got.arrays] == [[0.1], [float(np.float32(value)), 1.0], [0.3]]
    assert all(array.dtype == np.float64 for array in got.arrays)
    assert sent(-1.0, 2) is sent(11.0, 3) is sent(math.nan, 4) is None
    assert door.counts == {Reason.SENSE: 1, Reason.NUMBER: 2}
    assert door.accept(encode(message(arrays=(np.zeros(1), np.zeros(2), np.zeros(1)), sequence=5))) is None, "64 bits where 32 are due"


def test_the_engine_counts_the_bytes_of_a_message_as_they_are() -> None:
    both = len(encode(message(arrays=()))) - len(b"a1a2")
    assert both == HEADER


def sealed(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def patched(at: int, new: bytes) -> bytes:
    body = encode(message())[:-4]
    return sealed(body[:at] + new + body[at + len(new) :])


BAD = {
    "nothing": (b"", Reason.SIZE),
    "half": (encode(message())[:60], Reason.SIZE),
    "a megabyte": (sealed(encode(message())[:-4] + bytes(10**6)), Reason.SIZE),
    "a pickle": (pickle.dumps({"x": list(range(99))})[:120], Reason.MAGIC),
    "another program's": (patched(0, b"JSON"), Reason.MAGIC),
    "version 1, which told nothing of bodies": (patched(4, b"\x01"), Reason.VERSION),
    "version 2, which told nothing to a neighbour as a whole": (patched(4, b"\x02"), Reason.VERSION),
    "version 3, whose numbers were all of 64 bits": (patched(4, b"\x03"), Reason.VERSION),
    "version 5": (patched(4, b"\x05"), Reason.VERSION),
    "numbers of 32 bits where 64 are due": (encode(message(), single=(0,)), Reason.SHAPE),
    "a flipped bit": (encode(message())[:-5] + b"\x41" + encode(message())[-4:], Reason.CHECKSUM),
    "a reserved byte": (patched(7, b"\x01"), Reason.HEADER),
    "a stranger": (encode(message(source="a9")), Reason.SOURCE),
    "from ourselves": (encode(message(source="a2")), Reason.SOURCE),
    "for somebody else": (encode(message(destination="a3")), Reason.DESTINATION),
    "another problem": (encode(message(problem=b"problem2")), Reason.PROBLEM),
    "kind 0": (patched(5, b"\x00"), Reason.KIND),
    "kind 200": (patched(5, b"\xc8"), Reason.KIND),
    "a kind that isn't due": (encode(message(kind=Kind.GOODBYE, arrays=())), Reason.KIND),
    "no array": (encode(message(arrays=())), Reason.SHAPE),
    "one array too many": (encode(message(arrays=(np.zeros(2), np.zeros(0)))), Reason.SHAPE),
    "a matrix for a vector": (encode(message(arrays=(np.zeros((2, 1)),))), Reason.SHAPE),
    "too long a vector": (encode(message(arrays=(np.zeros(3),))), Reason.SHAPE),
    "bytes at the end": (sealed(encode(message(kind=Kind.HELLO, arrays=()))[:-4] + bytes(3)), Reason.SHAPE),
    "a number missing": (sealed(encode(message())[:-12]), Reason.SHAPE),
    "sent at no time": (encode(message(sent=math.nan)), Reason.NUMBER),
    "sent in all eternity": (encode(message(sent=-math.inf)), Reason.NUMBER),
    "an endless echo": (encode(message(echo=math.inf)), Reason.NUMBER),
    "ν < 0": (encode(message(nu_beta=-1.0)), Reason.NUMBER),
    "ν = ∞": (encode(message(nu_beta=math.inf)), Reason.NUMBER),
    "ν = NaN": (encode(message(nu_beta=math.nan)), Reason.NUMBER),
    "x = NaN": (encode(message(arrays=(np.array([0.0, math.nan]),))), Reason.NUMBER),
    "x = −∞": (encode(message(arrays=(np.array([-math.inf, 0.0]),))), Reason.NUMBER),
    "NaN where ∞ may be": (encode(message(source="a3", arrays=(np.zeros((1, 2)), np.array([0.0, math.nan])))), Reason.NUMBER),
    "numbers that make no sense together": (encode(message(source="a4", arrays=(np.array([1.0, 2.0]),))), Reason.SENSE),
    "∞ in the wrong array": (encode(message(source="a3", arrays=(np.full((1, 2), math.inf), np.zeros(2)))), Reason.NUMBER),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_message_is_dropped_and_counted(case: str) -> None:
    payload, reason = BAD[case]
    door = checker()
    assert door.accept(payload) is None
    assert door.counts == {reason: 1}
    assert door.accept(encode(message())) is not None, "a bad message must leave no trace"


def test_every_reason_is_tested() -> None:
    assert {reason for _, reason in BAD.values()} == set(Reason) - {Reason.DUPLICATE, Reason.STALE, Reason.JUMP}


def test_a_name_must_not_run_into_the_checksum() -> None:
    """Found by fuzzing: the checksum's first byte may be the missing last letter of the name."""
    bodies = (encode(message(kind=Kind.HELLO, arrays=(), sequence=sequence))[:-5] for sequence in range(10_000))
    payload = next(payload for body in bodies if (payload := sealed(body))[-4:-3] == b"2")
    door = checker()
    assert door.accept(payload) is None
    assert door.counts == {Reason.SHAPE: 1}


def test_infinity_passes_where_it_is_due() -> None:
    door = checker()
    assert door.accept(encode(message(source="a3", arrays=(np.zeros((1, 2)), np.array([math.inf, -math.inf]))))) is not None
    assert door.accept(encode(message(source="a4", arrays=(np.array([2.0, 1.0]),)))) is not None


def test_largest_is_a_limit_of_each_array() -> None:
    door = Checker("a2", {"a1": {Kind.STATE: [Numbers((1,), 10.0), Numbers((1,), 20.0)]}}, PROBLEM)
    for sequence, (first, second, passes) in enumerate([(10, -20, True), (10.1, 0, False), (0, 20.1, False), (-10, 20, True)]):
        got = door.accept(encode(message(sequence=sequence, arrays=(np.array([first]), np.array([second])))))
        assert (got is not None) == passes
    assert door.counts == {Reason.NUMBER: 2}


def test_largest_may_differ_by_column() -> None:
    door = Checker("a2", {"a1": {Kind.STATE: [Numbers((2, 2), (10.0, math.inf))]}}, PROBLEM)
    good, bad = np.array([[9.0, math.inf], [-9.0, -math.inf]]), np.array([[9.0, 0.0], [11.0, 0.0]])
    assert door.accept(encode(message(arrays=(good,)))) is not None
    assert door.accept(encode(message(sequence=8, arrays=(bad,)))) is None
    assert door.accept(encode(message(sequence=9, arrays=(np.full((2, 2), math.nan),)))) is None


def test_claims_tells_whose_name_is_on_it() -> None:
    payload = encode(message())
    assert claims(payload, "a1")
    assert not claims(payload, "a")
    assert not claims(payload, "a1a")
    assert not claims(payload, "a2")
    assert not claims(b"", "a1")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"problem": b"short"}, "problem hash of 8 bytes"),
        ({"sequence": -1}, r"integers in 0 … 2⁶⁴ − 1"),
        ({"incarnation": 2**64}, r"integers in 0 … 2⁶⁴ − 1"),
        ({"ack": 1.5}, r"integers in 0 … 2⁶⁴ − 1"),
        ({"source": ""}, "1 to 1024 bytes"),
        ({"destination": "x" * 1025}, "1 to 1024 bytes"),
        ({"source": "\ud800"}, "UTF-8"),
        ({"arrays": (np.zeros((1, 1, 1)),)}, "vectors or matrices"),
        ({"arrays": (np.zeros(1),) * 33}, "at most 32 arrays"),
        ({"arrays": (np.zeros(LONGEST // 8),)}, "longest allowed"),
    ],
    ids=["problem", "negative", "2⁶⁴", "fraction", "no name", "long name", "surrogate", "three axes", "33 arrays", "4 MiB"],
)
def test_what_cannot_be_written_is_an_error(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(NetworkError, match=words):
        encode(message(**changes))


def passes(door: Checker, incarnation: int, *sequences: int) -> list[bool]:
    return [door.accept(encode(message(incarnation=incarnation, sequence=sequence))) is not None for sequence in sequences]


def test_only_newer_messages_pass() -> None:
    door = checker()
    assert passes(door, 1, 5, 7, 6, 7, 8) == [True, True, False, False, True]
    assert door.counts == {Reason.STALE: 1, Reason.DUPLICATE: 1}
    assert passes(door, 2, 1, 2) == [True, True], "restarted"
    assert passes(door, 1, 9, 10) == [False, False], "what the earlier incarnation sent, late"


def test_neighbours_do_not_touch_each_others_numbers() -> None:
    door = checker()
    assert passes(door, 9, 1000) == [True]
    assert door.accept(encode(message(source="a3", incarnation=1, sequence=1, arrays=(np.zeros((1, 2)), np.zeros(2))))) is not None


def test_forged_sequence_is_not_believed() -> None:
    door = checker()
    assert passes(door, 1, 1, 2**63, 2**64 - 1, AHEAD + 2, 2) == [True, False, False, False, True]
    assert door.counts == {Reason.JUMP: 3}


@pytest.mark.parametrize("forged", [(1, 2**63), (2**63, 0), (2**64 - 1, 2**64 - 1), (2, 2**64 - 1)], ids=str)
@pytest.mark.parametrize("first", [True, False], ids=["at the very start", "later"])
def test_forged_numbers_mute_nobody_for_good(forged: tuple[int, int], first: bool) -> None:
    """A neighbour that sends 20 messages a second is heard again within `QUIET` and `SUPPORT` messages, whatever was forged."""
    clock = Clock()
    door = checker(clock=clock)
    if not first:
        assert passes(door, 1, 100) == [True]
    passes(door, forged[0], forged[1])
    heard = []
    for step in range(40):
        clock.now += 0.05
        heard += passes(door, 1, 101 + step)
    assert all(heard[math.ceil(QUIET / 0.05) + SUPPORT :])
    assert passes(door, 1, 110) == [False], "and then the order counts as ever"


def test_a_neighbour_whose_clock_went_back_is_heard_again() -> None:
    """Its incarnations, if made from a clock, are smaller after such a restart."""
    clock = Clock()
    door = checker(clock=clock)
    assert passes(door, 1_700_000_000, 55) == [True]
    clock.now += 2 * QUIET
    assert passes(door, 5, 1, 2, 3, 4) == [False, False, True, True]


def test_resent_messages_of_a_neighbour_in_lockstep_count_as_support() -> None:
    """It stands still until it is heard, and says the same again and again."""
    clock = Clock()
    door = checker(clock=clock)
    passes(door, 2**63, 0)
    clock.now += 2 * QUIET
    assert passes(door, 1, 7, 7, 7) == [False, False, True]


def test_old_messages_in_a_burst_do_not_turn_back_the_numbers() -> None:
    clock = Clock()
    door = checker(clock=clock)
    assert passes(door, 1, 100) == [True]
    clock.now += 0.9 * QUIET
    assert passes(door, 1, *range(50, 99)) == [False] * 49
    assert passes(door, 1, 101) == [True]


def test_rivals_that_do_not_agree_are_not_believed() -> None:
    clock = Clock()
    door = checker(clock=clock)
    assert passes(door, 10, 100) == [True]
    clock.now += 10 * QUIET
    assert not any(passes(door, 1, 30, 20, 10)), "backwards"
    assert not any(passes(door, incarnation, 5)[0] for incarnation in (2, 3, 4)), "of many incarnations"


def test_a_far_jump_after_a_long_outage_is_believed_in_the_end() -> None:
    clock = Clock()
    door = checker(clock=clock)
    assert passes(door, 1, 1) == [True]
    clock.now += 3600
    assert passes(door, 1, *range(2 * AHEAD, 2 * AHEAD + 4)) == [False, False, True, True]


def test_duplicates_stay_duplicates_however_quiet_it_is() -> None:
    clock = Clock()
    door = checker(clock=clock)
    assert passes(door, 1, 5) == [True]
    clock.now += 100 * QUIET
    assert passes(door, 1, *[5] * 10) == [False] * 10
    assert door.counts == {Reason.DUPLICATE: 10}


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 6)), max_size=40))
def test_without_quiet_what_passes_only_ever_grows(numbers: list[tuple[int, int]]) -> None:
    door = checker(clock=lambda: 0.0)
    accepted = [pair for pair in numbers if passes(door, *pair)[0]]
    assert accepted == sorted(set(accepted))
    assert door.counts.total() == len(numbers) - len(accepted)


def test_expectations_that_no_message_can_meet_are_an_error() -> None:
    for shapes in ([(1, 2, 3)], [()], [(2**23, 2**23)], [(LONGEST,)], [(1,)] * 33):
        with pytest.raises(NetworkError, match="arrays"):
            checker({"a1": {Kind.STATE: shapes}})


def test_largest_float_is_finite() -> None:
    """The default limit lets every finite number pass."""
    door = checker()
    assert door.accept(encode(message(arrays=(np.array([sys.float_info.max, -sys.float_info.max]),)))) is not None

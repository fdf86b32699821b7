"""Mutated messages; `benchmarks/wire_fuzz.py` sends a million."""

from __future__ import annotations

import random
import tracemalloc
import zlib

import pytest

from consat.network.wire import Checker, Reason
from tests.networked import fuzzing


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_crashes_nothing_bad_gets_in_and_memory_is_bounded(seed: int) -> None:
    tally = fuzzing.run(20_000, seed)
    assert tally.accepted > 1000
    assert set(Reason) <= set(tally.reasons), "the mutations must reach every check"
    half = len(tally.held) // 2
    assert max(tally.held[half:]) <= max(tally.held[:half]) + 200, "what a checker holds depends on its neighbours only"


def test_memory_is_bounded_outside_of_the_checker_too() -> None:
    stream = iter(fuzzing.Mutator(2))
    payloads = [next(stream) for _ in range(6_000)]
    checker = Checker(fuzzing.ME, fuzzing.EXPECTED, fuzzing.PROBLEM, quiet=0.0)
    tracemalloc.start()
    try:
        for payload in payloads[:1000]:
            checker.accept(payload)
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        for payload in payloads[1000:]:
            checker.accept(payload)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 2_000
    assert peak - before < 150_000, "a forged length cuts out at most 64 KiB for a name, for a moment"


def test_second_opinion_has_a_crc_of_its_own() -> None:
    data = random.Random(0).randbytes(1000)  # noqa: S311
    assert fuzzing.crc(data) == zlib.crc32(data)


def test_fuzzing_finds_a_checker_that_overlooks_something(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: without a view at the checksum, the two disagree soon."""
    honest = Checker._broken

    def lax(self: Checker, payload: bytes) -> Reason | None:
        found = honest(self, payload)
        return None if found is Reason.CHECKSUM else found

    monkeypatch.setattr(Checker, "_broken", lax)
    with pytest.raises(AssertionError, match="accepted, but must not be"):
        fuzzing.run(5_000, 0)

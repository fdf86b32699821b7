"""A million mutated messages at an agent's door.

    python benchmarks/wire_fuzz.py [--messages 1000000] [--seed 0]

Exits with an error on the first message that is accepted but should not be, or the other way, by the second opinion of
`tests/networked/fuzzing.py`; else it prints what came of them, and how long encoding and checking a message of 6 numbers takes.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from consat.network.wire import Checker, Kind, Message, encode
from tests.networked import fuzzing


def speed(count: int = 100_000) -> tuple[float, float]:
    """µs to encode and to check a message of 6 numbers."""
    checker = Checker("a2", {"a1": {Kind.STATE: [(2, 2), (2,)]}}, bytes(8))
    arrays = np.ones((2, 2)), np.ones(2)
    began = time.perf_counter()
    payloads = [encode(Message(Kind.STATE, bytes(8), "a1", "a2", 1, k, 0.0, math.nan, k, 5.0, arrays)) for k in range(1, count + 1)]
    encoded = time.perf_counter()
    accepted = sum(checker.accept(payload) is not None for payload in payloads)
    checked = time.perf_counter()
    assert accepted == count
    return (encoded - began) / count * 1e6, (checked - encoded) / count * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    began = time.perf_counter()
    fuzzing.run(10_000, options.seed + 1)
    warm = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tally = fuzzing.run(options.messages, options.seed)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - warm
    print(f"{tally.messages} messages, seed {options.seed}: {tally.accepted} accepted, every answer as the second opinion's")
    print("dropped:", ", ".join(f"{reason} {times}" for reason, times in tally.reasons.most_common()))
    quarter = len(tally.held) // 4
    print(
        f"a checker that saw all of them held at most {max(tally.held[:quarter])} bytes in the first quarter, {max(tally.held[-quarter:])} in"
    )
    print(f"the last; the largest resident set of the process grew by {grown} kB (the tally itself and longer random messages among it)")
    print(f"{tally.seconds / tally.messages * 1e6:.1f} µs a message at the door; {time.perf_counter() - began:.0f} s in all")
    print("6 numbers: {:.1f} µs to encode, {:.1f} µs to check".format(*speed()))


if __name__ == "__main__":
    main()

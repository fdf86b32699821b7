"""A batch of runs beside the same runs one by one, warm, in one process.

    python benchmarks/sweep.py [--runs 1000] [--singles 200] [--scenario case-c]

The single runs are timed over fewer seeds than the batch, spread over its length, and scaled; they are checked to be the batch's.
"""

from __future__ import annotations

import argparse
import os
import platform
import time

import jax

import consat as cs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--singles", type=int, default=200)
    parser.add_argument("--scenario", default="case-c")
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    scenario = cs.load(asked.scenario)
    print(f"{os.cpu_count()} cores, Python {platform.python_version()}, JAX {jax.__version__}, consat {cs.__version__}\n")

    began = time.perf_counter()
    batch = cs.sweep(scenario, seeds=asked.runs)
    cold = time.perf_counter() - began
    cs.run(scenario)
    warm, single, inner = [], [], 0.0
    for repeat in range(asked.repeats):  # in turn, so that both see the same machine
        began = time.perf_counter()
        batch = cs.sweep(scenario, seeds=asked.runs)
        warm.append(time.perf_counter() - began)
        seeds = range(repeat, asked.runs, max(1, asked.runs * asked.repeats // asked.singles))
        began = time.perf_counter()
        results = [cs.run(scenario, seed=seed).summary for seed in seeds]
        single.append((time.perf_counter() - began) / len(seeds) * asked.runs)
        inner += sum(summary["seconds"]["run"] for summary in results) / len(seeds) * asked.runs / asked.repeats
        off = max(abs(batch.runs[seed]["margin"] - summary["margin"]) for seed, summary in zip(seeds, results, strict=True))
        assert all(batch.runs[seed]["rounds"] == summary["rounds"] for seed, summary in zip(seeds, results, strict=True))
        assert off < 1e-9, off
    warm.sort()
    single.sort()
    one, many = warm[len(warm) // 2], single[len(single) // 2]
    print(f"| {asked.runs} runs of {asked.scenario}, admm | s | against the batch |\n|---|---|---|")
    print(f"| one batch, warm | {one:.2f} | 1 |")
    print(f"| one batch, first time, compiling included | {cold:.2f} | {cold / one:.1f} |")
    print(f"| `consat.run` each, warm | {many:.1f} | {many / one:.1f} |")
    print(f"| of these, the rounds alone | {inner:.1f} | {inner / one:.1f} |")


if __name__ == "__main__":
    main()

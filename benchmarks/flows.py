"""The paper's flow: warm time against SciPy's LSODA, cold time from the shell, and 200 starts as one batch against 200 runs.

    python benchmarks/flows.py [--repeats 5] [--starts 200]

Everything is timed in one run on one machine; medians over repeats. Compare, don't quote absolute times.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import consat as cs
from consat.engine.flows import CHUNK, Observer, Problem, _advanced
from consat.engine.recording import Choice
from consat.numerics import float64
from consat.problem.objective import SmoothingSchedule
from consat.protocols import GradientFlow
from consat.protocols.estimates import Estimates
from tests import paper

UNTIL = 300.0


def median(repeats: int, function: Callable[[], object]) -> float:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def warm(repeats: int) -> None:
    print("\n## Warm, gradient-flow, full estimates, to t = 300 s, 3001 samples\n")
    print("| case | consat, s | SciPy LSODA, s | LSODA/consat | largest difference |\n|---|---|---|---|---|")
    for case in paper.CASES:
        scenario = cs.load(case)

        def ours(scenario: cs.Scenario = scenario) -> cs.Result:
            return cs.run(scenario, protocol="gradient-flow", estimates="full", until=UNTIL, record=True)

        data = ours().data
        first, times = data["estimate"].values[0].reshape(3, 3, 2), data["time"].values
        theirs = paper.integrate(case, "gradient-flow", first, times, rtol=1e-7, atol=1e-9)
        off = np.abs(data["estimate"].values.reshape(-1, 3, 3, 2) - theirs[0]).max()
        mine = median(repeats, ours)
        scipy = median(
            repeats, lambda case=case, first=first, times=times: paper.integrate(case, "gradient-flow", first, times, rtol=1e-7, atol=1e-9)
        )
        print(f"| {case} | {mine:.3f} | {scipy:.3f} | {scipy / mine:.1f} | {off:.0e} |", flush=True)


def cold(repeats: int) -> None:
    print("\n## Cold, from the shell: seconds until the answer is printed\n")
    print("| command | first time | after |\n|---|---|---|")
    consat = shutil.which("consat") or str(Path(sys.executable).with_name("consat"))
    for options in ([], ["--protocol", "gradient-flow"]):
        with tempfile.TemporaryDirectory() as cache:
            command = [consat, "run", "case-a", "--json", *options]
            environment = os.environ | {"XDG_CACHE_HOME": cache}
            times = []
            for _ in range(repeats + 1):
                begin = time.perf_counter()
                subprocess.run(command, env=environment, check=True, capture_output=True)
                times.append(time.perf_counter() - begin)
        print(f"| `consat run case-a --json {' '.join(options)}` | {times[0]:.1f} | {statistics.median(times[1:]):.1f} |", flush=True)


@float64
def batch(starts: int) -> None:
    print(f"\n## {starts} random starts of case C to t = 300 s\n")
    team, settings = cs.load("case-c").team, cs.load("case-c").settings
    copies, flow = Estimates.of(team, "full"), GradientFlow()
    problem = Problem.of(team, copies, SmoothingSchedule.of(settings.smoothing))
    observer = Observer.of(team, copies, Choice.of(team, copies))
    first = jnp.asarray(np.random.default_rng(0).uniform(-4, 4, (starts, copies.count, 2)))
    times = [jnp.asarray(part) for part in np.linspace(0, UNTIL, 3001)[np.arange(0, 3000, CHUNK)[:, None] + np.arange(CHUNK + 1)]]
    together = jax.jit(lambda states, times: jax.vmap(lambda state: _advanced.__wrapped__(flow, problem, observer, state, times))(states))

    def singles() -> None:
        for x in first:
            state = flow.start(x)
            for part in times:
                state = _advanced(flow, problem, observer, state, part).state
        jax.block_until_ready(state)

    def as_one() -> None:
        state = jax.vmap(flow.start)(first)
        for part in times:
            _, state, *_ = together(state, part)
        jax.block_until_ready(state)

    jax.block_until_ready(_advanced(flow, problem, observer, flow.start(first[0]), times[0]))
    jax.block_until_ready(together(jax.vmap(flow.start)(first), times[0]))
    one, many = median(1, as_one), median(1, singles)
    print(f"one batch (adaptive, implicit, vmap): {one:.1f} s; {starts} warm runs: {many:.1f} s; runs/batch {many / one:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--starts", type=int, default=200)
    chosen = parser.parse_args()
    print(f"{os.cpu_count()} cores, Python {platform.python_version()}, JAX {jax.__version__}, consat {cs.__version__}")
    warm(chosen.repeats)
    cold(chosen.repeats)
    batch(chosen.starts)


if __name__ == "__main__":
    main()

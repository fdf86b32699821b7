"""Seconds a round and bytes an agent for teams of a thousand to a million, beside the time of copying their state once.

    python benchmarks/scale.py [--most 1000000] [--teams convoy lattice swarm] [--out docs/benchmarks]

Writes ``scale.md``, ``scale.png``, and ``scale.json``, from which teams that are not asked for are taken as last measured. Each team has a process to itself, so that its peak of memory is its own, and runs until it is
satisfied; its rounds are warm then, and are timed in blocks, each beside an out-of-place `numpy.copyto` of as many bytes as the state has.
So are steps of the paper's gradient flow over the same estimates, beside a copy of theirs. An exponent is the slope of the line through the
times of the sizes from `LINEAR` on, in logarithms. Then `consat run` from the shell, everything included. Last, agent-updates a second of
small teams (chains, every agent estimating all, as in the paper): the gradient flow by fixed steps, beside the same in plain NumPy.
"""

from __future__ import annotations

import argparse
import datetime
import json
import multiprocessing
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import consat as cs
from consat.certify.quadratics import shape_of
from consat.engine import round as kernel
from consat.engine.chunks import CHUNK
from consat.engine.flows import Problem, rate
from consat.engine.world import World, world_of
from consat.faults import Faults
from consat.numerics import float64, thorough_compilation
from consat.problem.objective import Nu, SmoothingSchedule
from consat.problem.units import automatic, scale
from consat.protocols import FLOWS, ROUNDS, State
from consat.protocols.estimates import Estimates
from consat.runs.preparation import first_estimates

TEAMS = ("convoy", "lattice", "swarm")
COUNTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
LINEAR = 3_000
"""Agents from which on the exponent is fitted: smaller teams solve every local step exactly."""
MOST_ROUNDS = 150
BLOCK = CHUNK
"""Rounds, or steps of the flow, that are timed together: a run has as many in one program."""
BLOCKS = 7
"""Blocks timed; the median counts, as the machine may be busy with other things meanwhile."""
STEP = 0.01
"""Of the gradient flow, s."""
COLORS = {"convoy": "#0072B2", "lattice": "#D55E00", "swarm": "#009E73"}
MARKERS = {"convoy": "o", "lattice": "s", "swarm": "^"}
SHELL = ("convoy", "lattice")
"""Teams that are run from the shell as well; a swarm is the same but for its minutes."""
SMALL = (3, 10, 50, 200)
FLOW = FLOWS["gradient-flow"]()


class Row(NamedTuple):
    """Of one team: seconds to build and to compile, the first round from which it is satisfied, seconds a warm round, a copy of its state and
    of a flow's, a step of the flow; bytes of state and of the process at its peak."""

    team: str
    agents: int
    build: float
    compile: float
    satisfied: int | None
    round: float
    copy: float
    step: float
    step_copy: float
    state: int
    peak: int

    @property
    def ratio(self) -> float:
        return self.round / self.copy

    @property
    def step_ratio(self) -> float:
        return self.step / self.step_copy


def beside_a_copy(advance: Callable[[Any], Any], state: Any) -> tuple[float, float, int, Any]:
    """Seconds a step of `advance`, which takes `BLOCK` of them, seconds of copying what it carries, and how many bytes these are."""
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    source, target, taken, copied = np.ones(size // 8), np.zeros(size // 8), [], []
    for _ in range(BLOCKS):
        begin = time.perf_counter()
        state = jax.block_until_ready(advance(state))
        taken.append((time.perf_counter() - begin) / BLOCK)
        begin = time.perf_counter()
        np.copyto(target, source)
        copied.append(time.perf_counter() - begin)
    return float(np.median(taken)), float(np.median(copied)), size, state


@float64
def measure(name: str, count: int) -> Row:
    begin = time.perf_counter()
    scenario = cs.load(name, [f"count={count}"])
    team, size = scenario.team, scale(scenario.team)
    copies, nu = Estimates.of(team, "local"), SmoothingSchedule.of(automatic(size)).final
    convex = bool(shape_of(team).concave.all())
    world = world_of(team, copies, nu, size, convex=convex, faults=Faults(), body=None)
    first = jnp.asarray(first_estimates(team, copies, scenario.settings.start, size))
    build, begin = time.perf_counter() - begin, time.perf_counter()
    protocol = ROUNDS["admm"]()

    def rounds(world: World, now: kernel.Now, number: jax.Array) -> tuple[kernel.Now, jax.Array]:
        return kernel.many_rounds(protocol, world, now, number + jnp.arange(BLOCK, dtype=float), lambda seen: seen.margin)

    now, _ = jax.jit(kernel.begin, static_argnames=("protocol",))(protocol, world, first, jax.random.key(0))
    several = jax.jit(rounds, donate_argnums=1).lower(world, now, jnp.asarray(0.0)).compile(compiler_options=thorough_compilation())
    compiled = time.perf_counter() - begin
    margins: list[float] = []
    while len(margins) < MOST_ROUNDS and not (margins and min(margins[-BLOCK:]) > 0):
        now, margin = several(world, now, jnp.asarray(float(len(margins))))
        margins += np.asarray(margin).tolist()
    last_bad = max((k for k, margin in enumerate(margins) if margin <= 0), default=-1)
    satisfied = last_bad + 2 if margins[-1] > 0 else None  # round k is the k-th after the start
    later = jnp.asarray(float(len(margins)))
    round_, copy, state, now = beside_a_copy(lambda at: several(world, at, later)[0], now)
    step, step_copy = flow_steps(team, copies, nu, now.state.x)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Row(name, count, build, compiled, satisfied, round_, copy, step, step_copy, state, peak)


def flow_steps(team: cs.Team, copies: Estimates, nu: Nu, x: jax.Array) -> tuple[float, float]:
    """Seconds an explicit step of the gradient flow over local estimates, from x, and seconds of copying its state."""
    problem = Problem.of(team, copies, SmoothingSchedule.of(cs.Smoothing(nu_alpha=float(nu.alpha), nu_beta=1.0)))
    start = FLOW.start(x + 0.0)
    several = flow_program(problem, start, BLOCK)
    step, copy, _, _ = beside_a_copy(lambda at: several(problem, at), start)
    return step, copy


def flow_program(problem: Problem, start: State, steps: int) -> Callable[[Problem, State], State]:
    """So many explicit steps of the gradient flow, compiled; the state is given up."""

    def once(problem: Problem, at: State) -> State:
        slope = rate(FLOW, problem, jnp.asarray(0.0), at)
        return State(at.x + STEP * slope.x, at.z + STEP * slope.z)

    def many(problem: Problem, at: State) -> State:
        return jax.lax.fori_loop(0, steps, lambda _, at: once(problem, at), at)

    return jax.jit(many, donate_argnums=1).lower(problem, start).compile(compiler_options=thorough_compilation())


@float64
def small(count: int, seconds: float = 1.0) -> tuple[float, float]:
    """Agent-updates a second of the gradient flow, ẋ = −∇f − (Lx) − z, ż = Lx, every agent estimating all: consat's and NumPy's."""
    team = cs.load("convoy", [f"count={count}"]).team
    copies = Estimates.of(team, "full")
    problem = Problem.of(team, copies, SmoothingSchedule.of(cs.Smoothing(nu_alpha=1.0, nu_beta=1.0)))
    steps = 200
    state = FLOW.start(jnp.asarray(np.random.default_rng(0).uniform(1.5, 2.5, (copies.count, 2))))
    many = flow_program(problem, state, steps)
    state = jax.block_until_ready(many(problem, state))
    begin, done = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        state = jax.block_until_ready(many(problem, state))
        done += steps
    return done * count / (time.perf_counter() - begin), _plain(count, seconds)


def _plain(count: int, seconds: float) -> float:
    rng = np.random.default_rng(0)
    x, z = rng.uniform(1.5, 2.5, (count, count, 2)), np.zeros((count, count, 2))
    i = np.arange(count)
    begin, done = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        for _ in range(50):
            own, ahead = x[i, i], x[i[1:], i[1:] - 1]
            psi = np.concatenate([[1 - np.sum((own[0] - [2, 0]) ** 2)], 1 - np.sum((own[1:] - ahead) ** 2, axis=1)])
            f = np.exp(-psi)
            force = np.zeros_like(x)
            force[0, 0] = -2 * f[0] * (own[0] - [2, 0])
            force[i[1:], i[1:]] = -2 * f[1:, None] * (own[1:] - ahead)
            force[i[1:], i[1:] - 1] = 2 * f[1:, None] * (own[1:] - ahead)
            away = np.zeros_like(x)
            away[1:] += x[1:] - x[:-1]
            away[:-1] += x[:-1] - x[1:]
            x, z = x + STEP * (force - away - z), z + STEP * away
        done += 50
    return done * count / (time.perf_counter() - begin)


def from_the_shell(name: str, count: int) -> tuple[float, float, dict[str, Any]]:
    """Seconds and the peak of memory, bytes, of `consat run`, and what it says."""
    command = [sys.executable, "-m", "consat", "run", name, "--set", f"count={count}", "--json"]
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    said = json.loads(process.stdout.read())
    _, _, used = os.wait4(process.pid, 0)
    return time.perf_counter() - begin, used.ru_maxrss * 1024, said


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function gives in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def exponent(rows: Sequence[Row]) -> float:
    large = [row for row in rows if row.agents >= LINEAR]
    return (
        float(np.polyfit(np.log([row.agents for row in large]), np.log([row.round for row in large]), 1)[0]) if len(large) > 1 else np.nan
    )


def draw(rows: Sequence[Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for name in dict.fromkeys(row.team for row in rows):
        mine = [row for row in rows if row.team == name]
        agents, style = [row.agents for row in mine], {"color": COLORS[name], "marker": MARKERS[name]}
        left.loglog(agents, [1e3 * row.round for row in mine], label=f"{name}: slope {exponent(mine):.2f}", **style)
        left.loglog(agents, [1e3 * row.copy for row in mine], ":", color=COLORS[name])
        right.loglog(agents, [row.state / row.agents for row in mine], label=f"{name}: state", **style)
        right.loglog(agents, [row.peak / row.agents for row in mine], ":", color=COLORS[name], label=f"{name}: peak of the process")
    left.set(xlabel="agents", ylabel="ms", title="A warm round of admm (dotted: copying the state once)")
    right.set(xlabel="agents", ylabel="bytes an agent", title="Memory")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=9)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=COUNTS[-1])
    parser.add_argument("--teams", nargs="+", choices=TEAMS, default=TEAMS)
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    asked = parser.parse_args()
    counts = [count for count in COUNTS if count <= asked.most]
    lines: list[str] = []
    asked.out.mkdir(parents=True, exist_ok=True)

    def say(line: str = "") -> None:
        lines.append(line)
        print(line, flush=True)

    say("# A thousand to a million agents\n")
    say(
        f"`python benchmarks/scale.py` on {datetime.date.today()}: {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"JAX {jax.__version__}, NumPy {np.__version__}, consat {cs.__version__}, float64. Medians of {BLOCKS}.\n"
    )
    say("![milliseconds a round and bytes an agent, against the number of agents](scale.png)\n")
    say("Protocol `admm` over local estimates. Satisfied: the first round after the last with a margin ≤ 0.\n")
    if earlier := ", ".join(name for name in TEAMS if name not in asked.teams):
        say(f"Measured before, with the same command: {earlier}.\n")
    say(
        "| team | agents | build, s | compile, s | satisfied from round | ms a warm round | × copying its state | ms a step of the flow "
        "| × copying its state | bytes of state an agent | peak, GiB |"
    )
    say("|---|---|---|---|---|---|---|---|---|---|---|")
    rows: list[Row] = []
    kept = asked.out / "scale.json"
    last = [Row(**row) for row in json.loads(kept.read_text())] if kept.exists() else []
    for name in TEAMS:
        measured = (alone(measure, name, count) for count in counts) if name in asked.teams else (row for row in last if row.team == name)
        for row in measured:
            rows.append(row)
            say(
                f"| {name} | {row.agents:,} | {row.build:.2f} | {row.compile:.1f} | {row.satisfied or '–'} | {1e3 * row.round:.2f} "
                f"| {row.ratio:.1f} | {1e3 * row.step:.2f} | {row.step_ratio:.1f} | {row.state / row.agents:.0f} | {row.peak / 2**30:.2f} |"
            )
    say()
    for name in dict.fromkeys(row.team for row in rows):
        say(f"* {name}: a round takes time ∝ N^{exponent([row for row in rows if row.team == name]):.2f} from N = {LINEAR:,} on.")
    kept.write_text(json.dumps([row._asdict() for row in rows], indent=1) + "\n")
    draw(rows, asked.out / "scale.png")
    say("\n## From the shell\n\nThe second run of `consat run TEAM --set count=N --json`, importing, compiling and certifying included.\n")
    say("| team | agents | s | peak, GiB | status | satisfied from round | rounds |\n|---|---|---|---|---|---|---|")
    for name in SHELL:
        most = max((row.agents for row in rows if row.team == name), default=counts[-1])
        from_the_shell(name, most)  # compiles
        seconds, peak, said = from_the_shell(name, most)
        say(
            f"| {name} | {most:,} | {seconds:.1f} | {peak / 2**30:.2f} | {said['status']} | {said['satisfied_from']['round']} "
            f"| {said['rounds']} |"
        )
    say("\n## Small teams\n\nGradient flow by fixed steps, chain, every agent estimating all: agent-updates a second.\n")
    say("| agents | consat | plain NumPy |\n|---|---|---|")
    for count in SMALL:
        ours, plain = alone(small, count)
        say(f"| {count} | {ours:,.0f} | {plain:,.0f} |")
    (asked.out / "scale.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

"""Seconds a round and bytes an agent for teams of a thousand to a million, beside the time of copying their state once.

    python benchmarks/scale.py [--most 1000000] [--out docs/figures/scale.png]

Prints a table, and draws it. Every team runs until it is satisfied; then its rounds are warm, and are timed, each beside an out-of-place
`numpy.copyto` of as many bytes as the state has. The exponent is the slope of the line through the times of all sizes. Below, the
agent-updates a second of the paper's gradient flow (chain, full estimates, fixed steps), beside the same in plain NumPy.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import consat as cs
from consat.estimates import Estimates
from consat.numerics import float64
from consat.objective import Objective, Schedule
from consat.preparation import first_estimates
from consat.protocols import ROUNDS
from consat.quadratics import shape_of
from consat.scale import automatic, scale
from consat.simulate import kernel

MOST_ROUNDS = 100
TIMED = 7
"""Warm rounds timed; the median counts, and the machine may be busy with other things meanwhile."""
STEP = 0.01
"""Of the gradient flow, s."""


class Row(NamedTuple):
    """Of one team."""

    name: str
    agents: int
    build: float
    compile: float
    satisfied: int | None
    round: float
    copy: float
    state: int
    peak: int


def timed(function: Callable[[], object]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - begin


@float64
def measure(name: str, count: int) -> Row:
    begin = time.perf_counter()
    scenario = cs.load(name, [f"count={count}"])
    team, size = scenario.team, scale(scenario.team)
    copies, nu = Estimates.of(team, "local"), Schedule.of(automatic(size)).final
    convex = bool(shape_of(team).concave.all())
    world = kernel.world_of(team, copies, nu, size.length, convex=convex, weather=kernel.Weather(), body=None)
    first = jnp.asarray(first_estimates(team, copies, scenario.settings.start, size))
    build, begin = time.perf_counter() - begin, time.perf_counter()
    protocol = ROUNDS["admm"]()
    now, seen = jax.jit(kernel.begin, static_argnames=("protocol",))(protocol, world, first, jax.random.key(0))
    step = jax.jit(kernel.one_round, static_argnames=("protocol",), donate_argnames=("now",))
    one = step.lower(protocol, world, now, jnp.asarray(0.0)).compile()
    compiled = time.perf_counter() - begin
    satisfied, number = None, 0
    while number < MOST_ROUNDS and satisfied is None:
        now, seen = one(world, now, jnp.asarray(float(number)))
        number += 1
        satisfied = number if float(seen.margin) > 0 else None
    for _ in range(3):
        now, seen = one(world, now, jnp.asarray(float(number)))
        number += 1
    state = sum(leaf.nbytes for leaf in jax.tree.leaves((now.state, now.ages, now.body)))
    source, target, rounds, copying = np.ones(state // 8), np.zeros(state // 8), [], []
    for _ in range(TIMED):
        begin = time.perf_counter()
        now, seen = jax.block_until_ready(one(world, now, jnp.asarray(float(number))))
        rounds.append(time.perf_counter() - begin)
        copying.append(timed(lambda: np.copyto(target, source)))
        number += 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Row(name, count, build, compiled, satisfied, float(np.median(rounds)), float(np.median(copying)), state, peak)


@float64
def flow(count: int, seconds: float = 1.0) -> tuple[float, float]:
    """Agent-updates a second of the gradient flow, ẋ = −∇f − (Lx) − z, ż = Lx, every agent estimating all: consat's and NumPy's."""
    team = cs.load("convoy", [f"count={count}"]).team
    copies = Estimates.of(team, "full")
    objective = Objective.of(team, lambda family: copies.rows(family.owner[:, None], family.agents), copies.count)
    exchange, nu = copies.exchange(), Schedule.of(cs.Smoothing(nu_alpha=1.0, nu_beta=1.0)).final
    steps = 200

    @jax.jit
    def many(objective: Objective, exchange: object, x: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        def once(_: int, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, z = at
            level, ascent = objective.ascent(x, nu)
            away = exchange.disagreement(x)  # type: ignore[attr-defined]
            force = nu.beta * jnp.exp(level)[copies.holder][:, None] * ascent
            return x + STEP * (force - away - z), z + STEP * away

        return jax.lax.fori_loop(0, steps, once, (x, z))

    x = jnp.asarray(np.random.default_rng(0).uniform(1.5, 2.5, (copies.count, 2)))
    x, z = jax.block_until_ready(many(objective, exchange, x, jnp.zeros_like(x)))
    begin, done = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        x, z = jax.block_until_ready(many(objective, exchange, x, z))
        done += steps
    ours = done * count / (time.perf_counter() - begin)
    return ours, _plain(count, seconds)


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


def exponent(rows: list[Row]) -> float:
    return float(np.polyfit(np.log([row.agents for row in rows]), np.log([row.round for row in rows]), 1)[0])


def draw(rows: list[Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for name in dict.fromkeys(row.name for row in rows):
        mine = [row for row in rows if row.name == name]
        agents = [row.agents for row in mine]
        left.loglog(agents, [row.round for row in mine], "o-", label=f"{name}, exponent {exponent(mine):.2f}")
        left.loglog(agents, [row.copy for row in mine], ":", color=left.lines[-1].get_color())
        right.loglog(agents, [row.state / row.agents for row in mine], "o-", label=name)
    left.set(xlabel="agents", ylabel="seconds a round", title="A warm round (dotted: copying the state once)")
    right.set(xlabel="agents", ylabel="bytes of state an agent", title="State", ylim=(50, 2000))
    left.legend()
    right.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--most", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=Path("docs/figures/scale.png"))
    asked = parser.parse_args()
    counts = [count for count in (3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000) if count <= asked.most]
    print(
        "| team | agents | build, s | compile, s | satisfied from round | ms a round | × copying the state | bytes an agent | peak, GiB |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    rows = []
    for name in ("convoy", "lattice", "swarm"):
        for count in counts:
            row = measure(name, count)
            rows.append(row)
            print(
                f"| {name} | {count:,} | {row.build:.2f} | {row.compile:.1f} | {row.satisfied} | {1e3 * row.round:.2f} "
                f"| {row.round / row.copy:.1f} | {row.state / count:.0f} | {row.peak / 2**30:.2f} |",
                flush=True,
            )
    for name in ("convoy", "lattice", "swarm"):
        print(f"exponent of {name}: {exponent([row for row in rows if row.name == name]):.3f}")
    print("\n| agents | gradient flow, agent-updates a second | plain NumPy |\n|---|---|---|")
    for count in (3, 10, 50, 200):
        ours, plain = flow(count)
        print(f"| {count} | {ours:,.0f} | {plain:,.0f} |", flush=True)
    draw(rows, asked.out)


if __name__ == "__main__":
    main()

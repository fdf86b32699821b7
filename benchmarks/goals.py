"""Rounds of the default protocol over many seeds, against the design's goals: medians and 95th percentiles.

    python benchmarks/goals.py [--quick] [--out docs/benchmarks]

Writes ``goals.md``. Teams that cannot be satisfied: rounds until the margin stays within 5 %, and within 1e-3, of the best one, by hops D across
the team. Teams that can: rounds to satisfaction for good, from near and far. One round is one message over each link in each direction. The
instances of a family run at once, as the clusters of one team.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
from families import FAMILIES, Builder, Family, Instance
from infeasible import EXACT, PLAINLY, ROUGH, instance
from jax import Array
from rounds import CHUNK, Condition, Stage, _look, _start, for_good, machine, table

import consat as cs
from consat.certify.optimum import cluster_margins, max_min
from consat.certify.quadratics import values_and_gradients
from consat.engine.round import many_rounds
from consat.numerics import Groups, float64, quick_compilation
from consat.protocols import ROUNDS

NEARBY, FAR = 8.0, 1e6
"""Half the side of the box in which agents start."""
WEATHERS = ((0.0, 0.0), (0.3, 0.0), (0.0, 0.5), (0.7, 0.0))
"""Loss and sleep."""
NAMED = ("clear", "30 % lost", "half asleep", "70 % lost")


class Goal(NamedTuple):
    """A family of teams that can be satisfied, and how many rounds the design grants; None: half of admm's."""

    family: Family
    count: int
    rounds: int | None


def _torn(shape: str) -> Builder:
    def build(prefix: str, count: int, random: np.random.Generator) -> Instance:
        while True:
            made = instance(shape, count, random, prefix)
            optimum = max_min(cs.Team(*made, 2))
            if optimum.exact and optimum.margin < -PLAINLY:
                return made

    return build


def _tied(prefix: str, places: np.ndarray, links: Sequence[tuple[int, int]], random: np.random.Generator) -> Instance:
    """Tethers and displacements with some room along every link, discs on some agents, around a formation."""
    ids = [f"{prefix}a{i}" for i in range(len(places))]
    own: list[list[cs.Constraint]] = [[] for _ in ids]
    for i, j in links:
        away = places[j] - places[i]
        if random.random() < 0.5:
            own[j].append(cs.near(ids[i], float(np.linalg.norm(away) * random.uniform(1.05, 1.4))))
        else:
            own[j].append(cs.displacement(ids[i], (away + random.normal(0, 0.08, 2)).tolist(), float(random.uniform(0.3, 0.6))))
    for i in range(len(places)):
        if i in (0, len(places) - 1) or random.random() < 0.4:
            own[i].append(cs.within((places[i] + random.normal(0, 0.08, 2)).tolist(), float(random.uniform(0.3, 0.8))))
    return [cs.Agent(name, constraints) for name, constraints in zip(ids, own, strict=True)], [(ids[i], ids[j]) for i, j in links]


def _tree(prefix: str, count: int, random: np.random.Generator) -> Instance:
    places = random.uniform(-4, 4, (count, 2))
    return _tied(prefix, places, [(int(random.integers(max(0, i - 6), i)), i) for i in range(1, count)], random)


def _ring(prefix: str, count: int, random: np.random.Generator) -> Instance:
    turn = 2 * math.pi * np.arange(count) / count
    places = 0.6 * count / math.pi * np.column_stack([np.cos(turn), np.sin(turn)]) + random.normal(0, 0.2, (count, 2))
    return _tied(prefix, places, [*((i, i + 1) for i in range(count - 1)), (0, count - 1)], random)


def _geometric(prefix: str, count: int, random: np.random.Generator) -> Instance:
    places, radius = random.uniform(0, math.sqrt(count), (count, 2)), 1.5
    while not nx.is_connected(graph := nx.random_geometric_graph(count, radius, pos=dict(enumerate(places)))):
        radius *= 1.05
    return _tied(prefix, places, sorted(graph.edges), random)


def _case(letter: str) -> Family:
    return next(family for family in FAMILIES if family.name == f"case {letter}")


GOALS = (
    *(Goal(_case(letter), 3, rounds) for letter, rounds in (("A", 3), ("B", 2), ("C", 5), ("E", 5))),
    *(Goal(Family("random tree", _tree, ()), count, 25) for count in (3, 10, 30)),
    Goal(next(family for family in FAMILIES if family.name == "chain"), 1000, 4),
    *(Goal(Family("ring", _ring, ()), count, None) for count in (60, 200)),
    Goal(Family("random geometric", _geometric, ()), 50, None),  # 20 seeds of 200 agents at once take more than 6 GB
)
TORN = tuple((Family(f"{shape}s", _torn(shape), (), feasible=False), count) for shape in ("tree", "line") for count in (6, 20, 40))
PACKAGED = tuple((name, count) for name in ("lattice", "swarm") for count in (50, 200, 1000))


@functools.partial(jax.jit, static_argnames=("protocol",), compiler_options=quick_compilation())
def _go_on(protocol: Any, world: Any, groups: Groups, now: Any, numbers: Array, loss: Array, sleep: Array) -> Any:
    def one(now: Any, loss: Array, sleep: Array) -> Any:
        world_ = dataclasses.replace(world, loss=loss, sleep=sleep)
        now, position = many_rounds(protocol, world_, now, numbers, lambda seen: seen.position)
        return now, jax.lax.map(lambda x: _look(world.observer, groups, world.everyone.nu, x)[0], position, batch_size=CHUNK)

    return jax.vmap(one)(now, loss, sleep)


@float64
def margins_of(stage: Stage, name: str, conditions: Sequence[Condition], cap: int, over: Callable[[np.ndarray], bool]) -> np.ndarray:
    """(K, T, S) margins of all instances after each round, the start first, under K conditions.

    Args:
        stage: the instances.
        name: of the protocol.
        conditions: where agents start, and what goes wrong.
        cap: rounds at most.
        over: says of such margins whether there are enough.
    """
    protocol, copies = ROUNDS[name](), stage.layout(name)
    world, groups = stage.world(rough=True, protocol=protocol, copies=copies), Groups.of(stage.cluster, stage.problem.seeds)
    first = np.stack([stage.first(condition.box, 0, copies) for condition in conditions])
    loss, sleep = (jnp.asarray([getattr(condition, what) for condition in conditions]) for what in ("loss", "sleep"))
    look = jax.jit(jax.vmap(lambda x: _look(world.observer, groups, stage.nu, x)[0]))
    margins = np.asarray(look(jnp.asarray(first[:, copies.own])))[:, None]
    now = _start(protocol, world, jnp.asarray(first), jax.random.split(jax.random.key(0), len(conditions)))
    for done in range(0, cap, CHUNK):
        now, more = _go_on(protocol, world, groups, now, jnp.arange(done, done + CHUNK, dtype=float), loss, sleep)
        margins = np.concatenate([margins, np.asarray(more)], axis=1)
        if over(margins):
            break
    return margins


def satisfied(stage: Stage, name: str, conditions: Sequence[Condition], cap: int) -> np.ndarray:
    """(K, S) rounds to satisfaction for good; NaN where it is not reached."""

    def over(margins: np.ndarray) -> bool:
        return bool(margins.shape[1] > 2 * for_good(margins > 0).max() + 20)

    return for_good(margins_of(stage, name, conditions, cap, over) > 0)


def quantiles(values: np.ndarray) -> tuple[float, float]:
    """Median and 95th percentile; what never arrives counts as ∞."""
    counted = np.sort(np.where(np.isfinite(values), values, np.inf).ravel())
    low, high = counted[(len(counted) - 1) // 2], counted[len(counted) // 2]
    return float(0.5 * (low + high)), float(counted[math.ceil(0.95 * len(counted)) - 1])


def shown(values: np.ndarray, form: str = ".3g") -> str:
    """``median / 95th percentile``."""
    return " / ".join("never" if np.isinf(value) else f"{value:{form}}" for value in quantiles(values))


def torn(seeds: int, cap: int, say: Callable[[str], None]) -> str:
    """The table of teams that cannot be satisfied."""
    rows = []
    for family, count in TORN:
        problem = float64(family.at)(count, seeds)
        stage = float64(Stage.of)(problem, optima=False)
        team = problem.team
        best = np.asarray(float64(cluster_margins)(team, float64(values_and_gradients)(team, max_min(team).positions)[0], stage.cluster))
        limits = np.maximum(ROUGH * np.abs(best), EXACT), EXACT * np.maximum(1.0, np.abs(best))
        conditions = [Condition(NEARBY, *weather) for weather in WEATHERS]

        def over(margins: np.ndarray, best: np.ndarray = best, limit: np.ndarray = limits[1]) -> bool:
            return bool(margins.shape[1] > 1.5 * for_good(np.abs(margins - best) <= limit).max() + 20)

        away = np.abs(margins_of(stage, "max-min", conditions, cap, over) - best)
        rough, exact = (for_good(away <= limit) for limit in limits)
        hops = problem.diameters
        rows.append([
            f"{family.name}, {count} agents", f"{np.median(hops):.0f}", shown(rough[0], ".0f"), shown(rough[0] / (15 + 3 * hops), ".2f"),
            shown(exact[0], ".0f"), shown(exact[0] / (20 + 4 * hops), ".2f"), *(shown(exact[k] / exact[0], ".1f") for k in (1, 2, 3)),
        ])  # fmt: skip
        say(" | ".join(rows[-1]))
    head = ["teams", "D", "to 5 %", "of 15 + 3 D", "to 1e-3", "of 20 + 4 D", *(f"{name}, × clear" for name in NAMED[1:])]
    return table(head, rows)


MANY, FEW = 200, 5
"""Teams with loops of at least `MANY` agents are measured with at most `FEW` seeds: their instances together would need many gigabytes."""


def feasible(seeds: int, cap: int, say: Callable[[str], None], most: int) -> str:
    """The table of teams that can be satisfied."""
    rows = []
    for goal in GOALS:
        if goal.count > most:
            continue
        number = min(seeds, FEW) if goal.rounds is None and goal.count >= MANY else seeds
        stage = float64(Stage.of)(float64(goal.family.at)(goal.count, number), optima=False)
        near, far, lost = satisfied(stage, "interior-point", [Condition(NEARBY, 0.0), Condition(FAR, 0.0), Condition(NEARBY, 0.3)], cap)
        admm = satisfied(stage, "admm", [Condition(NEARBY, 0.0)], cap)[0]
        granted = 0.5 * quantiles(admm)[0] if goal.rounds is None else goal.rounds
        met = quantiles(near)[0] <= granted and quantiles(near)[1] <= 2 * granted
        rows.append([
            stage.problem.name + (f", {number} seeds" if number < seeds else ""), shown(near), f"{granted:g}", "yes" if met else "**no**", shown(far), shown(lost), shown(admm),
        ])  # fmt: skip
        say(" | ".join(rows[-1]))
    head = ["teams", "from ±8", "goal, median", "met", "from ±1e6", "30 % lost", "admm from ±8"]
    return table(head, rows)


def packaged(seeds: int, cap: int, say: Callable[[str], None], most: int) -> str:
    """The table of packaged scenarios."""
    rows = []
    for name, count in PACKAGED:
        if count > most:
            continue
        found = [cs.sweep(cs.load(name, [f"count={count}"]), seeds=seeds, rounds=cap, stop="satisfied", protocol=p) for p in (None, "admm")]
        since = [np.array([row["satisfied_from"] for row in sweep.runs], dtype=float) for sweep in found]
        rows.append([f"{name} N={count}", found[0].summary["protocol"], shown(since[0]), shown(since[1])])
        say(" | ".join(rows[-1]))
    return table(["scenario", "default protocol", "rounds to satisfaction", "admm"], rows)


PROSE = """# Rounds of the default protocol over many seeds

{machine}

Median / 95th percentile over {seeds} seeds; instance, starts and losses all vary. What does not arrive within {cap} rounds counts as never.

## Teams that cannot be satisfied

`max-min` from ±8. Rounds until the margin, at the agents' own positions, stays within 5 % of |β̄*|, and within 1e-3 max(1, |β̄*|), of the best one;
D hops across. The goals are 15 + 3 D and 20 + 4 D rounds for the median, and twice that for the 95th percentile; at 30 % loss at most 1.7
times, with half of the agents asleep or 70 % lost at most 4 times the rounds.

{torn}

## Teams that can

`interior-point`, rounds to satisfaction for good. The goal of teams with loops is half of admm's median, and twice the goal for the 95th percentile.
From ±1e6 at most 8 rounds more are granted. Loops of more than 64 agents are left to `admm` by default.

{feasible}

## Packaged scenarios

{packaged}
"""


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few seeds and no large teams")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    asked = parser.parse_args()
    began = time.perf_counter()

    def say(text: str) -> None:
        sys.stderr.write(f"{time.perf_counter() - began:6.0f} s  {text}\n")

    seeds, cap, most = (3, 200, 60) if asked.quick else (20, 400, 1000)
    parts = {"torn": torn(seeds, cap, say), "feasible": feasible(seeds, cap, say, most), "packaged": packaged(seeds, cap, say, most)}
    command = "python benchmarks/goals.py" + (" --quick" if asked.quick else "")
    text = PROSE.format(machine=machine(command, time.perf_counter() - began), seeds=seeds, cap=cap, **parts)
    asked.out.mkdir(parents=True, exist_ok=True)
    (asked.out / "goals.md").write_text(text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()

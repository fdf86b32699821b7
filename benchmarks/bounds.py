"""Bounds that the agents of random teams prove, against the best margin by one cone program for each team: none may be below it.

    python benchmarks/bounds.py [--teams 1000] [--out docs/benchmarks]

Writes ``bounds.md``. The teams have 3 to 8 agents in two or three dimensions; some of them can be satisfied. In each of several weathers
messages get lost, come late, out of order and more than once, agents sleep and lose their memory. Every agent's bound after every round is
compared with the best margin. That is the margin of a formation in hand, so that the best possible is no less: a bound is false if it is
smaller, by more than what rounding does to ψ.

Many teams run at once, as the clusters of one.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from rounds import machine, table

import consat as cs
from consat.certify.optimum import max_min
from consat.numerics import float64
from consat.problem.graphs import clusters
from consat.problem.objective import Objective
from consat.problem.units import scale
from consat.protocols.interior_point import InteriorPoint
from consat.protocols.local.interior import Interior, Mail, Memory, route_of

TOGETHER = 250
"""Teams that run at once."""
ROUNDS = 80
BOX = 8.0
"""Half the side of the box in which agents start; places are drawn in half of it."""
ROUNDING = 1e-9
"""Relative to max(1, |β̄*|): a bound that is smaller than the best margin by more is false."""


class Weather(NamedTuple):
    """What goes wrong.

    Attributes:
        loss: probability that a message is lost.
        late: rounds that a message takes at most, drawn for each by itself, so that they come out of order and more than once.
        sleep: probability that an agent skips a round.
        forget: probability that an agent loses its memory in a round.
    """

    loss: float = 0.0
    late: int = 0
    sleep: float = 0.0
    forget: float = 0.0

    def __str__(self) -> str:
        told = [f"{self.loss:.0%} lost"] if self.loss else []
        told += [f"0–{self.late} rounds late"] if self.late else []
        told += [f"{self.sleep:.0%} asleep"] if self.sleep else []
        told += [f"memory lost every {1 / self.forget:.0f} rounds"] if self.forget else []
        return ", ".join(told) or "none"


WEATHERS = (Weather(), Weather(loss=0.3), Weather(loss=0.3, late=5), Weather(sleep=0.5, loss=0.2), Weather(loss=0.3, late=3, forget=0.02))

LATEST = max(weather.late for weather in WEATHERS)


class Counted(NamedTuple):
    """What became of some teams.

    Attributes:
        teams: how many.
        torn: which cannot be satisfied.
        bounds: finite ones, of all agents after all rounds.
        false: of these.
        nearest: the least of bound − β̄*, relative to max(1, |β̄*|).
        known: torn teams all of whose agents have proven it.
        wrong: teams that can be satisfied of which any agent has ever proven the contrary.
        gap: (K,) of every team, how far the best bound that every agent has proven is above β̄*, relative to max(1, |β̄*|).
    """

    teams: int
    torn: int
    bounds: int
    false: int
    nearest: float
    known: int
    wrong: int
    gap: np.ndarray


def reach(p: Array, q: Array, radius: Array) -> Array:
    """A tether that is concave but not quadratic."""
    return radius - jnp.sqrt(jnp.sum((p - q) ** 2) + 1e-2)


def draw(prefix: str, dimension: int, random: np.random.Generator) -> tuple[list[cs.Agent], list[tuple[str, str]]]:
    """A team around a hidden formation, spoilt or not: tethers along a random tree, links along another and, at times, in a loop."""
    count = int(random.integers(3, 9))
    ids = [f"{prefix}{i}" for i in range(count)]
    place = random.uniform(-BOX / 2, BOX / 2, (count, dimension))
    tight, noise = (random.uniform(1.02, 1.5), 0.0) if random.random() < 0.3 else (random.uniform(0.2, 1.0), 0.6)
    own: list[list[cs.Constraint]] = [[] for _ in ids]
    for i in range(count):
        there = place[i] + random.normal(0, noise + 1e-3, dimension)
        kind = random.random()
        if kind < 0.5 or i == 0:
            own[i].append(cs.within(there.tolist(), float(random.uniform(0.3, 1.0))))
        elif kind < 0.6:
            normal = random.normal(size=dimension)
            own[i] += [cs.halfspace(normal.tolist(), float(normal @ there + random.uniform(0.01, 1)))]
        if i:
            j = int(random.integers(i))
            away, whose, other = place[i] - place[j], i, j
            if random.random() < 0.5:
                away, whose, other = -away, j, i
            distance, shape = float(np.linalg.norm(away)), random.random()
            if shape < 0.5:
                tie = cs.near(ids[other], max(0.2, tight * distance))
            elif shape < 0.8:
                tie = cs.displacement(
                    ids[other], (away + random.normal(0, noise + 1e-3, dimension)).tolist(), float(random.uniform(0.2, 0.8))
                )
            else:
                tie = cs.constraint(reach, (ids[whose], ids[other]), radius=max(0.2, tight * distance), name=f"reach {ids[other]}")
            own[whose].append(tie)
    order = random.permutation(count)
    links = [(ids[order[int(random.integers(k))]], ids[order[k]]) for k in range(1, count)]
    if random.random() < 0.5:
        links.append((ids[order[0]], ids[order[-1]]))
    unique = {tuple(sorted(pair)) for pair in links}
    return [cs.Agent(name, constraints) for name, constraints in zip(ids, own, strict=True)], sorted(unique)


@float64
def together(number: int, dimension: int, count: int) -> Callable[[Weather], Counted]:
    """Some teams, ready to run in any weather."""
    random = np.random.default_rng([number, dimension])
    made = [draw(f"t{k}_", dimension, random) for k in range(count)]
    team = cs.Team([agent for agents, _ in made for agent in agents], [link for _, links in made for link in links], dimension)
    size, (_, copies, *_) = scale(team), route_of(team, "local")
    interior, cluster, gains = Interior.of(team, copies, size), clusters(team), InteriorPoint(cap=None).gains
    observer, own = Objective.at_positions(team), jnp.asarray(copies.own)
    margins = np.asarray(observer.agent_margins(jnp.asarray(max_min(team).positions)))
    best = np.full(count, np.inf)
    np.minimum.at(best, cluster, margins)

    @jax.jit
    def run(first: Array, key: Array, late: Array, rates: Array) -> Array:
        """(ROUNDS, N) bounds; late: rounds at most; rates: of loss, sleep and forgetting."""
        loss, sleep, forget = rates
        blank, silence = interior.begin(first, gains), interior.silence()

        def choose(mask: Array, new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)

        def remember(mask: Array, new: Memory, old: Memory) -> Memory:
            masks = {"y": mask[jnp.asarray(copies.holder)], "multiplier": mask[interior.owner]}
            return Memory(*(choose(masks.get(name, mask), getattr(new, name), getattr(old, name)) for name in Memory._fields))

        def turn(at: tuple[Memory, Mail, Any], step: tuple[Array, Array]) -> tuple[Any, Array]:
            (memory, inbox, past), (number, key) = at, step
            draws = jax.random.split(key, 4)
            lost_memory = jax.random.uniform(draws[0], (team.count,)) < forget
            memory, inbox = remember(lost_memory, blank, memory), choose(lost_memory[interior.talker], silence, inbox)
            awake = jax.random.uniform(draws[1], (team.count,)) >= sleep
            after, mail = interior.round(memory, inbox, observer.agent_margins(memory.y[own]), gains)
            memory = remember(awake, after, memory)
            sent = jax.tree.map(
                lambda leaf, old: jnp.concatenate([leaf[None], old[:-1]]), choose(awake[interior.talker], mail, newest(past)), past
            )
            ends = jnp.arange(len(interior.talker))
            delay = jnp.minimum(jax.random.randint(draws[2], ends.shape, 0, late + 1), number)
            came = (jax.random.uniform(draws[3], ends.shape) >= loss) & (delay < number + 1)
            inbox = choose(came, interior.across(jax.tree.map(lambda leaf: leaf[delay[interior.other], ends], sent)), inbox)
            return (memory, inbox, sent), memory.bound

        def newest(past: Any) -> Any:
            return jax.tree.map(lambda leaf: leaf[0], past)

        past = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LATEST + 1, *leaf.shape)), silence)
        steps = jnp.arange(ROUNDS), jax.random.split(key, ROUNDS)
        return jax.lax.scan(turn, (blank, silence, past), steps)[1]

    @float64
    def counted(weather: Weather) -> Counted:
        first = jnp.asarray(random.uniform(-BOX, BOX, (copies.count, dimension)))
        rates = jnp.asarray([weather.loss, weather.sleep, weather.forget])
        bounds = np.asarray(run(first, jax.random.key(number), jnp.asarray(weather.late), rates)) * size.typical
        unit = np.maximum(1.0, np.abs(best))
        above = (bounds - best[cluster]) / unit[cluster]
        worst = np.full(count, -np.inf)
        np.maximum.at(worst, cluster, bounds.min(axis=0))
        ever = np.full(count, np.inf)
        np.minimum.at(ever, cluster, bounds.min(axis=0))
        torn = best < 0
        return Counted(
            count, int(torn.sum()), int(np.isfinite(bounds).sum()), int((above < -ROUNDING).sum()), float(above.min()),
            int((torn & (worst < 0)).sum()), int((~torn & (ever < 0)).sum()), (worst - best) / unit,
        )  # fmt: skip

    return counted


def measure(teams: int, say: Callable[[str], None]) -> Iterator[tuple[Weather, Counted]]:
    """All teams in all weathers."""
    batches = -(-teams // TOGETHER)
    for number in range(batches):
        count = min(TOGETHER, teams - number * TOGETHER)
        counted = together(number, 2 + number % 2, count)
        for weather in WEATHERS:
            found = counted(weather)
            say(
                f"teams {number * TOGETHER} to {number * TOGETHER + count - 1}, {2 + number % 2}-D, {weather}: {found.false} false, nearest {found.nearest:.1e}"
            )
            yield weather, found
        jax.clear_caches()


PROSE = """# Bounds that agents prove, against the best margin

{machine}

{teams} random teams of 3 to 8 agents in two and three dimensions, {torn} of which cannot be satisfied, for {rounds} rounds of `max-min` in each
weather. After every round the bound that each agent has proven is compared with the best margin that one cone program for the whole team finds
(Clarabel; of tethers that are not quadratic, the best that is found). False is a bound below that by more than {rounding:g} max(1, |β̄*|), which
is what rounding does to ψ. A tether that is not quadratic enters by its tangent, which bounds little where nothing else holds its agents.

{table}
"""


def report(found: list[tuple[Weather, Counted]], machine: str) -> str:
    rows = []
    for weather in WEATHERS:
        some = [one for other, one in found if other == weather]
        gap = np.concatenate([one.gap for one in some])
        torn, bounds = sum(one.torn for one in some), sum(one.bounds for one in some)
        rows.append([
            str(weather), f"{bounds:,}", str(sum(one.false for one in some)), f"{min(one.nearest for one in some):.1e}",
            f"{sum(one.known for one in some)} of {torn}", str(sum(one.wrong for one in some)),
            f"{np.median(gap):.1e}", f"{np.quantile(gap, 0.9, method='higher'):.1e}",
        ])  # fmt: skip
    head = ["weather", "bounds", "false", "nearest to β̄*, above it by", "torn teams that all their agents prove torn",
            "others that any agent proves torn", "best bound that all have proven, above β̄*, median", "90th percentile"]  # fmt: skip
    first = [one for other, one in found if other == WEATHERS[0]]
    return PROSE.format(
        machine=machine, teams=sum(one.teams for one in first), torn=sum(one.torn for one in first), rounds=ROUNDS, rounding=ROUNDING,
        table=table(head, rows),
    )  # fmt: skip


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--teams", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    asked = parser.parse_args()
    began = time.perf_counter()

    def say(text: str) -> None:
        sys.stderr.write(f"{time.perf_counter() - began:6.0f} s  {text}\n")

    found = list(measure(asked.teams, say))
    text = report(found, machine(f"python benchmarks/bounds.py --teams {asked.teams}", time.perf_counter() - began))
    asked.out.mkdir(parents=True, exist_ok=True)
    (asked.out / "bounds.md").write_text(text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()

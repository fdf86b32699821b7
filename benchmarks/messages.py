"""How many messages and bytes teams need: all of them sent, and only what is news (``--sends events``).

    python benchmarks/messages.py [--seeds 3] [--count 100] [--rounds 150] [--out docs/benchmarks]

Writes ``messages.md`` and ``messages.png``. A team has arrived from the round after the last one whose margin, at the agents' own positions, was
below the goal: what interior-point asks for, 0.3 of the team's unit of ψ, or the best margin where that is less, less 1e-3 of the unit; for a
torn team the best margin less 1e-3 of the unit; for a swarm, whose best margin nobody knows, 0. Bytes are those of the wire format without
names of agents and shapes of arrays.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from families import FAMILIES
from rounds import machine, table

import consat as cs
from consat.engine.round import SATISFIED, begin, many_rounds
from consat.engine.world import world_of
from consat.faults import Faults
from consat.numerics import float64, quick_compilation
from consat.problem.units import scale
from consat.protocols import ROUNDS
from consat.runs.options import Options
from consat.runs.preparation import Prepared, scenario_of, settings_of
from consat.scenario import Scenario, load

mpl.use("Agg")
import matplotlib.pyplot as plt

NEAR = 1e-3
ASKED = 0.3
SHIFTS = (0.05, 0.2, 1.0)
"""By which a goal of radius 1 is moved, …"""
FOLLOWED = 60
"""… and for how many rounds the team is followed then."""
REST = 20
"""The last rounds, in which a team is at rest."""
WAYS = (("admm", "all"), ("admm", "events"), ("interior-point", "all"), ("interior-point", "events"))
COLORS = {"admm": "#d1853f", "interior-point": "#2f6f9f"}


class Kind(NamedTuple):
    """A kind of team.

    Attributes:
        name: of the row.
        scenario: of so many agents.
        best: the best margin; None where nobody knows it.
    """

    name: str
    scenario: Callable[[int], Scenario]
    best: float | None


def packaged(name: str, count: int) -> Scenario:
    return load(name, [f"count={count}"])


def torn(count: int) -> Scenario:
    return scenario_of(next(family for family in FAMILIES if family.name == "infeasible chain").at(count, 1).team)


KINDS = (
    Kind("chain", functools.partial(packaged, "convoy"), 1.0),
    Kind("lattice", functools.partial(packaged, "lattice"), 0.25),
    Kind("swarm", functools.partial(packaged, "swarm"), None),
    Kind("torn chain of 30", lambda _: torn(30), -0.1),
)


class Found(NamedTuple):
    """Of one run: (T,) after each round, and where it arrived and all knew; None where they did not."""

    margin: np.ndarray
    messages: np.ndarray
    bytes: np.ndarray
    arrived: int | None
    known: int | None


@functools.cache
def program() -> Callable[..., Any]:
    def run(protocol: Any, world: Any, first: Any, numbers: Any) -> Any:
        now, _ = begin(protocol, world, first, jax.random.key(0))
        return many_rounds(protocol, world, now, numbers, lambda seen: (seen.margin, seen.messages, seen.bytes, seen.known))[1]

    return jax.jit(run, static_argnums=0, compiler_options=quick_compilation())


@float64
def runs(kind: Kind, count: int, way: tuple[str, str], seeds: int, rounds: int) -> list[Found]:
    protocol, sends = way
    scenario, found = kind.scenario(count), []
    team = scenario.team
    for seed in range(seeds):
        settings = settings_of(scenario.settings, Options(protocol=protocol, seed=seed), team)
        ready = Prepared.of(team, settings)
        made = ROUNDS[protocol]()
        world = world_of(
            team, ready.copies, ready.schedule.final, ready.size, convex=ready.convex, faults=Faults(), body=None,
            speaks=made.speaks, events=sends == "events",
        )  # fmt: skip
        seen = program()(made, world, jnp.asarray(ready.first()), jnp.arange(float(rounds)))
        margin, messages, sizes, known = map(np.asarray, seen)
        unit = float(scale(team).typical)
        goal = 0.0 if kind.best is None else min(kind.best, ASKED * unit) - NEAR * unit
        found.append(Found(margin, messages, sizes, since(margin > goal), since(known & SATISFIED > 0)))
    return found


def since(good: np.ndarray) -> int | None:
    """After how many rounds it has been so for good."""
    bad = np.flatnonzero(~good)
    last = int(bad[-1]) if len(bad) else -1
    return None if last == len(good) - 1 else last + 2


def median(values: list[float | None]) -> str:
    there = [value for value in values if value is not None]
    return f"{np.median(there):,.0f}" + ("" if len(there) == len(values) else f" ({len(there)} of {len(values)})") if there else "–"


def row(name: str, way: tuple[str, str], found: list[Found]) -> list[str]:
    def until(values: str, end: str) -> str:
        return median([None if getattr(one, end) is None else float(getattr(one, values)[: getattr(one, end)].sum()) for one in found])

    rest = np.mean([one.messages[-REST:].mean() / one.messages[0] for one in found])
    return [
        name, way[0], way[1], median([one.arrived for one in found]), until("messages", "arrived"), until("bytes", "arrived"),
        median([one.known for one in found]), until("messages", "known"), until("bytes", "known"), f"{rest:.1%}",
    ]  # fmt: skip


def fewer(rows: list[list[str]]) -> list[list[str]]:
    """Of interior-point with events: how many times fewer messages and bytes than either protocol that sends all, of the medians."""

    def number(text: str) -> float:
        return float(text.split(" (", maxsplit=1)[0].replace(",", "")) if text != "–" else np.nan

    found = []
    for kind in dict.fromkeys(each[0] for each in rows):
        own, *others = (
            [number(text) for text in next(each for each in rows if each[:3] == [kind, *way])[4:9]]
            for way in (WAYS[3], WAYS[2], WAYS[0])
        )  # fmt: skip
        ratios = [other[k] / own[k] for other in others for k in (0, 1, 3, 4)]
        found.append([kind, *("–" if np.isnan(ratio) else f"{ratio:.1f}" for ratio in ratios)])
    return found


@float64
def moved(count: int, far: int = 4) -> list[list[str]]:
    """Messages after the goal of a chain that rests was moved, by how far from it their sender is."""
    rows = []
    for shift in SHIFTS:
        sessions = [cs.Session(packaged("convoy", count), seed=0, sends=sends).step(400) for sends in ("all", "events")]
        least = [np.inf, np.inf]
        sent, counted = np.zeros(count), sessions[1]._tally.messages
        talker = np.asarray(sessions[1]._engine.carrier.world.everyone.interior.talker)
        for session in sessions:
            session.change("a1", "goal", center=[2.0 + shift, 0.0])
        for _ in range(FOLLOWED):
            least = [min(margin, session.step(1).margin) for margin, session in zip(least, sessions, strict=True)]
            np.add.at(sent, talker, np.asarray(sessions[1]._state.held.since) == 1.0)
        assert sessions[1]._tally.messages - counted == sent.sum()
        near, away = sent[: far + 1].sum(), sent[far + 1 :]
        rows.append(
            [f"{shift:g}", f"{least[0]:.3f}", f"{least[1]:.3f}", f"{near:.0f}", f"{away.sum():.0f}", f"{away.max():.0f}",
             f"{FOLLOWED * 2 * (count - 1):,}"]
        )  # fmt: skip
    return rows


HEAD_FEWER = (
    "team",
    *(f"{word}, {end}, {other}" for other in ("interior-point", "admm") for end in ("arrived", "known") for word in ("messages", "bytes")),
)
VERDICT = """It is reached against `admm` on the lattice alone, in a twentieth of the rounds,
and on the chain nearly, in messages, until all know. Until a team has arrived it is missed everywhere else: while a team converges, what
everybody says changes by a good part of itself in every round, and agents that withheld it needed as many messages, over more rounds. What
silence saves is all that comes after: the rounds in which word gets round that all are satisfied, and a team at rest."""
PROSE = """# Fewer messages

{machine}

Medians over {seeds} seeds, teams of {count} agents, {rounds} rounds without loss. A team has arrived from the round after the last one whose
margin was below the goal: 0.3 of the team's unit of ψ, or the best margin where that is less, less 1e-3 of the unit; of a torn chain the best
margin, less 1e-3; of a swarm 0. All know: every agent knows that all are satisfied, where a run ends. Bytes are those of the wire
format, without names and shapes. At rest: messages in the last {rest} rounds, over those of a team that sends all.

{table}

![Messages and bytes over rounds](messages.png)

How many times fewer messages and bytes interior-point with events sent than either protocol that sends all, until the team has arrived and
until all know:

{fewer}

The goal was 5 times fewer messages and 10 times fewer bytes. {verdict}

## After one moved goal

A chain of {count} agents that has rested for 400 rounds; the goal of its first agent moves; {sixty} rounds follow. "Near": agents within 4 hops.
"All": what would be sent with `--sends all`.

{moved}
"""


def figure(found: dict[tuple[str, tuple[str, str]], list[Found]], path: Path) -> None:
    kinds = [kind.name for kind in KINDS]
    drawn, axes = plt.subplots(2, len(kinds), figsize=(3.4 * len(kinds), 6.0), sharex=True, sharey="row", layout="constrained")
    for column, kind in enumerate(kinds):
        for line, (values, word) in enumerate((("messages", "messages"), ("bytes", "kilobytes"))):
            panel = axes[line, column]
            for way in WAYS:
                protocol, sends = way
                total = np.median([np.cumsum(getattr(one, values)) for one in found[kind, way]], axis=0) / (1e3 if values == "bytes" else 1)
                style = "-" if sends == "events" else (0, (4, 2))
                at = np.arange(1, len(total) + 1)
                panel.plot(at, total, color=COLORS[protocol], linestyle=style, linewidth=1.8, label=f"{protocol}, {sends}")
                arrived = [one.arrived for one in found[kind, way] if one.arrived is not None]
                if arrived:
                    k = int(np.median(arrived)) - 1
                    panel.plot(at[k], total[k], marker="o", markersize=5, color=COLORS[protocol], markerfacecolor="white", zorder=3)
            panel.set_yscale("log")
            panel.grid(color="#e4e4e4", linewidth=0.8)
            panel.spines[["top", "right"]].set_visible(False)
            if line == 0:
                panel.set_title(kind, fontsize=11)
            if column == 0:
                panel.set_ylabel(f"{word} sent in all")
            if line == 1:
                panel.set_xlabel("round")
    axes[0, 0].legend(frameon=False, fontsize=8.5)
    drawn.savefig(path, dpi=130)
    plt.close(drawn)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=150)
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    options = parser.parse_args()
    began, rows, found = time.monotonic(), [], {}
    for kind in KINDS:
        for way in WAYS:
            found[kind.name, way] = runs(kind, options.count, way, options.seeds, options.rounds)
            rows.append(row(kind.name, way, found[kind.name, way]))
            print(*rows[-1], sep=" | ", flush=True)
    shifts = moved(options.count)
    options.out.mkdir(parents=True, exist_ok=True)
    figure(found, options.out / "messages.png")
    command = f"python benchmarks/messages.py --seeds {options.seeds} --count {options.count} --rounds {options.rounds}"
    head = ["team", "protocol", "sends", "arrived", "messages", "bytes", "all know", "messages", "bytes", "at rest"]
    head_moved = ["moved by", "least margin, all", "events", "messages, near", "messages, farther", "most of one farther", "all"]
    text = PROSE.format(
        machine=machine(command, time.monotonic() - began), seeds=options.seeds, count=options.count, rounds=options.rounds, rest=REST,
        table=table(head, rows), fewer=table(HEAD_FEWER, fewer(rows)), verdict=VERDICT, moved=table(head_moved, shifts), sixty=FOLLOWED,
    )  # fmt: skip
    (options.out / "messages.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()

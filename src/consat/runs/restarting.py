"""Restarts: runs of one team from many starts as one vectorised computation, and the choice of the best."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from consat.certify.quadratics import shape_of
from consat.engine.batch import Case, Lane, Then, simulate_batch
from consat.engine.rules import PATIENCE, Rules, longest_hold, stillness, turn_after
from consat.engine.world import World, world_of
from consat.faults import Faults
from consat.numerics import float64, number
from consat.problem.team import Team
from consat.protocols import ROUNDS, with_gains
from consat.protocols.estimates import Estimates
from consat.runs.options import Options
from consat.runs.preparation import Prepared
from consat.settings import Settings, Start

ELSEWHERE, BRIEFLY = 5, 300
"""Number of starts that a run tries by itself, and number of rounds for each; see `looks_elsewhere`. Of random teams (`benchmarks/hunt.py`)
that are satisfied, most are so within 100 rounds."""


def case_of(ready: Prepared, faults: Faults, options: Options) -> Case:
    """Settings that runs of one team share, for `consat.engine.batch`.

    Args:
        ready: the team and its settings.
        faults: message loss and sleep; every run has its own seed.
        options: options that determine the stop rules.
    """
    asked, nu = ready.settings.protocol, ready.schedule.final
    protocol = ROUNDS[str(asked.kind)]()
    gains = {key: getattr(with_gains(protocol, asked), key) for key in ("penalty", "relaxation", "step") if getattr(asked, key) is not None}

    def world(copies: Estimates) -> World:
        return world_of(ready.team, copies, nu, ready.size, convex=ready.convex, faults=faults, body=None, speaks=protocol.speaks)

    along = world(ready.copies)
    rules = Rules(
        end=PATIENCE if options.rounds is None else options.rounds, stop=options.stop_for(str(asked.kind)),
        most=longest_hold(protocol, along), still=stillness(ready.size.length, ready.enough),
        earliest=protocol.earliest(along.everyone), hopeless=ready.hopeless, enough=ready.enough,
    )  # fmt: skip
    if ready.then is None:
        return Case(along, gains, rules)
    then = ready.then
    after = functools.cache(lambda: Case(world(then), gains, rules))
    return Case(along, gains, dataclasses.replace(rules, turn=turn_after(along)), Then(ready.copies, then, after))


def looks_elsewhere(team: Team, options: Options, summary: Mapping[str, Any]) -> bool:
    """Whether a run that was not told how many starts to try tries others: it has not satisfied a team with ψ that are neither concave nor
    convex nor quadratic, and nothing but the seed determines where the agents are at the start. `summary`: of the first run."""
    simple = options.restarts is None and options.stop is None and options.rounds is None and jax.process_count() == 1
    return simple and not options.takes_time(team) and summary["status"] == "not-converged" and shape_of(team).wild


@float64
def best_start(team: Team, settings: Settings, options: Options, count: int) -> dict[str, Any]:
    """Find the start from which a team ends with the largest margin. The result is not proven to be the best.

    Args:
        team: the team.
        settings: resolved settings; their seed is the first one.
        options: options that determine stop rules, loss and sleep.
        count: number of consecutive seeds.

    Returns:
        The entry ``restarts`` of ``consat run --json``: number of seeds, best seed (the first of equals), number of runs that satisfied
        every constraint, and the last margin of each run, null where it is not finite.
    """
    ready, start = Prepared.of(team, settings), settings.start
    faults = Faults(options.loss, options.sleep, burst=options.burst)
    case = case_of(ready, faults, options)
    seeds = range(start.seed, start.seed + count)
    lanes = [Lane(case, ready.first(Start(box=start.box, seed=seed)), seed) for seed in seeds]
    outcomes = simulate_batch(ROUNDS[str(settings.protocol.kind)](), lanes)
    margins = np.array([outcome.tally.margin for outcome in outcomes])
    best = int(np.argmax(np.where(np.isnan(margins), -np.inf, margins)))
    return {"count": count, "seed": seeds[best], "satisfied": int(np.sum(margins > 0)), "margins": [number(margin) for margin in margins]}

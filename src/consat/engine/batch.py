"""Many runs in rounds as one vectorised computation: a pool of lanes, one run in each. When a run ends, the next one takes its place.

A run in a lane ends at the same round as it would alone. It is frozen for the rest of the chunk of rounds, then its place in the pool is
given to a waiting run, so that no run waits for the slowest one.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.engine.chunks import NEVER, Ask, Chosen, Chunk, advance, start
from consat.engine.round import Now
from consat.engine.rounds import later
from consat.engine.rules import ENOUGH, HOLD, Rules
from consat.engine.tally import Tally
from consat.engine.world import World
from consat.numerics import float64, on_device, quickly_compiled
from consat.protocols import Rounds
from consat.protocols.estimates import Estimates
from consat.results.trace import Ending

LANES = 32
"""Largest number of lanes in a pool."""
NUMBERS = 2**17
"""Largest number of floats in the estimates of all lanes, chosen to fit in a cache."""


@dataclass(frozen=True, eq=False)
class Case:
    """Settings that runs share when only their starts and random seeds differ.

    Attributes:
        world: data that is constant during a run.
        gains: fields of the protocol that differ between cases.
        rules: stop rules.
        then: how runs continue that switch to another layout of copies; None if none does.
    """

    world: World
    gains: Mapping[str, float]
    rules: Rules
    then: Then | None = None


class Then(NamedTuple):
    """Switch to another layout of copies.

    Attributes:
        before: the layout before the switch.
        after: the layout after the switch.
        case: returns the case after the switch, the same object every time; built at the first call.
    """

    before: Estimates
    after: Estimates
    case: Callable[[], Case]


@dataclass(frozen=True, eq=False)
class Lane:
    """One run.

    Attributes:
        case: settings of the run.
        first: (C, d) initial estimates.
        seed: random seed of message loss and faults.
        tally: counters before the switch, for a run that continues; None for a new run.
    """

    case: Case
    first: np.ndarray
    seed: int
    tally: Tally | None = None


class Outcome(NamedTuple):
    """Result of a run: counters, final positions, (N, d), final estimates, (C, d), and the reason why it ended."""

    tally: Tally
    positions: np.ndarray
    estimates: np.ndarray
    ending: Ending


def like(case: Case) -> Hashable:
    """Key of a case; cases with equal keys can run as one computation."""
    leaves, structure = jax.tree.flatten(case.world)
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves), tuple(case.gains), case.rules.stop


@float64
def simulate_batch(protocol: Rounds, lanes: Sequence[Lane], progress: Callable[[float, float], None] = lambda *_: None) -> list[Outcome]:
    """Run lanes whose cases have equal keys; see `like`.

    Args:
        protocol: protocol of all runs.
        lanes: the runs.
        progress: called with the fraction of the runs that have ended, and the fraction of these that ended satisfied.

    Returns:
        The outcomes, in the order of `lanes`.
    """
    cases = list({id(lane.case): lane.case for lane in lanes}.values())
    shared = _Shared.of(protocol, cases)
    number = {id(case): k for k, case in enumerate(cases)}
    of_lane = np.array([number[id(lane.case)] for lane in lanes])
    size = 1 << max(0, min(LANES, NUMBERS // max(lanes[0].first.size, 1), len(lanes)) - 1).bit_length()
    pool = _Pool(shared, lanes, of_lane, size)
    satisfied = 0
    while pool.waiting or pool.running:
        pool.fill()
        for lane in pool.advance():
            pool.outcomes[lane] = pool.outcome(lane)
            satisfied += pool.outcomes[lane].tally.margin > 0
        progress(len(pool.outcomes) / len(lanes), satisfied / max(len(pool.outcomes), 1))
    _go_on(protocol, lanes, pool.outcomes)
    return [pool.outcomes[k] for k in range(len(lanes))]


def _go_on(protocol: Rounds, lanes: Sequence[Lane], outcomes: dict[int, Outcome]) -> None:
    """Continue the runs that switch to another layout of copies, and replace their outcomes."""
    groups: dict[Hashable, list[tuple[int, Lane]]] = defaultdict(list)
    for k, lane in enumerate(lanes):
        then, found = lane.case.then, outcomes[k]
        if then is not None and found.ending == "out of time" and found.tally.done < lane.case.rules.end:
            first = then.after.carried(then.before, found.estimates, found.positions)
            tally = dataclasses.replace(found.tally, turned=found.tally.done, near=0)
            groups[like(then.case())].append((k, Lane(then.case(), first, later(lane.seed), tally)))
    for some in groups.values():
        ended = simulate_batch(protocol, [lane for _, lane in some])
        outcomes |= {k: outcome for (k, _), outcome in zip(some, ended, strict=True)}


class _Varied(NamedTuple):
    """The leaves of a world and the gains that differ between cases; arrays whose first axis is the case or the lane."""

    leaves: tuple[Array, ...]
    gains: Mapping[str, Array]


class _Plan(NamedTuple):
    """Static argument of the compiled computation: protocol, tree structure of the worlds, and indices of the leaves that differ."""

    protocol: Rounds
    structure: Any
    places: tuple[int, ...]

    def merged(self, fixed: Sequence[Array], varied: _Varied) -> tuple[Rounds, World]:
        """Protocol and world of one lane."""
        left, given = iter(fixed), dict(zip(self.places, varied.leaves, strict=True))
        world = jax.tree.unflatten(self.structure, [given[k] if k in given else next(left) for k in range(self.structure.num_leaves)])
        protocol: Any = self.protocol
        return (dataclasses.replace(protocol, **varied.gains) if varied.gains else protocol), world


@dataclass(frozen=True, eq=False)
class _Shared:
    """Cases with equal keys.

    Attributes:
        plan: static argument of the computation.
        fixed: the leaves of a world that are the same in all cases.
        varied: the leaves that differ, stacked.
    """

    plan: _Plan
    fixed: tuple[Array, ...]
    varied: _Varied

    @classmethod
    def of(cls, protocol: Rounds, cases: Sequence[Case]) -> _Shared:
        structure = jax.tree.structure(cases[0].world)
        columns = [[np.asarray(leaf) for leaf in column] for column in zip(*(jax.tree.leaves(case.world) for case in cases), strict=True)]
        places = tuple(k for k, column in enumerate(columns) if any(not np.array_equal(leaf, column[0]) for leaf in column[1:]))
        gains = {name: jnp.asarray([case.gains[name] for case in cases], dtype=float) for name in cases[0].gains}
        return cls(
            _Plan(protocol, structure, places),
            tuple(on_device(column[0]) for k, column in enumerate(columns) if k not in places),
            _Varied(tuple(on_device(np.stack(columns[k])) for k in places), gains),
        )


class _Pool:
    """The lanes that run now. A place of the pool that is not needed any more holds a lane that advances by 0 rounds."""

    def __init__(self, shared: _Shared, lanes: Sequence[Lane], of_lane: np.ndarray, size: int) -> None:
        self._shared, self._lanes, self._of_lane, self._size = shared, lanes, of_lane, size
        self.waiting = list(range(len(lanes)))[::-1]
        self.running: dict[int, int] = {}
        self.tallies: dict[int, Tally] = {}
        self.endings: dict[int, Ending] = {}
        self.outcomes: dict[int, Outcome] = {}
        self._lane_at = np.zeros(size, dtype=int)
        self._state: Now | None = None
        self._varied: _Varied | None = None
        self._positions: np.ndarray | None = None
        self._estimates: np.ndarray | None = None

    def fill(self) -> None:
        """Start waiting lanes in the free places of the pool."""
        places = [place for place in range(self._size) if place not in self.running][: len(self.waiting)]
        if not places:
            return
        fresh = np.zeros(self._size, dtype=bool)
        fresh[places] = True
        for place in places:
            self.running[place] = self._lane_at[place] = self.waiting.pop()
        first = np.stack([self._lanes[lane].first for lane in self._lane_at])
        keys = jax.vmap(jax.random.key)(on_device(np.array([self._lanes[lane].seed for lane in self._lane_at])))
        self._varied = jax.tree.map(lambda leaf: leaf[self._of_lane[self._lane_at]], self._shared.varied)
        now, chunk = _begin(self._shared.plan, self._shared.fixed, self._varied, jnp.asarray(first), keys)
        self._state = now if self._state is None else _chosen(on_device(fresh), now, self._state)
        chunk = jax.tree.map(np.asarray, chunk)
        for place in places:
            lane = self.running[place]
            before = self._lanes[lane].tally
            tally = self.tallies[lane] = Tally() if before is None else before
            if before is None:
                tally.add(_row(chunk, place))

    def advance(self) -> list[int]:
        """Advance every lane by one chunk of rounds. Returns the lanes that have ended."""
        number, rounds, streak, hold, most, near, knowing = (np.zeros(self._size, dtype=np.int64) for _ in range(7))
        for place, lane in self.running.items():
            tally, rules = self.tallies[lane], self._lanes[lane].case.rules
            number[place], streak[place], near[place] = tally.done, tally.streak, tally.near
            rounds[place] = rules.chunk(tally)
            hold[place], most[place] = (HOLD, rules.most) if rules.stop == "satisfied" else (NEVER, NEVER)
            knowing[place] = ENOUGH[rules.stop]
        ask = Ask(*(on_device(values) for values in (number, rounds, streak, np.full_like(number, NEVER), hold, most, near, knowing)))
        assert self._state is not None
        assert self._varied is not None
        self._state, chunk = _advanced(self._shared.plan, self._shared.fixed, self._varied, self._state, ask)
        chunk, self._positions, self._estimates = jax.tree.map(np.asarray, (chunk, self._state.body, self._state.state.x))
        ended = []
        for place, lane in list(self.running.items()):
            tally, rules = self.tallies[lane], self._lanes[lane].case.rules
            if rounds[place]:
                tally.add(_row(chunk, place))
            found = rules.ending(tally, functools.partial(self._positions.__getitem__, place))
            if found is not None or tally.done >= rules.end or rules.turns(tally):
                self.endings[lane] = found or "out of time"
                ended.append(lane)
        return ended

    def outcome(self, lane: int) -> Outcome:
        """Outcome of a lane that has ended; frees its place."""
        place = next(place for place, other in self.running.items() if other == lane)
        del self.running[place]
        assert self._positions is not None
        assert self._estimates is not None
        return Outcome(self.tallies[lane], self._positions[place].copy(), self._estimates[place].copy(), self.endings[lane])


def _row(chunk: Chunk, place: int) -> Chunk:
    scalars = {name: leaf[place] for name, leaf in chunk._asdict().items() if name != "kept"}
    return Chunk(**scalars, kept=chunk.kept)


def _nobody() -> Chosen:
    return Chosen(*(jnp.zeros(0, jnp.int32) for _ in range(3)))


@quickly_compiled("plan")
def _begin(plan: _Plan, fixed: Any, varied: _Varied, first: Array, keys: Array) -> tuple[Now, Chunk]:
    return jax.vmap(lambda varied, first, key: start(*plan.merged(fixed, varied), _nobody(), first, key))(varied, first, keys)


@quickly_compiled("plan")
def _advanced(plan: _Plan, fixed: Any, varied: _Varied, now: Now, ask: Ask) -> tuple[Now, Chunk]:
    return jax.vmap(lambda varied, now, ask: advance(*plan.merged(fixed, varied), _nobody(), 1, now, ask))(varied, now, ask)


@quickly_compiled()
def _chosen(fresh: Array, new: Now, old: Now) -> Now:
    """The lanes of `new` that are `fresh`, (lanes,), and the others of `old`."""
    return jax.tree.map(lambda a, b: jnp.where(fresh.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)

"""Protocols in continuous time, integrated by diffrax."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.engine import Stop
from consat.engine.checkpoint import Checkpoint, fingerprint
from consat.engine.loop import Steps, follow
from consat.engine.recording import Choice, Memory, Rows, Sink
from consat.engine.violations import shares, violated
from consat.numerics import float64, quick_compilation
from consat.problem.objective import Nu, Objective, Schedule
from consat.problem.team import Team
from consat.problem.units import scale
from consat.protocols import Flow, State
from consat.protocols.estimates import Estimates, Exchange
from consat.results.trace import Ending, Trace, satisfied_from

HOLD = 10.0
"""How long (s) every margin must stay positive before a flow counts as satisfied."""
PATIENCE = 2000.0
"""How long (s) a flow may take when nobody says."""
SAMPLE = 0.1
"""Time between recorded samples, s."""
CHUNK = 100
"""Samples between two looks at the stop rule and the progress bar."""
SETTLED = 1e-4
"""A flow has settled when over `HOLD` no estimate moved by more than this fraction of the largest."""
MOST_IMPLICIT = 150
"""Up to this many numbers in the state an implicit solver is quicker, above an explicit one."""
MOST_STEPS = 100_000
"""Solver steps between two looks, after which a flow counts as too stiff."""
SHORTEST = 1e-12
"""The shortest step of a solver, s."""
ASTRAY = 1e6
"""A flow whose states are so many times as large as the team and its start has diverged: it is stopped before they overflow."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """What a protocol runs on: every agent's own objective over its copies, and the links between copies.

    Attributes:
        objective: over the rows of the state.
        exchange: the messages.
        own: (C, 1) 1.0 where the holder's own position stands.
        schedule: of ν.
        limit: states beyond it, in any entry, have diverged.
    """

    objective: Objective
    exchange: Exchange
    own: Array
    schedule: Schedule
    limit: Array

    @classmethod
    def of(cls, team: Team, estimates: Estimates, schedule: Schedule, limit: float = np.inf) -> Problem:
        objective = Objective.of(team, lambda family: estimates.rows(family.owner[:, None], family.agents), estimates.count)
        own = (estimates.holder == estimates.position)[:, None].astype(float)
        return cls(objective, estimates.exchange(), jnp.asarray(own), schedule, jnp.asarray(limit))

    def astray(self, state: State) -> Array:
        """Whether a state has diverged."""
        return jnp.any(jnp.stack([jnp.any(~(jnp.abs(leaf) <= self.limit)) for leaf in jax.tree.leaves(state)]))


@dataclass(frozen=True)
class Everyone:
    """`consat.protocols.Local`, for all agents at once."""

    problem: Problem
    nu: Nu

    @property
    def own(self) -> Array:
        return self.problem.own

    def ascent(self, x: Array) -> Array:
        return self.problem.objective.ascent(x, self.nu)

    def gradient(self, x: Array) -> Array:
        return self.problem.objective.gradient(x, self.nu)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Observer:
    """Who looks at the whole team, and whom they write down.

    Attributes:
        objective: over true positions.
        own: (N,) rows of own positions.
        agents: (R,) who is recorded, or None for all in order.
        copies: (E,) rows recorded, or None where estimates are not.
        watched: (W,) constraints of which it is counted how often they are violated.
    """

    objective: Objective
    own: Array
    agents: Array | None
    copies: Array | None
    watched: Array

    @classmethod
    def of(cls, team: Team, estimates: Estimates, choice: Choice) -> Observer:
        agents = None if choice.everyone else jnp.asarray(choice.agents)
        copies = None if choice.copies is None else jnp.asarray(choice.copies.astype(np.int32))
        return cls(Objective.at_positions(team), jnp.asarray(estimates.own), agents, copies, jnp.asarray(choice.watched))

    def look(self, flow: Flow, problem: Problem, time: Array, state: State) -> Rows:
        """The record of a time."""
        position = state.x[self.own]
        margins = self.objective.agent_margins(position)
        smooth = self.objective.smooth_margin(position, problem.schedule.at(time))
        velocity = rate(flow, problem, time, state).x[self.own]
        of_agents = (
            (position, velocity, margins) if self.agents is None else (values[self.agents] for values in (position, velocity, margins))
        )
        position, velocity, agent_margin = of_agents
        of_copies = (None, None) if self.copies is None else (state.x[self.copies], state.z[self.copies])
        return Rows(time, position, velocity, jnp.min(margins), smooth, agent_margin, *of_copies)


def rate(flow: Flow, problem: Problem, time: Array | float, state: State) -> State:
    """d/dt of everybody's state: the protocol's per-agent function over all rows."""
    local = Everyone(problem, problem.schedule.at(time))
    return flow.rate(state, local, problem.exchange.disagreement(flow.message(state)))


class Advance(NamedTuple):
    """An integration over some samples.

    Attributes:
        seen: the record of them; of those that were not reached, with no meaning.
        wrong: (T, W) which watched constraints are violated there.
        reached: (T,) which were.
        state: at the end.
        time: at the end, s.
        astray: whether the state had diverged there.
        moved: how far any position was, at a sample, from where it was at the start.
    """

    seen: Rows
    wrong: Array
    reached: Array
    state: State
    time: Array
    astray: Array
    moved: Array


@functools.cache
def _advance() -> Callable[..., Advance]:
    """The compiled integration, from ``times[0]`` over the samples ``times[1:]``, or to where it must end."""
    import diffrax
    import optimistix

    def solver(numbers: int) -> diffrax.AbstractSolver[Any]:
        if numbers > MOST_IMPLICIT:
            return diffrax.Tsit5()
        # the chord method with a fresh Jacobian takes 2 to 7 times fewer steps here than Kvaerno5's own choice
        return diffrax.Kvaerno5(root_finder=diffrax.with_stepsize_controller_tols(optimistix.Chord)())

    def advance(flow: Flow, problem: Problem, observer: Observer, state: State, times: Array) -> Advance:
        anchor = state.x[observer.own]

        def look(t: Array, y: State, _: Any) -> tuple[Rows, Array, Array]:
            at = y.x[observer.own]
            moved = jnp.max(jnp.abs(at - anchor), initial=0.0)
            return observer.look(flow, problem, jnp.asarray(t), y), moved, violated(observer.objective, observer.watched, at)

        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: rate(flow, problem, jnp.asarray(t), y)),
            solver(state.x.size + state.z.size),
            t0=times[0],
            t1=times[-1],
            dt0=None,
            y0=state,
            saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=times[1:], fn=look), diffrax.SubSaveAt(t1=True)]),
            stepsize_controller=diffrax.PIDController(rtol=1e-7, atol=1e-9, dtmin=SHORTEST, force_dtmin=False),
            max_steps=MOST_STEPS,
            throw=False,
            event=diffrax.Event(lambda t, y, _, **__: problem.astray(y)),
        )
        (seen, moved, wrong), last = solution.ys
        end = jax.tree.map(lambda leaf: leaf[-1], last)
        reached = jnp.isfinite(moved)
        least = jnp.max(jnp.where(reached, moved, 0.0))
        return Advance(seen, wrong & reached[:, None], reached, end, solution.ts[1][-1], problem.astray(end), least)

    return jax.jit(advance, static_argnames=("flow",), compiler_options=quick_compilation())


_rate = jax.jit(rate, static_argnames=("flow",))


def _largest(state: State) -> float:
    """The largest entry; not finite if one is not."""
    return float(max((np.abs(np.asarray(leaf)).max(initial=0.0) for leaf in jax.tree.leaves(state)), default=0.0))


@functools.partial(jax.jit, static_argnames=("flow",))
def _look(flow: Flow, problem: Problem, observer: Observer, time: Array, state: State) -> Rows:
    return jax.tree.map(lambda leaf: leaf[None], observer.look(flow, problem, time, state))


@float64
def simulate_flow(
    team: Team,
    flow: Flow,
    estimates: Estimates,
    schedule: Schedule,
    first: np.ndarray,
    *,
    until: float | None = None,
    stop: Stop = "satisfied",
    record: bool | None = None,
    choice: Choice | None = None,
    sink: Sink | None = None,
    checkpoint: Checkpoint | None = None,
    infeasible: Callable[[np.ndarray], bool] = lambda _: False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Trace:
    """Run a protocol in continuous time.

    Args:
        team: whose clusters are connected.
        flow: the protocol.
        estimates: the layout of copies.
        schedule: of ν.
        first: (C, d) first estimates, with x_i^(i)(0) = x_i(0).
        until: when to end, s; `PATIENCE` if None.
        stop: when to end earlier: every margin positive for `HOLD` (or `infeasible` and settled), settled, or never.
        record: whether to keep estimates and integral states; if None, while they are few.
        choice: what to record; if None, what the size of the team suggests.
        sink: where to; in memory if None.
        checkpoint: where to keep the state, and what to take up; nowhere and nothing if None.
        infeasible: says of (N, d) positions whether they prove that no formation satisfies every constraint.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    choice = choice or Choice.of(team, estimates, estimates=record)
    end = PATIENCE if until is None else until
    grid = np.linspace(0.0, end, max(round(end / SAMPLE), 1) + 1)
    size = scale(team)
    limit = ASTRAY * (size.reach + float(np.abs(size.center).max(initial=0.0)) + float(np.abs(first).max(initial=0.0)))
    problem, observer = Problem.of(team, estimates, schedule, limit), Observer.of(team, estimates, choice)
    known = "" if checkpoint is None else fingerprint(team, flow, schedule, first, estimates.layout, float(grid[1]))
    course = _Course(team, flow, problem, observer, first, grid, stop, infeasible, _Tally(every=choice.every))
    return follow(course, estimates, choice, sink=sink or Memory(choice.every), checkpoint=checkpoint, problem=known, progress=progress)


@dataclass
class _Tally(Steps):
    """What is counted of a flow.

    Attributes:
        time: of the last sample, s.
        satisfied_from: the time after the last at which the margin was ≤ 0, interpolated; None if the last margin is.
        good: for how many samples on end the margin has been positive.
        violated: (W,) at how many samples each watched constraint was violated.
    """

    time: float = 0.0
    satisfied_from: float | None = None
    good: int = 0
    violated: Any = 0

    def add(self, rows: Rows, violated: Any, moved: float = np.inf) -> None:
        """Count some samples, K of them, at which each watched constraint is `violated`, (K, W), or not."""
        count, first = len(rows.step), self.done < 0
        at, margin = (rows.step, rows.margin) if first else (np.append(self.time, rows.step), np.append(self.margin, rows.margin))
        bad = np.flatnonzero(~(rows.margin > 0))
        self.good = count - 1 - int(bad[-1]) if len(bad) else self.good + count
        if first or len(bad) or (self.satisfied_from is None):
            self.satisfied_from = satisfied_from(at, margin, interpolate=True)
        self.violated = np.asarray(self.violated) + np.sum(violated, axis=0)
        self.done += count
        self.time, self.margin, self.drift = float(rows.step[-1]), float(rows.margin[-1]), moved


@dataclass
class _Course:
    """A flow, for `consat.engine.loop`; `grid` are the times of all samples, the rest is as in `simulate_flow`."""

    team: Team
    flow: Flow
    problem: Problem
    observer: Observer
    first: np.ndarray
    grid: np.ndarray
    stop: Stop
    infeasible: Callable[[np.ndarray], bool]
    tally: _Tally

    def __post_init__(self) -> None:
        self.end = len(self.grid) - 1

    def start(self) -> tuple[State, Rows]:
        state = self.flow.start(jnp.asarray(self.first))
        rows = self.look(state)
        self.tally.add(rows, self._violated(state))
        return state, rows

    def advance(self, state: State, every: int) -> tuple[State, Rows, Ending | None]:
        done = self.tally.done
        times = self.grid[done : done + CHUNK + 1]
        padded = np.pad(times, (0, CHUNK + 1 - len(times)), mode="edge")
        if not done and self._overflows(state):
            return state, self.look(state).where(np.zeros(1, dtype=bool)), "diverged"
        ahead = _advance()(self.flow, self.problem, self.observer, state, jnp.asarray(padded))
        count = int(np.count_nonzero(np.asarray(ahead.reached)[: len(times) - 1]))
        rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], ahead.seen)._replace(step=times[1 : count + 1])
        if count == len(times) - 1:
            self.tally.add(rows, np.asarray(ahead.wrong)[:count], float(ahead.moved))
            return ahead.state, rows.where(np.arange(done + 1, done + 1 + count) % every == 0), self._ending(ahead.state)
        return self._early(state, ahead, rows, every)

    def _violated(self, state: State) -> Array:
        """(1, W) which watched constraints are violated."""
        return violated(self.observer.objective, self.observer.watched, state.x[self.observer.own])[None]

    def _overflows(self, state: State) -> bool:
        """Whether even the shortest step would lead astray."""
        largest = _largest(_rate(self.flow, self.problem, jnp.asarray(self.grid[0]), state))
        return not largest * SHORTEST <= float(self.problem.limit)

    def _early(self, before: State, ahead: Advance, rows: Rows, every: int) -> tuple[State, Rows, Ending]:
        """The end of a flow that did not get to the next sample: at its last state that is finite."""
        done, state = self.tally.done, ahead.state if np.isfinite(_largest(ahead.state)) else before
        if len(rows.step):
            self.tally.add(rows, np.asarray(ahead.wrong)[: len(rows.step)])
        kept = rows.where(np.arange(done + 1, done + 1 + len(rows.step)) % every == 0)
        ending: Ending = "diverged" if bool(ahead.astray) else "too stiff"
        if float(ahead.time) > self.tally.time and state is ahead.state:
            self.tally.time = float(ahead.time)
            last = self.look(state)
            self.tally.add(last, self._violated(state))
            kept = kept.joined(last.where(np.array([self.tally.done % every == 0])))
        return state, kept, ending

    def _ending(self, state: State) -> Ending | None:
        """Why the run should end now, or None."""
        tally = self.tally
        if self.stop == "satisfied" and tally.good > HOLD / SAMPLE:
            return "satisfied"
        if self.stop == "never" or tally.time < self.problem.schedule.duration + HOLD:
            return None
        at = self.positions(state)
        settled = tally.drift <= SETTLED * max(float(np.abs(at).max(initial=0.0)), 1e-300)
        return "settled" if settled and (self.stop == "converged" or self.infeasible(at)) else None

    def agree(self, stop: bool) -> bool:
        return stop

    def look(self, state: State) -> Rows:
        rows = _look(self.flow, self.problem, self.observer, jnp.asarray(self.tally.time), state)
        return jax.tree.map(np.asarray, rows)

    def positions(self, state: State) -> np.ndarray:
        return np.array(state.x[self.observer.own])

    def told(self, rows: Rows) -> Mapping[str, Any]:
        return {
            "clock": "time",
            "velocity": rows.velocity,
            "satisfied_from": self.tally.satisfied_from,
            "messages": None,
            "floats_sent": None,
            "bytes": None,
            "known": None,
            "known_from": None,
            "violated": shares(self.team, self.tally.violated, self.tally.done + 1),
        }

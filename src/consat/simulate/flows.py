"""Protocols in continuous time, integrated by diffrax."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.estimates import Estimates, Exchange
from consat.numerics import CompileClock, float64, quick_compilation
from consat.objective import Nu, Objective, Schedule
from consat.protocols import Flow, State
from consat.simulate import Stop
from consat.simulate.checkpoint import Checkpoint, fingerprint
from consat.simulate.interruption import heeded
from consat.simulate.recording import Choice, Memory, Rows, Sink, told
from consat.team import Team
from consat.trace import Ending, Trace, satisfied_from

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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """What a protocol runs on: every agent's own objective over its copies, and the links between copies.

    Attributes:
        objective: over the rows of the state.
        exchange: the messages.
        own: (C, 1) 1.0 where the holder's own position stands.
        schedule: of ν.
    """

    objective: Objective
    exchange: Exchange
    own: Array
    schedule: Schedule

    @classmethod
    def of(cls, team: Team, estimates: Estimates, schedule: Schedule) -> Problem:
        objective = Objective.of(team, lambda family: estimates.rows(family.owner[:, None], family.agents), estimates.count)
        own = (estimates.holder == estimates.position)[:, None].astype(float)
        return cls(objective, estimates.exchange(), jnp.asarray(own), schedule)


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
        copies: (E,) rows recorded, none where estimates are not.
    """

    objective: Objective
    own: Array
    agents: Array | None
    copies: Array

    @classmethod
    def of(cls, team: Team, estimates: Estimates, choice: Choice) -> Observer:
        agents = None if choice.everyone else jnp.asarray(choice.agents)
        copies = np.zeros(0, dtype=np.int32) if choice.copies is None else choice.copies.astype(np.int32)
        return cls(Objective.at_positions(team), jnp.asarray(estimates.own), agents, jnp.asarray(copies))

    def look(self, flow: Flow, problem: Problem, time: Array, state: State) -> Observed:
        """What is seen at a time."""
        position = state.x[self.own]
        margins = self.objective.agent_margins(position)
        smooth = self.objective.smooth_margin(position, problem.schedule.at(time))
        velocity = rate(flow, problem, time, state).x[self.own]
        if self.agents is not None:
            position, velocity, of_agents = (values[self.agents] for values in (position, velocity, margins))
        else:
            of_agents = margins
        return Observed(position, velocity, jnp.min(margins), smooth, of_agents, state.x[self.copies], state.z[self.copies])


class Observed(NamedTuple):
    """What is seen of a moment, or with a leading axis of several: of recorded agents and copies, and of the whole team."""

    position: Any
    velocity: Any
    margin: Any
    smooth_margin: Any
    agent_margin: Any
    estimate: Any
    integral: Any


def rate(flow: Flow, problem: Problem, time: Array | float, state: State) -> State:
    """d/dt of everybody's state: the protocol's per-agent function over all rows."""
    local = Everyone(problem, problem.schedule.at(time))
    return flow.rate(state, local, problem.exchange.disagreement(flow.message(state)))


@functools.cache
def _advance() -> Callable[..., tuple[Observed, State, Array, Array]]:
    """The compiled integration, from ``times[0]``: what is seen at ``times[1:]``, the state at the last of them, whether all went well, and
    how far any position was from where it was at the start."""
    import diffrax
    import optimistix

    def solver(numbers: int) -> diffrax.AbstractSolver[Any]:
        if numbers > MOST_IMPLICIT:
            return diffrax.Tsit5()
        # the chord method with a fresh Jacobian takes 2 to 7 times fewer steps here than Kvaerno5's own choice
        return diffrax.Kvaerno5(root_finder=diffrax.with_stepsize_controller_tols(optimistix.Chord)())

    def advance(flow: Flow, problem: Problem, observer: Observer, state: State, times: Array) -> tuple[Observed, State, Array, Array]:
        anchor = state.x[observer.own]

        def look(t: Array, y: State, _: Any) -> tuple[Observed, Array]:
            moved = jnp.max(jnp.abs(y.x[observer.own] - anchor), initial=0.0)
            return observer.look(flow, problem, jnp.asarray(t), y), moved

        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: rate(flow, problem, jnp.asarray(t), y)),
            solver(state.x.size + state.z.size),
            t0=times[0],
            t1=times[-1],
            dt0=None,
            y0=state,
            saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=times[1:], fn=look), diffrax.SubSaveAt(t1=True)]),
            stepsize_controller=diffrax.PIDController(rtol=1e-7, atol=1e-9, dtmin=1e-12, force_dtmin=False),
            max_steps=MOST_STEPS,
            throw=False,
        )
        (seen, moved), last = solution.ys
        # where the solver did not get
        seen = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(moved).reshape(-1, *[1] * (leaf.ndim - 1)), leaf, jnp.nan), seen)
        return seen, jax.tree.map(lambda leaf: leaf[-1], last), solution.result == diffrax.RESULTS.successful, jnp.max(moved)

    return jax.jit(advance, static_argnames=("flow",), compiler_options=quick_compilation())


@functools.partial(jax.jit, static_argnames=("flow",))
def _first_look(flow: Flow, problem: Problem, observer: Observer, time: Array, state: State) -> Observed:
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
    sink = sink or Memory(choice.every)
    end = PATIENCE if until is None else until
    grid = np.linspace(0.0, end, max(round(end / SAMPLE), 1) + 1)
    problem, observer = Problem.of(team, estimates, schedule), Observer.of(team, estimates, choice)
    state, tally = flow.start(jnp.asarray(first)), _Tally(every=choice.every)
    known = "" if checkpoint is None else fingerprint(team, flow, schedule, first, estimates.layout, float(grid[1]))
    ending: Ending = "out of time"
    with CompileClock() as clock, heeded() as stopped:
        taken = None if checkpoint is None else checkpoint.restore(state, known)
        if taken is None:
            tally.add(sink, choice, grid[:1], _first_look(flow, problem, observer, jnp.asarray(0.0), state))
        else:
            state, tally = taken[0], _Tally(**taken[1])
            sink.every = tally.every

        def save() -> None:
            if checkpoint is not None:
                sink.flush()
                checkpoint.write(state, tally.__dict__, known)

        while tally.done < len(grid) - 1:
            times = grid[tally.done : tally.done + CHUNK + 1]
            padded = np.pad(times, (0, CHUNK + 1 - len(times)), mode="edge")
            seen, state, fine, moved = _advance()(flow, problem, observer, state, jnp.asarray(padded))
            tally.add(sink, choice, times[1:], seen, float(moved))
            heard = told(progress, times[-1] / end, tally.margin)
            if not fine:
                found: Ending | None = "too stiff" if np.isfinite(tally.drift) else "diverged"
                state = state if found == "too stiff" else jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), state)
            else:
                found = _ending(tally, stop, schedule, state.x[observer.own], infeasible)
            if found is None and (stopped() or not heard):
                found = "interrupted"
            if found is not None:
                ending = found
                break
            if checkpoint is not None and checkpoint.due():
                save()
        save()
    if tally.done % sink.every:  # the last sample is always recorded
        seen = _first_look(flow, problem, observer, jnp.asarray(tally.time), state)
        _append(sink, choice, np.array([tally.time]), jax.tree.map(np.asarray, seen))
    rows = sink.close()
    return Trace(
        clock="time",
        steps=rows.step,
        position=rows.position,
        velocity=rows.velocity,
        margin=rows.margin,
        smooth_margin=rows.smooth_margin,
        agent_margin=rows.agent_margin,
        estimate=rows.estimate,
        integral=rows.integral,
        holder=estimates.holder if choice.copies is None else estimates.holder[choice.copies],
        held=estimates.position if choice.copies is None else estimates.position[choice.copies],
        cluster=estimates.cluster,
        ending=ending,
        satisfied_from=tally.satisfied_from,
        messages=None,
        floats_sent=None,
        known_from=None,
        seconds=clock.seconds,
        recorded=None if choice.everyone else choice.agents,
        final=np.array(state.x[observer.own]),
        drift=tally.drift,
        file=sink.path,
    )


@dataclass
class _Tally:
    """What is counted as time goes by; plain numbers, which a checkpoint holds.

    Attributes:
        done: samples after the first.
        time: of the last, s.
        margin: the last.
        satisfied_from: the time after the last at which the margin was ≤ 0, interpolated; None if the last margin is.
        good: for how many samples on end the margin has been positive.
        drift: of the last chunk.
        recorded: steps in the record.
        every: each how manieth sample is recorded.
    """

    done: int = -1
    time: float = 0.0
    margin: float = np.nan
    satisfied_from: float | None = None
    good: int = 0
    drift: float = np.inf
    recorded: int = 0
    every: int = 1

    def add(self, sink: Sink, choice: Choice, times: np.ndarray, seen: Observed, moved: float = np.inf) -> None:
        """Count some samples, and keep of them what is wanted."""
        count, first = len(times), self.done < 0
        seen = Observed(*(np.asarray(leaf)[:count] for leaf in seen))
        margin, at = (seen.margin, times) if first else (np.append(self.margin, seen.margin), np.append(self.time, times))
        bad = np.flatnonzero(~(seen.margin > 0))
        self.good = count - 1 - int(bad[-1]) if len(bad) else self.good + count
        if first or len(bad) or (self.satisfied_from is None):
            self.satisfied_from = satisfied_from(at, margin, interpolate=True)
        chosen = np.flatnonzero(np.arange(self.done + 1, self.done + 1 + count) % sink.every == 0)
        self.done += count
        self.time, self.margin, self.drift = float(times[-1]), float(seen.margin[-1]), moved
        _append(sink, choice, times[chosen], Observed(*(leaf[chosen] for leaf in seen)))
        self.recorded += len(chosen)
        self.every = sink.every


def _append(sink: Sink, choice: Choice, times: np.ndarray, seen: Observed) -> None:
    estimate, integral = (None, None) if choice.copies is None else (seen.estimate, seen.integral)
    sink.append(Rows(times, seen.position, seen.velocity, seen.margin, seen.smooth_margin, seen.agent_margin, estimate, integral))


def _ending(tally: _Tally, stop: Stop, schedule: Schedule, positions: Array, infeasible: Callable[[np.ndarray], bool]) -> Ending | None:
    """Why the run should end now, or None."""
    if stop == "satisfied" and tally.good > HOLD / SAMPLE:
        return "satisfied"
    if stop == "never" or tally.time < schedule.duration + HOLD:
        return None
    at = np.asarray(positions)
    settled = tally.drift <= SETTLED * max(float(np.abs(at).max(initial=0.0)), 1e-300)
    return "settled" if settled and (stop == "converged" or infeasible(at)) else None

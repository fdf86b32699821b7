"""Simulation of continuous-time protocols, integrated by diffrax."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array

from consat.engine.checkpoint import Checkpoint, fingerprint
from consat.engine.loop import Steps, follow
from consat.engine.recording import Choice, Memory, Rows, Sink
from consat.engine.violations import shares, violated
from consat.numerics import float64, on_device, quickly_compiled
from consat.problem.objective import Nu, Objective, SmoothingSchedule
from consat.problem.team import Team
from consat.problem.units import scale
from consat.protocols import Flow, State
from consat.protocols.estimates import Estimates, Exchange
from consat.results.trace import Ending, Trace, satisfied_from
from consat.settings import Stop

HOLD = 10.0
"""Time (s) for which every margin must stay positive before a flow counts as satisfied."""
PATIENCE = 2000.0
"""Default limit of a flow's time, s."""
SAMPLE = 0.1
"""Time between recorded samples, s."""
CHUNK = 100
"""Number of samples between two checks of the stop rule and updates of the progress bar."""
SETTLED = 1e-4
"""A flow has settled when over `HOLD` no coordinate moved by more than this fraction of the largest coordinate."""
MOST_IMPLICIT = 150
"""Largest number of floats in the state for which the implicit solver is used, because it is faster there; else an explicit one."""
MOST_STEPS = 100_000
"""Number of solver steps in one chunk after which a flow counts as too stiff."""
SHORTEST = 1e-12
"""Smallest solver step, s."""
ASTRAY = 1e6
"""A flow has diverged when an entry of its state exceeds this multiple of the size of the team and its start; it ends before overflow."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """Data of a flow: every agent's objective over its copies, and the links between copies.

    Attributes:
        objective: local objectives over the rows of the state.
        exchange: edges between copies.
        own: (C, 1) 1.0 on rows of own positions, else 0.0.
        schedule: schedule of ν over time.
        limit: () largest absolute value of an entry of the state before the flow counts as diverged.
    """

    objective: Objective
    exchange: Exchange
    own: Array
    schedule: SmoothingSchedule
    limit: Array

    @classmethod
    def of(cls, team: Team, estimates: Estimates, schedule: SmoothingSchedule, limit: float = np.inf) -> Problem:
        objective = Objective.of(team, lambda family: estimates.rows(family.owner[:, None], family.agents), estimates.count)
        own = (estimates.holder == estimates.position)[:, None].astype(float)
        return cls(objective, estimates.exchange(), on_device(own), schedule, on_device(limit))

    def astray(self, state: State) -> Array:
        """() whether a state has diverged."""
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
    """Observer of the whole team, which selects what is recorded.

    Attributes:
        objective: objective over the agents' positions.
        own: (N,) rows of own positions.
        agents: (R,) recorded agents; None for all.
        copies: (E,) recorded rows; None if estimates are not recorded.
        watched: (W,) constraints whose violations are counted.
    """

    objective: Objective
    own: Array
    agents: Array | None
    copies: Array | None
    watched: Array

    @classmethod
    def of(cls, team: Team, estimates: Estimates, choice: Choice) -> Observer:
        agents = None if choice.everyone else on_device(choice.agents)
        copies = None if choice.copies is None else on_device(choice.copies.astype(np.int32))
        return cls(Objective.at_positions(team), on_device(estimates.own), agents, copies, on_device(choice.watched))

    def look(self, flow: Flow, problem: Problem, time: Array, state: State) -> Rows:
        """Record of one time, s."""
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
    """Time derivative of the state of all agents: the protocol's per-agent function over all rows."""
    local = Everyone(problem, problem.schedule.at(time))
    return flow.rate(state, local, problem.exchange.disagreement(flow.message(state)))


class Advance(NamedTuple):
    """Result of the integration over T samples.

    Attributes:
        seen: record of the samples; meaningless for samples that were not reached.
        wrong: (T, W) which watched constraints are violated at each sample.
        reached: (T,) which samples were reached.
        state: state at the end.
        time: () time at the end, s.
        astray: () whether the state at the end has diverged.
        moved: () largest distance on any axis of a position, at a sample, from its value at the start.
    """

    seen: Rows
    wrong: Array
    reached: Array
    state: State
    time: Array
    astray: Array
    moved: Array


@quickly_compiled("flow")
def _advanced(flow: Flow, problem: Problem, observer: Observer, state: State, times: Array) -> Advance:
    """The integration from ``times[0]`` over the samples ``times[1:]``. It ends early where it diverges or is too stiff."""
    anchor = state.x[observer.own]

    def look(t: Array, y: State, _: Any) -> tuple[Rows, Array, Array]:
        at = y.x[observer.own]
        moved = jnp.max(jnp.abs(at - anchor), initial=0.0)
        return observer.look(flow, problem, jnp.asarray(t), y), moved, violated(observer.objective, observer.watched, at)

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: rate(flow, problem, jnp.asarray(t), y)),
        _solver(state.x.size + state.z.size),
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


def _solver(numbers: int) -> diffrax.AbstractSolver[Any]:
    """The solver for a state of so many floats."""
    if numbers > MOST_IMPLICIT:
        return diffrax.Tsit5()
    # the chord method with a fresh Jacobian takes 2 to 7 times fewer steps here than Kvaerno5's own choice
    return diffrax.Kvaerno5(root_finder=diffrax.with_stepsize_controller_tols(optimistix.Chord)())


_rate = jax.jit(rate, static_argnames=("flow",))


def _largest(state: State) -> float:
    """Largest absolute value of an entry; not finite if an entry is not finite."""
    return float(max((np.abs(np.asarray(leaf)).max(initial=0.0) for leaf in jax.tree.leaves(state)), default=0.0))


@functools.partial(jax.jit, static_argnames=("flow",))
def _look(flow: Flow, problem: Problem, observer: Observer, time: Array, state: State) -> Rows:
    return jax.tree.map(lambda leaf: leaf[None], observer.look(flow, problem, time, state))


@float64
def simulate_flow(
    team: Team,
    flow: Flow,
    estimates: Estimates,
    schedule: SmoothingSchedule,
    first: np.ndarray,
    *,
    until: float | None = None,
    stop: Stop = "satisfied",
    choice: Choice | None = None,
    sink: Sink | None = None,
    checkpoint: Checkpoint | None = None,
    infeasible: Callable[[np.ndarray], bool] = lambda _: False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Trace:
    """Simulate a continuous-time protocol.

    Args:
        team: team with connected clusters.
        flow: the protocol.
        estimates: the layout of copies.
        schedule: schedule of ν over time.
        first: (C, d) initial estimates, with x_i^(i)(0) = x_i(0).
        until: end time, s; `PATIENCE` if None.
        stop: ``satisfied``: end when every margin was positive for `HOLD`, or when the flow has settled and `infeasible` holds.
            ``converged``: end when the flow has settled. ``never``: run until `until`.
        choice: what to record; if None, a choice that depends on the size of the team.
        sink: where to record; in memory if None.
        checkpoint: where to save the state, and the checkpoint to resume from; None for neither.
        infeasible: tells whether positions, (N, d), prove that no formation satisfies every constraint.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    choice = choice or Choice.of(team, estimates)
    end = PATIENCE if until is None else until
    grid = np.linspace(0.0, end, max(round(end / SAMPLE), 1) + 1)
    size = scale(team)
    limit = ASTRAY * (size.reach + float(np.abs(size.center).max(initial=0.0)) + float(np.abs(first).max(initial=0.0)))
    problem, observer = Problem.of(team, estimates, schedule, limit), Observer.of(team, estimates, choice)
    known = "" if checkpoint is None else fingerprint(team, flow, schedule, first, estimates.layout, float(grid[1]))
    simulation = _FlowSimulation(team, flow, problem, observer, first, grid, stop, infeasible, _Tally(every=choice.every))
    return follow(simulation, estimates, choice, sink=sink or Memory(choice.every), checkpoint=checkpoint, problem=known, progress=progress)


@dataclass
class _Tally(Steps):
    """Counters of a flow.

    Attributes:
        time: time of the last sample, s.
        satisfied_from: time, s, from which on the margin has been positive, interpolated between samples; None if it is not now.
        good: number of consecutive samples, up to now, with a positive margin.
        violated: (W,) number of samples at which each watched constraint was violated.
    """

    time: float = 0.0
    satisfied_from: float | None = None
    good: int = 0
    violated: Any = 0

    def add(self, rows: Rows, violated: Any, moved: float = np.inf) -> None:
        """Count K samples.

        Args:
            rows: their record.
            violated: (K, W) whether each watched constraint was violated.
            moved: largest distance of a position from its value at the start of the chunk.
        """
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
class _FlowSimulation:
    """`consat.engine.loop.Simulation` of a flow. `grid`: times of all samples, s; the other fields are as in `simulate_flow`."""

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
        self.state = self.flow.start(on_device(self.first))

    def start(self) -> Rows:
        rows = self.look()
        self.tally.add(rows, self._violated())
        return rows

    def advance(self, every: int) -> tuple[Rows, Ending | None]:
        done = self.tally.done
        times = self.grid[done : done + CHUNK + 1]
        padded = np.pad(times, (0, CHUNK + 1 - len(times)), mode="edge")
        if not done and self._overflows():
            return self.look().where(np.zeros(1, dtype=bool)), "diverged"
        ahead = _advanced(self.flow, self.problem, self.observer, self.state, on_device(padded))
        count = int(np.count_nonzero(np.asarray(ahead.reached)[: len(times) - 1]))
        rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], ahead.seen)._replace(step=times[1 : count + 1])
        if count == len(times) - 1:
            self.state = ahead.state
            self.tally.add(rows, np.asarray(ahead.wrong)[:count], float(ahead.moved))
            return rows.where(np.arange(done + 1, done + 1 + count) % every == 0), self._ending()
        return self._early(ahead, rows, every)

    def _violated(self) -> Array:
        """(1, W) which watched constraints are violated now."""
        return violated(self.observer.objective, self.observer.watched, self.state.x[self.observer.own])[None]

    def _overflows(self) -> bool:
        """Whether even the smallest solver step would make the state diverge."""
        largest = _largest(_rate(self.flow, self.problem, on_device(self.grid[0]), self.state))
        return not largest * SHORTEST <= float(self.problem.limit)

    def _early(self, ahead: Advance, rows: Rows, every: int) -> tuple[Rows, Ending]:
        """End a flow that did not reach the last sample of the chunk, at its last finite state."""
        done, finite = self.tally.done, bool(np.isfinite(_largest(ahead.state)))
        self.state = ahead.state if finite else self.state
        if len(rows.step):
            self.tally.add(rows, np.asarray(ahead.wrong)[: len(rows.step)])
        kept = rows.where(np.arange(done + 1, done + 1 + len(rows.step)) % every == 0)
        ending: Ending = "diverged" if bool(ahead.astray) else "too stiff"
        if finite and float(ahead.time) > self.tally.time:
            self.tally.time = float(ahead.time)
            last = self.look()
            self.tally.add(last, self._violated())
            kept = kept.joined(last.where(np.array([self.tally.done % every == 0])))
        return kept, ending

    def _ending(self) -> Ending | None:
        """Reason to end the run now; None to go on."""
        tally = self.tally
        if self.stop == "satisfied" and tally.good > HOLD / SAMPLE:
            return "satisfied"
        if self.stop == "never" or tally.time < self.problem.schedule.duration + HOLD:
            return None
        at = self.positions()
        settled = tally.drift <= SETTLED * max(float(np.abs(at).max(initial=0.0)), 1e-300)
        return "settled" if settled and (self.stop == "converged" or self.infeasible(at)) else None

    def agree(self, stop: bool) -> bool:
        return stop

    def look(self) -> Rows:
        rows = _look(self.flow, self.problem, self.observer, on_device(self.tally.time), self.state)
        return jax.tree.map(np.asarray, rows)

    def positions(self) -> np.ndarray:
        return np.array(self.state.x[self.observer.own])

    def account(self, rows: Rows) -> Mapping[str, Any]:
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

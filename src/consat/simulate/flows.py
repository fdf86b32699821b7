"""Protocols in continuous time, integrated by diffrax."""

from __future__ import annotations

import functools
import operator
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
MOST_NUMBERS = 1000
"""Estimates and integral states are recorded by default while there are at most this many numbers in each."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """What a protocol runs on: every agent's own objective over its copies, and the links between copies.

    Attributes:
        objective: over the rows of the state.
        exchange: the messages.
        holder: (C,) who holds each row.
        own: (C, 1) 1.0 where the holder's own position stands.
        schedule: of ν.
    """

    objective: Objective
    exchange: Exchange
    holder: Array
    own: Array
    schedule: Schedule

    @classmethod
    def of(cls, team: Team, estimates: Estimates, schedule: Schedule) -> Problem:
        objective = Objective.of(team, lambda family: estimates.rows(family.owner[:, None], family.agents), estimates.count)
        own = (estimates.holder == estimates.position)[:, None].astype(float)
        return cls(objective, estimates.exchange(), jnp.asarray(estimates.holder), jnp.asarray(own), schedule)


@dataclass(frozen=True)
class Everyone:
    """`consat.protocols.Local`, for all agents at once."""

    problem: Problem
    nu: Nu

    @property
    def own(self) -> Array:
        return self.problem.own

    def ascent(self, x: Array) -> Array:
        return self.problem.objective.ascent(x, self.nu)[1]

    def gradient(self, x: Array) -> Array:
        log_f, ascent = self.problem.objective.ascent(x, self.nu)
        return -self.nu.beta * jnp.exp(log_f)[self.problem.holder, None] * ascent


class Observed(NamedTuple):
    """What an observer of the whole team sees; leading axis T."""

    position: Any
    velocity: Any
    margin: Any
    smooth_margin: Any
    agent_margin: Any


def rate(flow: Flow, problem: Problem, time: Array | float, state: State) -> State:
    """d/dt of everybody's state: the protocol's per-agent function over all rows."""
    local = Everyone(problem, problem.schedule.at(time))
    return flow.rate(state, local, problem.exchange.disagreement(flow.message(state)))


@functools.cache
def _advance() -> Callable[[Flow, Problem, State, Array], tuple[State, Array]]:
    """The compiled integration, from ``times[0]``: the states at ``times[1:]``, and whether all went well."""
    import diffrax
    import optimistix

    def solver(numbers: int) -> diffrax.AbstractSolver[Any]:
        if numbers > MOST_IMPLICIT:
            return diffrax.Tsit5()
        # the chord method with a fresh Jacobian takes 2 to 7 times fewer steps here than Kvaerno5's own choice
        return diffrax.Kvaerno5(root_finder=diffrax.with_stepsize_controller_tols(optimistix.Chord)())

    def advance(flow: Flow, problem: Problem, state: State, times: Array) -> tuple[State, Array]:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: rate(flow, problem, jnp.asarray(t), y)),
            solver(state.x.size + state.z.size),
            t0=times[0],
            t1=times[-1],
            dt0=None,
            y0=state,
            saveat=diffrax.SaveAt(ts=times[1:]),
            stepsize_controller=diffrax.PIDController(rtol=1e-7, atol=1e-9, dtmin=1e-12, force_dtmin=False),
            max_steps=MOST_STEPS,
            throw=False,
        )
        return solution.ys, solution.result == diffrax.RESULTS.successful

    return jax.jit(advance, static_argnames=("flow",), compiler_options=quick_compilation())


@functools.partial(jax.jit, static_argnames=("flow",))
def _observe(flow: Flow, problem: Problem, observer: Objective, own: Array, times: Array, states: State) -> Observed:
    def look(moment: tuple[Array, State]) -> Observed:
        time, state = moment
        position = state.x[own]
        margins = observer.agent_margins(position)
        smooth = observer.smooth_margin(position, problem.schedule.at(time))
        return Observed(position, rate(flow, problem, time, state).x[own], jnp.min(margins), smooth, margins)

    return jax.lax.map(look, (times, states))


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
        infeasible: says of (N, d) positions whether they prove that no formation satisfies every constraint.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    record = estimates.count * team.dimension <= MOST_NUMBERS if record is None else record
    end = PATIENCE if until is None else until
    grid = np.linspace(0.0, end, max(round(end / SAMPLE), 1) + 1)
    state = flow.start(jnp.asarray(first))
    recorder = _Recorder(flow, Problem.of(team, estimates, schedule), Objective.at_positions(team), jnp.asarray(estimates.own), record)
    ending: Ending = "out of time"
    with CompileClock() as clock:
        recorder.look(grid[:1], jax.tree.map(lambda leaf: leaf[None], state))
        try:
            for begin in range(0, len(grid) - 1, CHUNK):
                times = grid[begin : begin + CHUNK + 1]
                padded = np.pad(times, (0, CHUNK + 1 - len(times)), mode="edge")
                states, fine = _advance()(flow, recorder.problem, state, jnp.asarray(padded))
                states = jax.tree.map(operator.itemgetter(slice(len(times) - 1)), states)
                recorder.look(times[1:], states)
                state = jax.tree.map(lambda leaf: leaf[-1], states)
                progress(times[-1] / end, recorder.margin[-1])
                if not fine:
                    ending = "too stiff" if recorder.finite else "diverged"
                    break
                if stop == "satisfied" and recorder.satisfied_for(HOLD):
                    ending = "satisfied"
                    break
                settled = stop != "never" and times[-1] >= schedule.duration + HOLD and recorder.settled(HOLD)
                if settled and (stop == "converged" or infeasible(recorder.position[-1])):
                    ending = "settled"
                    break
        except KeyboardInterrupt:
            ending = "interrupted"
    return recorder.trace(estimates, ending, clock.seconds)


class _Recorder:
    """Collects what an observer sees, chunk by chunk."""

    def __init__(self, flow: Flow, problem: Problem, observer: Objective, own: Array, record: bool) -> None:
        self.flow, self.problem, self.observer, self.own, self.record = flow, problem, observer, own, record
        self.times: list[np.ndarray] = []
        self.seen: list[Observed] = []
        self.states: list[State] = []

    def look(self, times: np.ndarray, states: State) -> None:
        """Add the states at some times; keep the last one's copies in any case."""
        seen = _observe(self.flow, self.problem, self.observer, self.own, jnp.asarray(times), states)
        self.times.append(times)
        self.seen.append(jax.tree.map(np.asarray, seen))
        self.states = [*(self.states if self.record else self.states[-1:]), jax.tree.map(np.asarray, states)]

    @property
    def margin(self) -> np.ndarray:
        return np.concatenate([seen.margin for seen in self.seen])

    @property
    def position(self) -> np.ndarray:
        return np.concatenate([seen.position for seen in self.seen])

    @property
    def finite(self) -> bool:
        return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(self.states[-1]))

    def _lately(self, span: float) -> int:
        """How many of the last samples cover `span`; 0 if the run is not yet that long."""
        times = np.concatenate(self.times)
        recent = times >= times[-1] - span - 1e-9
        return 0 if recent.all() and times[-1] - times[0] < span - 1e-9 else int(recent.sum())

    def satisfied_for(self, span: float) -> bool:
        count = self._lately(span)
        return count > 0 and bool((self.margin[-count:] > 0).all())

    def settled(self, span: float) -> bool:
        count = self._lately(span)
        moved = self.position[-count:] - self.position[-1]
        return count > 0 and bool(np.abs(moved).max() <= SETTLED * max(np.abs(self.position[-1]).max(), 1e-300))

    def trace(self, estimates: Estimates, ending: Ending, seconds: dict[str, float]) -> Trace:
        steps, margin = np.concatenate(self.times), self.margin
        return Trace(
            clock="time",
            steps=steps,
            position=self.position,
            velocity=np.concatenate([seen.velocity for seen in self.seen]),
            margin=margin,
            smooth_margin=np.concatenate([seen.smooth_margin for seen in self.seen]),
            agent_margin=np.concatenate([seen.agent_margin for seen in self.seen]),
            estimate=np.concatenate([state.x for state in self.states]) if self.record else None,
            integral=np.concatenate([state.z for state in self.states]) if self.record else None,
            holder=estimates.holder,
            held=estimates.position,
            cluster=estimates.cluster,
            ending=ending,
            satisfied_from=satisfied_from(steps, margin, interpolate=True),
            messages=None,
            floats_sent=None,
            known_from=None,
            seconds=seconds,
        )

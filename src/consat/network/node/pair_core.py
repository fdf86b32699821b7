"""Core of one agent for the interior-point protocol, `consat.protocols.interior_point`, which sends one message per neighbour.

Knowledge about the team beyond the neighbours must become invalid after false messages and after changes of the team:

* The bound is the best one of the last `FORGET` to 2 `FORGET` steps.
* An agent whose constraints change (also because an agent has left or joined) raises its count of changes. Every message contains the
  count, and every agent adopts the largest one. A proof is used only if its count equals the agent's own; proofs restart when the count
  rises. So for each count every agent has one set of constraints, and the bound is valid for these.
* A proof holds for a region around the team's centre that is common knowledge from the start. An agent sends no proof while its constraints
  reach farther than `FAR` reaches from the centre, because they were changed.
* The smallest margin behind a silent neighbour is unknown.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import Core, IndexMap, Moment, Rows, StepResult
from consat.network.node.pairs import MessageLayout, Packing
from consat.network.node.part import Part
from consat.network.node.problem import OwnSolver
from consat.numerics import quickly_compiled
from consat.problem.constraints.library import farthest
from consat.protocols import InteriorPoint, Known
from consat.protocols.interior_point import InteriorState

FORGET: Final = 300
"""Number of steps after which a bound may be forgotten."""
FAR: Final = 3.0
"""Largest distance, in reaches, to which the constraints of an agent with proofs may lead. The region of a proof has a radius of ten
reaches, so that agents may follow their neighbours farther than their own constraints require."""


class PairState(NamedTuple):
    """State of the agent.

    Attributes:
        inner: state of the protocol.
        bounds: (2,) the best bound of the last complete period of `FORGET` steps, and of the present period.
        turns: () number of steps.
    """

    inner: InteriorState
    bounds: Array
    turns: Array


class PairCore(Core):
    """See the module."""

    def __init__(self, protocol: InteriorPoint, whole: Part, gone: Collection[str] = ()) -> None:
        super().__init__(protocol, whole, gone)
        self.width, self.largest = 0, np.zeros(0)
        layouts = {neighbour.id: MessageLayout.of(neighbour, whole.team.dimension) for neighbour in whole.neighbours}
        self.pair_numbers = {neighbour: layout.numbers() for neighbour, layout in layouts.items()}
        self._weights = [layouts[neighbour.id].weight for neighbour in self.part.neighbours]
        assert self.solver.interior is not None
        self.packing = Packing.of(whole, self.part, self.solver.interior.plan.width)
        order = [neighbour for neighbour, _ in self.ends]
        self._end = np.array([order.index(neighbour.id) for neighbour in self.part.neighbours], dtype=int)

    def begin(self, first: np.ndarray, time: float = 0.0) -> PairState:
        return _begin(self.protocol, self.solver, first, time)

    def turn(self, state: PairState, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        heard = inbox.pair, arrived.pair, moment.fresh[self._end]
        when = moment.round, moment.margin, moment.time
        state, mail, bound, least = _turn(self.protocol, self.solver, self.packing, state, heard, when)
        outbox = np.array(mail)
        if proves_nothing := asks_for(self.part) > FAR * self.part.reach:
            for row, weight in zip(outbox, self._weights, strict=True):
                row[weight:] = 0.0
                row[weight] = -1.0
        return StepResult(
            state, Rows(inbox.link, outbox), np.asarray(state.inner.x), np.inf if proves_nothing else float(bound), float(least)
        )

    def without_proofs(self, state: PairState) -> PairState:
        """Copy of the state with the count of changes raised by one, and without bounds."""
        return state._replace(inner=state.inner.changed([0]), bounds=np.full(2, np.inf))  # type: ignore[arg-type] # JAX would compile

    def carry(self, other: Core, state: PairState, first: np.ndarray, time: float = 0.0) -> PairState:
        """Initial state with the old estimates, and with the count of changes raised by one."""
        fresh = self.begin(np.asarray(IndexMap.of(self, other).rows(state.inner.x, first)), time)
        memory = fresh.inner.memory._replace(changes=state.inner.memory.changes + 1.0)
        return fresh._replace(inner=fresh.inner._replace(memory=memory))


@functools.lru_cache(maxsize=64)
def asks_for(part: Part) -> float:
    """Largest distance from the team's centre to which the agent's constraints may lead an agent, length."""
    return max((farthest(family.psi, family.parameters, part.center) for family in part.team.families), default=0.0)


@quickly_compiled("protocol")
def _begin(protocol: InteriorPoint, solver: OwnSolver, first: Any, time: Any) -> PairState:
    return _strong(PairState(protocol.start(first, solver.at(time)), jnp.full(2, jnp.inf), jnp.zeros(())))


def _strong(state: PairState) -> PairState:
    """Copy of the state with strong types in place of JAX's weak types: the first state must have the types of the later ones, or JAX
    compiles a step twice."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), state)


@quickly_compiled("protocol")
def _turn(
    protocol: InteriorPoint,
    solver: OwnSolver,
    packing: Packing,
    state: PairState,
    heard: tuple[Any, Any, Any],
    moment: tuple[Any, Any, Any],
) -> tuple[PairState, Array, Array, Array]:
    (inbox, arrived, fresh), (round_, margin, time) = heard, moment
    solver = solver.at(time)
    inner = protocol.hear(state.inner, packing.unpack(inbox), arrived, solver)
    inner = inner._replace(
        memory=inner.memory._replace(bound=jnp.full(1, jnp.inf)),
        inbox=inner.inbox._replace(margin=jnp.where(fresh, inner.inbox.margin, -jnp.inf)),
    )
    own = jnp.asarray(margin)[None]
    inner, message = protocol.speak(inner, solver, round_, Known(jnp.zeros(1), own))
    (bound,), (least,) = protocol.proven(inner, solver, own)
    older, since = jnp.where(inner.memory.changes > state.inner.memory.changes, jnp.inf, state.bounds)
    since = jnp.minimum(since, bound)
    full = (state.turns + 1.0) % FORGET == 0
    bounds = jnp.where(full, jnp.stack([since, jnp.full_like(since, jnp.inf)]), jnp.stack([older, since]))
    return _strong(PairState(inner, bounds, state.turns + 1.0)), packing.pack(message), jnp.min(bounds), least

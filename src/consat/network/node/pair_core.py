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
from collections.abc import Callable, Collection
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import Core, IndexMap, Moment, Rows, StepResult
from consat.network.node.pairs import MessageLayout, Packing
from consat.network.node.part import Part
from consat.network.node.problem import OwnSolver, ends
from consat.numerics import quick_compilation
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


class PairCore:
    """`consat.network.node.core.Core` of the interior-point protocol; see the module.

    Args:
        protocol: the protocol.
        whole: the agent's part, with all agents.
        gone: agents that are absent.
    """

    def __init__(self, protocol: InteriorPoint, whole: Part, gone: Collection[str] = ()) -> None:
        self.protocol, self.whole = protocol, whole
        self.part = whole.without(gone)
        self.ends = ends(self.part)
        self.solver = OwnSolver.of(self.part, protocol.speaks)
        self.width, self.largest = 0, np.zeros(0)
        self.pair_numbers = {neighbour.id: MessageLayout.of(neighbour, whole.team.dimension).numbers() for neighbour in whole.neighbours}
        assert self.solver.interior is not None
        self.packing = Packing.of(whole, self.part, self.solver.interior.plan.width)
        self._weight = {neighbour.id: MessageLayout.of(neighbour, whole.team.dimension).weight for neighbour in whole.neighbours}
        order = [neighbour for neighbour, _ in self.ends]
        self._end = np.array([order.index(neighbour.id) for neighbour in self.part.neighbours], dtype=int)
        self._begin, self._turn = _compiled()

    def begin(self, first: np.ndarray, time: float = 0.0) -> PairState:
        return self._begin(self.protocol, self.solver, first, time)

    def turn(self, state: PairState, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        heard = inbox.pair, arrived.pair, moment.fresh[self._end]
        when = moment.round, moment.margin, moment.time
        state, said, bound, least = self._turn(self.protocol, self.solver, self.packing, state, heard, when)
        said = np.asarray(said)
        if asks_for(self.part) > FAR * self.part.reach:
            said, bound = self._without_proof(said), np.inf
        return StepResult(state, Rows(inbox.link, said), np.asarray(state.inner.x), float(bound), float(least))

    def _without_proof(self, said: np.ndarray) -> np.ndarray:
        said = said.copy()
        for row, neighbour in zip(said, self.part.neighbours, strict=True):
            at = self._weight[neighbour.id]
            row[at:] = 0.0
            row[at] = -1.0
        return said

    def without(self, gone: Collection[str], whole: Part | None = None) -> PairCore:
        return PairCore(self.protocol, whole or self.whole, gone)

    def without_proofs(self, state: PairState) -> PairState:
        """Copy of the state with the count of changes raised by one, and without bounds."""
        memory: Any = state.inner.memory
        more: Any = {"changes": np.asarray(memory.changes) + 1.0, "bound": np.full(np.shape(memory.bound), np.inf)}  # JAX would compile
        forgotten: Any = np.full(2, np.inf)
        return state._replace(inner=state.inner._replace(memory=memory._replace(**more)), bounds=forgotten)

    def carry(self, other: Core, state: PairState, first: np.ndarray, time: float = 0.0) -> PairState:
        """Initial state with the old estimates, and with the count of changes raised by one."""
        fresh = self.begin(np.asarray(IndexMap.of(self, other).merge("row", state.inner.x, first)), time)
        memory = fresh.inner.memory._replace(changes=state.inner.memory.changes + 1.0)
        return fresh._replace(inner=fresh.inner._replace(memory=memory))


@functools.lru_cache(maxsize=64)
def asks_for(part: Part) -> float:
    """Largest distance from the team's centre to which the agent's constraints may lead an agent, length."""
    return max((farthest(family.psi, family.parameters, part.center) for family in part.team.families), default=0.0)


def _begin(protocol: InteriorPoint, solver: OwnSolver, first: Array, time: Array) -> PairState:
    return _strong(PairState(protocol.start(first, solver.at(time)), jnp.full(2, jnp.inf), jnp.zeros(())))


def _strong(state: PairState) -> PairState:
    """Copy of the state with strong types in place of JAX's weak types: the first state must have the types of the later ones, or JAX
    compiles a step twice."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), state)


def _turn(
    protocol: InteriorPoint,
    solver: OwnSolver,
    packing: Packing,
    state: PairState,
    heard: tuple[Array, Array, Array],
    moment: tuple[Array, Array, Array],
) -> tuple[PairState, Array, Array, Array]:
    (inbox, arrived, fresh), (round_, margin, time) = heard, moment
    solver = solver.at(time)
    interior = solver.interior
    assert interior is not None
    inner = protocol.hear(state.inner, packing.unpack(inbox, interior.plan.width), arrived, solver)
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


@functools.cache
def _compiled() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The compiled functions, which all agents of the same shape share."""
    options = quick_compilation()
    return (
        jax.jit(_begin, static_argnames=("protocol",), compiler_options=options),
        jax.jit(_turn, static_argnames=("protocol",), compiler_options=options),
    )

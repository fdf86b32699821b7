"""A protocol that speaks to each neighbour as a whole, `consat.protocols.interior_point`, on one agent.

What it knows of the team beyond the neighbours must outlive neither a lie nor a change of the team:

* A bound is the best of the last `FORGET` to twice as many turns.
* Whenever an agent's constraints change, because somebody has left or joined, it raises a count of changes, which travels with every
  message; all take over the largest. A proof counts only where it comes with the agent's own count, and begins anew when that rises. So
  every agent has one set of constraints for each count, and a bound is one on the margin of these.
* A proof speaks of a region around the team's middle that everybody has known since the beginning. An agent whose constraints ask for more
  than `FAR` reaches, because they were changed, tells no proof.
* The least margin behind a neighbour that has fallen silent is unknown.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import Core, Kept, Moment, Rows, Turned
from consat.network.node.pairs import Letter, Packing
from consat.network.node.part import Part
from consat.network.node.problem import Alone, ends
from consat.numerics import quick_compilation
from consat.problem.constraints.library import farthest
from consat.protocols import InteriorPoint, Known
from consat.protocols.interior_point import InteriorState

FORGET: Final = 300
"""Turns."""
FAR: Final = 3.0
"""The region of a proof is ten reaches wide: so an agent may follow its neighbours some way farther than its own constraints ask for."""


class PairState(NamedTuple):
    """What an agent remembers.

    Attributes:
        inner: of the protocol.
        bounds: (2,) the best of so many turns before, and since.
        turns: taken.
    """

    inner: InteriorState
    bounds: Array
    turns: Array


class PairCore:
    """The protocol on one agent; see the module.

    Args:
        protocol: the protocol.
        whole: the agent's own part.
        gone: who is not there.
    """

    def __init__(self, protocol: InteriorPoint, whole: Part, gone: Collection[str] = ()) -> None:
        self.protocol, self.whole = protocol, whole
        self.part = whole.without(gone)
        self.ends = ends(self.part)
        self.solver = Alone.of(self.part, protocol.speaks)
        self.width, self.largest = 0, np.zeros(0)
        self.letters = {neighbour.id: Letter.of(neighbour, whole.team.dimension).numbers() for neighbour in whole.neighbours}
        assert self.solver.interior is not None
        self.packing = Packing.of(whole, self.part, self.solver.interior.plan.width)
        self._weight = {neighbour.id: Letter.of(neighbour, whole.team.dimension).weight for neighbour in whole.neighbours}
        order = [neighbour for neighbour, _ in self.ends]
        self._end = np.array([order.index(neighbour.id) for neighbour in self.part.neighbours], dtype=int)
        self._begin, self._turn = _compiled()

    def begin(self, first: np.ndarray, time: float = 0.0) -> PairState:
        return self._begin(self.protocol, self.solver, first, time)

    def turn(self, state: PairState, inbox: Rows, arrived: Rows, moment: Moment) -> Turned:
        heard = inbox.pair, arrived.pair, moment.fresh[self._end]
        when = moment.round, moment.margin, moment.time
        state, said, bound, least = self._turn(self.protocol, self.solver, self.packing, state, heard, when)
        said = np.asarray(said)
        if asks_for(self.part) > FAR * self.part.reach:
            said, bound = self._without_proof(said), np.inf
        return Turned(state, Rows(inbox.link, said), np.asarray(state.inner.x), float(bound), float(least))

    def _without_proof(self, said: np.ndarray) -> np.ndarray:
        said = said.copy()
        for row, neighbour in zip(said, self.part.neighbours, strict=True):
            at = self._weight[neighbour.id]
            row[at:] = 0.0
            row[at] = -1.0
        return said

    def among(self, gone: Collection[str], whole: Part | None = None) -> PairCore:
        return PairCore(self.protocol, whole or self.whole, gone)

    def anew(self, state: PairState) -> PairState:
        """With a count of changes that is larger by one, and nothing proven."""
        memory: Any = state.inner.memory
        more: Any = {"changes": np.asarray(memory.changes) + 1.0, "bound": np.full(np.shape(memory.bound), np.inf)}  # nothing compiles
        forgotten: Any = np.full(2, np.inf)
        return state._replace(inner=state.inner._replace(memory=memory._replace(**more)), bounds=forgotten)

    def carry(self, other: Core, state: PairState, first: np.ndarray, time: float = 0.0) -> PairState:
        """Only the estimates live on, and the count of changes, which this is one of."""
        fresh = self.begin(np.asarray(Kept.of(self, other).merge("row", state.inner.x, first)), time)
        memory = fresh.inner.memory._replace(changes=state.inner.memory.changes + 1.0)
        return fresh._replace(inner=fresh.inner._replace(memory=memory))


@functools.lru_cache(maxsize=64)
def asks_for(part: Part) -> float:
    """How far from the team's middle an agent's own constraints ask anybody to be, length."""
    return max((farthest(family.psi, family.parameters, part.center) for family in part.team.families), default=0.0)


def _begin(protocol: InteriorPoint, solver: Alone, first: Array, time: Array) -> PairState:
    return _strong(PairState(protocol.start(first, solver.at(time)), jnp.full(2, jnp.inf), jnp.zeros(())))


def _strong(state: PairState) -> PairState:
    """The same with types of its own, not those of what it meets: the first state must have those of all later ones, or JAX compiles a
    turn twice."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), state)


def _turn(
    protocol: InteriorPoint,
    solver: Alone,
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
    """Compiled once for all agents of the same shape."""
    options = quick_compilation()
    return (
        jax.jit(_begin, static_argnames=("protocol",), compiler_options=options),
        jax.jit(_turn, static_argnames=("protocol",), compiler_options=options),
    )

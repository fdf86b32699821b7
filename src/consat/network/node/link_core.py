"""Gradient flow with its integral state on the links, for continuous control over a network. With agent i, neighbour j, and hats for values
as last received:

    z_i   = ½ Σ_j (λ_ij − λ̂_ji)
    ẋ_i   = −k1 ∇f_i(x_i) − k2 Σ_j (x_i − x̂_j) − z_i
    λ̇_ij  = κ_ij (x_i − x̂_j) while j was heard recently, else 0;    κ_ij = min(k1 k2, k2/(2 τ_ij)), τ_ij the delay
    on receipt:  λ_ij ← λ_ij − ε (λ_ij + λ̂_ji)

It is integrated by backward Euler with the measured time h since the last step,

    (1/h + k2 d_i + ½hΣκ) x⁺ + k1 ∇f_i(x⁺) = x/h + k2 Σ x̂_j − z_i + ½hΣκ x̂_j

which is a proximal step of f_i. On perfect links λ_ij = −λ_ji, and this is the paper's flow (`consat.protocols.gradient_flow`). At every
equilibrium x_i = x_j and Σ ∇f_i = 0, whatever the λ are, so that the flow recovers from losses and crashes. −λ_ji is a copy of λ_ij, which
an agent that has lost its state takes over from its neighbours.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import LARGEST, Core, IndexMap, Moment, Rows, StepResult, no_pair_numbers
from consat.network.node.part import Part
from consat.network.node.problem import OwnSolver, ends
from consat.numerics import quick_compilation
from consat.protocols.local.proximal import Memory

AGREE = 0.05
"""ε: fraction by which λ_ij moves towards −λ̂_ji at each message."""
SHORTEST = 1e-4
"""Smallest step h, s, for two steps at almost the same time."""


class LinkState(NamedTuple):
    """State of the agent.

    Attributes:
        x: (rows, d) estimates.
        force: (E, d) λ_ij.
        there: (E, d) x̂_j.
        theirs: (E, d) λ̂_ji.
        valid: (E,) whether `theirs` is valid: a neighbour that has lost its state has no λ_ji yet.
        adopted: (E,) whether `force` is valid.
        memory: warm start of the local solver.
    """

    x: Array
    force: Array
    there: Array
    theirs: Array
    valid: Array
    adopted: Array
    memory: Memory


_PER: Mapping[str, Any] = {
    "x": "row", "force": "link", "there": "link", "theirs": "link", "valid": "link", "adopted": "link", "memory": "agent",
}  # fmt: skip


class LinkCore:
    """`consat.network.node.core.Core` of the flow; see the module.

    Args:
        whole: the agent's part, with all agents.
        k1: gain on the gradient, 1/s.
        k2: gain on the disagreement, 1/s.
        gone: agents that are absent.
    """

    def __init__(self, whole: Part, k1: float, k2: float, gone: Collection[str] = ()) -> None:
        self.whole, self.k1, self.k2 = whole, k1, k2
        self.part = whole.without(gone)
        self.ends = ends(self.part)
        self.solver = OwnSolver.of(self.part)
        self.width = 2 * self.part.team.dimension + 1
        self.largest = np.full(self.width, LARGEST)
        self.pair_numbers = no_pair_numbers(whole)
        self._begin, self._turn = _compiled()

    def begin(self, first: np.ndarray, time: float = 0.0) -> LinkState:
        return self._begin(self.solver, first, time)

    def turn(self, state: LinkState, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        gains = jnp.asarray(self.k1), jnp.asarray(self.k2)
        state, outbox = self._turn(self.solver, gains, state, inbox.link, arrived.link, moment)
        return StepResult(state, Rows(np.asarray(outbox), inbox.pair), np.asarray(state.x))

    def without(self, gone: Collection[str], whole: Part | None = None) -> LinkCore:
        return LinkCore(whole or self.whole, self.k1, self.k2, gone)

    def without_proofs(self, state: LinkState) -> LinkState:
        """The state unchanged: it contains no proofs."""
        return state

    def carry(self, other: Core, state: LinkState, first: np.ndarray, time: float = 0.0) -> LinkState:
        """Initial state with the old values at the ends of links that remain."""
        return IndexMap.of(self, other).merge(_PER, state, self.begin(first, time))


def _begin(solver: OwnSolver, first: Array, time: Array) -> LinkState:
    solver = solver.at(time)
    there = solver.links.at(first)
    nothing = jnp.zeros(len(there))
    kappa = jnp.ones(len(first))
    return LinkState(
        first, jnp.zeros_like(there), there, jnp.zeros_like(there), nothing, nothing,
        solver.recall(first, kappa),
    )  # fmt: skip


def _turn(
    solver: OwnSolver, gains: tuple[Array, Array], state: LinkState, inbox: Array, arrived: Array, moment: Moment
) -> tuple[LinkState, Array]:
    solver = solver.at(moment.time)
    state = _hear(solver, state, inbox, arrived)
    k1, k2 = gains
    links = solver.links
    h = jnp.maximum(moment.elapsed, SHORTEST)
    kappa = jnp.where(moment.fresh, jnp.minimum(k1 * k2, k2 / (2.0 * jnp.maximum(moment.delay, SHORTEST))), 0.0)
    theirs = jnp.where(state.valid[:, None] > 0, state.theirs, -state.force)
    z = 0.5 * links.sum(state.force - theirs)
    spring = 0.5 * h * kappa
    stiff = 1.0 / h + k2 * links.degree + links.sum(spring)
    pull = state.x / h + links.sum((k2 + spring)[:, None] * state.there) - z
    x, memory, _ = solver.prox(pull / stiff[:, None], stiff / k1, state.x, state.memory)
    force = state.force + (h * kappa)[:, None] * (links.at(x) - state.there)
    state = state._replace(x=x, force=force, memory=memory)
    return state, jnp.concatenate([links.at(x), force, state.adopted[:, None]], axis=1)


def _hear(solver: OwnSolver, state: LinkState, inbox: Array, arrived: Array) -> LinkState:
    """Store the received messages. An agent without a valid λ adopts −λ̂ of the neighbour, and the neighbour's estimates of other positions.
    If neither has a valid λ, it stays 0."""
    d = state.x.shape[1]
    there, theirs, told = inbox[:, :d], inbox[:, d : 2 * d], inbox[:, 2 * d] > 0
    sure, mine = (arrived & told)[:, None], state.adopted[:, None] > 0
    force = jnp.where(sure & mine, state.force - AGREE * (state.force + theirs), state.force)
    force = jnp.where(sure & ~mine, -theirs, force)
    fresh = (arrived & told & (state.adopted <= 0)).astype(inbox.dtype)
    count = solver.links.sum(fresh)
    taken = solver.links.sum(fresh[:, None] * there) / jnp.maximum(count, 1.0)[:, None]
    others = jnp.arange(len(state.x)) != solver.me
    return state._replace(
        x=jnp.where(((count > 0) & others)[:, None], taken, state.x),
        force=force,
        there=jnp.where(arrived[:, None], there, state.there),
        theirs=jnp.where(sure, theirs, state.theirs),
        valid=jnp.where(arrived, told.astype(inbox.dtype), state.valid),
        adopted=jnp.where(arrived, 1.0, state.adopted),
    )


@functools.cache
def _compiled() -> tuple[Callable[..., Any], Callable[..., Any]]:
    options = quick_compilation()
    return jax.jit(_begin, compiler_options=options), jax.jit(_turn, compiler_options=options)

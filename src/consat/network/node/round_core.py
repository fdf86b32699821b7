"""Core of one agent for a protocol that sends one message per end of a link, with the counters of `consat.protocols.agreement`."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import LARGEST, Core, IndexMap, Moment, Rows, StepResult, without_silent
from consat.network.node.part import Part
from consat.network.node.problem import OwnSolver
from consat.numerics import quickly_compiled
from consat.protocols import Known, Rounds, agreement
from consat.protocols.local.proximal import Memory

PENALTY: Final = 1e80
"""Largest penalty ρ in a message of ADMM, in the team's unit of length, because forces are rescaled by changes of ρ. A ρ that is not
positive makes the state NaN, which `consat.network.node.guard` prevents."""


class RoundState(NamedTuple):
    """State of the agent: that of the protocol, and the counters."""

    inner: Any
    ages: agreement.Ages


class RoundCore(Core):
    """See the module. A row for an end of a link is the message of the protocol, and last the counter."""

    def __init__(self, protocol: Rounds, whole: Part, gone: Collection[str] = ()) -> None:
        super().__init__(protocol, whole, gone)
        self.packing = packing = Packing.of(protocol, self.solver, self.part.team.dimension)
        self.width = sum(packing.sizes) + 1
        # In admm a scalar is ρ. In other protocols it may be a margin, which is infinite for an agent without constraints.
        scalar = PENALTY / whole.length**2 if protocol.name == "admm" else np.inf
        largest = [LARGEST if shape else scalar for shape in packing.shapes]
        self.largest = np.append(np.repeat(largest, packing.sizes), LARGEST)

    def begin(self, first: np.ndarray, time: float = 0.0) -> RoundState:
        return _begin(self.protocol, self.solver, first, time)

    def turn(self, state: RoundState, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        heard = inbox.link, arrived.link, moment.fresh
        state, outbox = _turn(self.protocol, self.packing, self.solver, state, heard, (moment.round, moment.margin, moment.time))
        return StepResult(state, Rows(np.asarray(outbox), inbox.pair), np.asarray(state.inner.x))

    def carry(self, other: Core, state: RoundState, first: np.ndarray, time: float = 0.0) -> RoundState:
        """Initial state with the old estimates. The rest of the state belongs to the old problem."""
        return self.begin(np.asarray(IndexMap.of(self, other).rows(state.inner.x, first)), time)


class _Outline:
    """Solver whose results have the right shapes but arbitrary values. It is fast to trace, to find the shape of a message."""

    def __init__(self, solver: OwnSolver) -> None:
        self.links, self.length, self.hops, self.convex = solver.links, solver.length, solver.hops, solver.convex
        self.to_rows, self.least, self.interior = solver.to_rows, solver.least, solver.interior

    def nearby(self, x: Array) -> Array:
        return x

    def recall(self, x: Array, kappa: Array) -> Memory:
        return Memory(jnp.zeros(1), jnp.ones(1))

    def prox(self, v: Array, kappa: Array, x: Array, memory: Memory) -> tuple[Array, Memory, Array]:
        return v, memory, kappa

    def gradient(self, x: Array) -> Array:
        return x

    def margin(self, x: Array) -> Array:
        return jnp.zeros(1)


@jax.tree_util.register_static
@dataclass(frozen=True)
class Packing:
    """Between the messages of a protocol and their rows.

    Attributes:
        structure: structure of a message.
        shapes: for each of its arrays the shape for one end of a link.
    """

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, protocol: Rounds, solver: OwnSolver, dimension: int) -> Packing:
        """Find the shapes by tracing, without computing."""
        first, outline = jax.ShapeDtypeStruct((len(solver.holder), dimension), float), _Outline(solver)

        def message(x: Array) -> Any:
            return protocol.speak(protocol.start(x, outline), outline, jnp.asarray(0.0), Known(jnp.zeros(1), jnp.zeros(1)))[1]

        leaves, structure = jax.tree.flatten(jax.eval_shape(message, first))
        return cls(structure, tuple(leaf.shape[1:] for leaf in leaves))

    @property
    def sizes(self) -> list[int]:
        return [math.prod(shape) for shape in self.shapes]

    def pack(self, message: Any) -> Array:
        """(E, Σ sizes) the rows of a message."""
        leaves = jax.tree.leaves(message)
        return jnp.concatenate([leaf.reshape(len(leaf), size) for leaf, size in zip(leaves, self.sizes, strict=True)], axis=1)

    def unpack(self, rows: Array) -> Any:
        """The message from its rows."""
        columns = jnp.split(rows, np.cumsum(self.sizes)[:-1], axis=1)
        leaves = [column.reshape(len(rows), *shape) for column, shape in zip(columns, self.shapes, strict=True)]
        return jax.tree.unflatten(self.structure, leaves)


@quickly_compiled("protocol")
def _begin(protocol: Rounds, solver: OwnSolver, first: Any, time: Any) -> RoundState:
    solver = solver.at(time)
    return RoundState(protocol.start(first, solver), agreement.start(first, solver))


@quickly_compiled("protocol")
def _turn(
    protocol: Rounds, packing: Packing, solver: OwnSolver, now: RoundState, heard: tuple[Any, Any, Any], moment: tuple[Any, Any, Any]
) -> tuple[RoundState, Array]:
    inbox, arrived, fresh = heard
    round_, margin, time = moment
    solver = solver.at(time)
    state = protocol.hear(now.inner, packing.unpack(inbox[:, :-1]), arrived, solver)
    ages = without_silent(agreement.hear(now.ages, inbox[:, -1], arrived), fresh)
    state, message = protocol.speak(state, solver, round_, Known(agreement.known(ages, solver), jnp.asarray(margin)[None]))
    ages, count = agreement.speak(ages, state.x, solver)
    return RoundState(state, ages), jnp.concatenate([packing.pack(message), count[:, None]], axis=1)

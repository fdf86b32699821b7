"""A core together with the agent's body: the exchange of body positions, and the agreement that all are satisfied at these positions."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import LARGEST, Core, IndexMap, Moment, Rows, without_silent
from consat.network.node.part import Part
from consat.network.node.problem import OwnSolver
from consat.numerics import quickly_compiled
from consat.protocols import agreement
from consat.protocols.interior_point import near


class AgentView(NamedTuple):
    """What an agent knows after a step.

    Attributes:
        x: (rows, d) its estimates.
        bodies: (rows, d) last known positions of the bodies.
        heard: whether it has received the positions of all these bodies.
        known: number of steps for which it has known that all agents are satisfied at the positions of their bodies.
        bound: see `consat.network.node.core.StepResult`.
        least: see `consat.network.node.core.StepResult`.
        near: whether `least` is proven to be near the best margin.
    """

    x: np.ndarray
    bodies: np.ndarray
    heard: bool
    known: float
    bound: float
    least: float
    near: bool


class EmbodiedState(NamedTuple):
    """State of an agent.

    Attributes:
        core: state of its core.
        bodies: see `consat.protocols.agreement`.
    """

    core: Any
    bodies: agreement.Bodies


class Embodied:
    """A core that also exchanges positions of bodies. It appends d + 2 entries to each row of a link: the position, the number of steps
    since it was measured, and the number of rounds for which all are satisfied.

    Args:
        core: the core of the protocol.
    """

    def __init__(self, core: Core) -> None:
        self.core, self.part, self.ends, self.pair_numbers = core, core.part, core.ends, core.pair_numbers
        added = self.part.team.dimension + 2
        self.width = core.width + added
        self.largest = np.append(core.largest, np.full(added, LARGEST))
        self.ages = (*([core.width - 1] if core.width else []), self.width - 1)
        """Columns of the rows of links that count rounds."""
        direct = np.array([neighbour == agent for neighbour, agent in self.ends], dtype=bool)
        row = np.asarray(core.solver.links.row)
        self._owners = agreement.Owners.of(np.array([self.part.own]), row, direct, self.part.team.count)

    def begin(self, first: np.ndarray, time: float = 0.0) -> EmbodiedState:
        """See `Core.begin`."""
        return EmbodiedState(self.core.begin(first, time), _start(self.core.solver, first))

    def turn(self, state: EmbodiedState, inbox: Rows, arrived: Rows, moment: Moment) -> tuple[EmbodiedState, Rows, AgentView]:
        """See `Core.turn`. Returns the next state, the messages to send, and what the agent then knows."""
        width = self.core.width
        words = inbox.link[:, width:], arrived.link, moment.fresh
        bodies, said, sight = _agree(self.core.solver, self._owners, state.bodies, words, moment.body, moment.time)
        heard, known, margin = (np.asarray(each)[0] for each in sight)
        inner = self.core.turn(state.core, inbox._replace(link=inbox.link[:, :width]), arrived, moment._replace(margin=float(margin)))
        proven = near(inner.bound, inner.least, self.part.psi)
        view = AgentView(inner.x, np.asarray(bodies.position), bool(heard), float(known), inner.bound, inner.least, proven)
        link = np.concatenate([inner.outbox.link, np.asarray(said)], axis=1)
        return EmbodiedState(inner.state, bodies), Rows(link, inner.outbox.pair), view

    def empty(self) -> tuple[Rows, Rows]:
        """An inbox and its masks of arrival, without messages."""
        neighbours = self.part.neighbours
        longest = max((self.pair_numbers[neighbour.id].shape[0] for neighbour in neighbours), default=0)
        inbox = Rows(np.zeros((len(self.ends), self.width)), np.zeros((len(neighbours), longest)))
        return inbox, Rows(*(np.zeros(len(rows), dtype=bool) for rows in inbox))

    def margin(self, positions: np.ndarray, time: float = 0.0) -> float:
        """ᾱ_i at the positions, (rows, d), of the agents of the part; +∞ without constraints. `time`: see `Moment.time`."""
        return float(np.asarray(_margin(self.core.solver, positions, time))[0])

    def without(self, gone: Collection[str], whole: Part | None = None) -> Embodied:
        """See `Core.without`."""
        return Embodied(self.core.without(gone, whole))

    def adjusted(self, whole: Part) -> Embodied:
        """See `Core.adjusted`."""
        return Embodied(self.core.adjusted(whole))

    def without_proofs(self, state: EmbodiedState) -> EmbodiedState:
        """See `Core.without_proofs`."""
        return state._replace(core=self.core.without_proofs(state.core))

    def carry(self, other: Embodied, state: EmbodiedState, first: np.ndarray, time: float = 0.0) -> EmbodiedState:
        """See `Core.carry`. Positions of bodies are kept; the counters of satisfied rounds restart."""
        fresh, before, index = _start(self.core.solver, first), state.bodies, IndexMap.of(self.core, other.core)
        kept = fresh._replace(position=index.rows(before.position, fresh.position), stale=index.rows(before.stale, fresh.stale))
        return EmbodiedState(self.core.carry(other.core, state.core, first, time), kept)


def word_of(columns: Array) -> agreement.Word:
    """The message about bodies from its columns, (E, d + 2)."""
    return agreement.Word(columns[:, :-2], columns[:, -2], columns[:, -1])


def columns_of(word: agreement.Word) -> Array:
    """(E, d + 2) the columns of a message about bodies."""
    return jnp.concatenate([word.position, word.stale[:, None], word.age[:, None]], axis=1)


@quickly_compiled()
def _start(solver: OwnSolver, first: Any) -> agreement.Bodies:
    return agreement.start_bodies(first, solver)


@quickly_compiled()
def _agree(
    solver: OwnSolver, owners: agreement.Owners, bodies: agreement.Bodies, heard: tuple[Any, Any, Any], body: Any, time: Any
) -> tuple[agreement.Bodies, Array, tuple[Array, Array, Array]]:
    solver = solver.at(time)
    inbox, arrived, fresh = heard
    bodies = agreement.hear_bodies(bodies, word_of(inbox), arrived, owners, solver)
    bodies, word = agreement.speak_bodies(bodies._replace(ages=without_silent(bodies.ages, fresh)), body[None], owners, solver)
    all_heard = agreement.all_heard(bodies, solver)
    margin = jnp.where(all_heard & jnp.isfinite(body).all(), solver.margin(bodies.position), -jnp.inf)
    return bodies, columns_of(word), (all_heard, agreement.known(bodies.ages, solver), margin)


@quickly_compiled()
def _margin(solver: OwnSolver, positions: Any, time: Any) -> Array:
    return solver.at(time).margin(positions)

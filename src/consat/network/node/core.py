"""The interface of a protocol on one agent, independent of transport and timing.

A core takes the messages received since its last step, and returns its next state and the messages to send: one row of numbers for each end
of a link, and one for each neighbour. The cores are `round_core`, `pair_core` and `link_core`; `embodied` adds the body to any of them.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Final, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.part import Part
from consat.network.node.problem import OwnSolver, ends, live_of
from consat.network.wire import Numbers
from consat.protocols import agreement

LARGEST: Final = 1e100
"""Largest magnitude of a number in a message, except margins. It is that of a number in a scenario; its square is finite."""


class Moment(NamedTuple):
    """Inputs of a step besides messages.

    Attributes:
        round: number of the step, from 0.
        elapsed: time since the last step, s.
        delay: (E,) time that messages take over each end of a link, s.
        fresh: (E,) whether the neighbour at the other end was heard recently.
        body: (d,) position of the agent's body; NaN if unknown.
        margin: ᾱ_i at this position and the last received positions of the other bodies; −∞ if unknown.
        time: time for schedules, by the clock that the team shares, s since t = 0.
    """

    round: float
    elapsed: float
    delay: np.ndarray
    fresh: np.ndarray
    body: np.ndarray
    margin: float = -np.inf
    time: float = 0.0


class Rows(NamedTuple):
    """Messages that an agent sends or receives in a step.

    Attributes:
        link: (E, width) one row for each end of a link.
        pair: (G, W) one row for each neighbour that is present, in the order of the part, padded to the longest.
    """

    link: Any
    pair: Any


class StepResult(NamedTuple):
    """Result of a step of a protocol.

    Attributes:
        state: the next state.
        outbox: messages to send.
        x: (rows, d) estimates.
        bound: proven upper bound on the best margin of the team; +∞ without proof.
        least: smallest margin of the team at the positions of the bodies, as received; −∞ until all have been received.
    """

    state: Any
    outbox: Rows
    x: np.ndarray
    bound: float = np.inf
    least: float = -np.inf


class Core(ABC):
    """A protocol on one agent.

    Args:
        protocol: the protocol, with its gains.
        whole: the agent's part, with all agents.
        gone: agents that are absent.

    Attributes:
        part: the part without absent agents.
        ends: (neighbour, agent) for each end of a link; see `consat.network.node.problem.ends`.
        solver: solver of the part.
        width: number of entries of a row for an end of a link.
        largest: (width,) largest allowed magnitude of each entry.
        pair_numbers: format of the row for each neighbour, whether or not it is present.
    """

    width: int
    largest: np.ndarray

    def __init__(self, protocol: Any, whole: Part, gone: Collection[str] = ()) -> None:
        self.protocol, self.whole = protocol, whole
        self.part = whole.without(gone)
        self.ends = ends(self.part)
        self.solver = OwnSolver.of(self.part, getattr(protocol, "speaks", "link"))
        self.pair_numbers = {neighbour.id: Numbers((0,)) for neighbour in whole.neighbours}

    @abstractmethod
    def begin(self, first: np.ndarray, time: float = 0.0) -> Any:
        """Initial state, from initial estimates `first`, (rows, d). `time`: see `Moment.time`."""

    @abstractmethod
    def turn(self, state: Any, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        """Compute a step. `arrived`: masks, (E,) and (G,), of the rows of `inbox` that were received."""

    @abstractmethod
    def carry(self, other: Core, state: Any, first: np.ndarray, time: float = 0.0) -> Any:
        """The state of this core that continues `state` of the core `other`. New rows start from `first`, (rows, d)."""

    def without_proofs(self, state: Any) -> Any:
        """The state without proofs, which become invalid when constraints change. Most protocols have none."""
        return state

    def without(self, gone: Collection[str], whole: Part | None = None) -> Self:
        """The core without the agents `gone`, for the part `whole` if it is given."""
        return type(self)(self.protocol, whole or self.whole, gone)

    def adjusted(self, whole: Part) -> Self:
        """Copy with other constraint parameters. Nothing is compiled. `whole`: a part that differs only in these parameters."""
        core = copy.copy(self)
        core.whole, core.part = whole, whole.without(set(whole.team.ids) - set(self.part.team.ids))
        core.solver = replace(self.solver, live=live_of(core.part))
        return core


class IndexMap(NamedTuple):
    """For each row and each end of a core the index in another core; −1 for new ones."""

    row: np.ndarray
    link: np.ndarray

    @classmethod
    def of(cls, new: Core, old: Core) -> IndexMap:
        rows = {agent: k for k, agent in enumerate(old.part.team.ids)}
        links = {end: k for k, end in enumerate(old.ends)}
        return cls(
            np.array([rows.get(agent, -1) for agent in new.part.team.ids], dtype=int),
            np.array([links.get(end, -1) for end in new.ends], dtype=int),
        )

    def rows(self, old: Any, fresh: Any) -> Any:
        """(rows, …) the values `old` of the rows that remain, and `fresh` of new ones."""
        return _taken(self.row, old, fresh)

    def links(self, old: Any, fresh: Any) -> Any:
        """(E, …) likewise, for ends of links."""
        return _taken(self.link, old, fresh)


def _taken(index: np.ndarray, old: Array, fresh: Array) -> Array:
    if not len(old) or not len(index):
        return fresh
    kept = (index >= 0).reshape(-1, *[1] * (np.ndim(fresh) - 1))
    return jnp.where(kept, jnp.asarray(old)[np.maximum(index, 0)], fresh)


def without_silent(ages: agreement.Ages, fresh: Array | np.ndarray) -> agreement.Ages:
    """The counters, with those of neighbours that are silent set to 0. `fresh`: (E,) see `Moment`."""
    return ages._replace(heard=jnp.where(fresh, ages.heard, 0.0))

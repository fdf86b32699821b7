"""What a protocol is: functions of ONE agent's own state, own objective and disagreement with its neighbours' messages.

Every array has one row a copy the agent holds. `consat.simulate` passes the rows of all agents at once, a networked agent only its own:
the functions cannot tell, because nothing in their arguments speaks of another agent's constraints.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from jax import Array


class State(NamedTuple):
    """What an agent remembers.

    Attributes:
        x: (rows, d) its estimates of the positions it holds, its own among them.
        z: (rows, d) the integral of its disagreement.
    """

    x: Array
    z: Array


class Local(Protocol):
    """What an agent can ask of itself."""

    @property
    def own(self) -> Array:
        """(rows, 1) 1.0 on the row of its own position, 0.0 on the copies of others'."""
        ...

    def gradient(self, x: Array) -> Array:
        """∇f_i at its estimates; (rows, d)."""
        ...

    def ascent(self, x: Array) -> Array:
        """∇α_i at its estimates; (rows, d)."""
        ...


class Flow(Protocol):
    """A protocol in continuous time."""

    @property
    def name(self) -> str:
        """What ``--protocol`` calls it."""
        ...

    def start(self, x: Array) -> State:
        """The state with which an agent begins from first estimates x."""
        ...

    def message(self, state: State) -> Any:
        """What the agent sends to its neighbours: (rows, d) arrays, of which each gets the rows that both hold."""
        ...

    def rate(self, state: State, local: Local, disagreement: Any) -> State:
        """d/dt of the state.

        Args:
            state: own.
            local: own constraints.
            disagreement: Σ_j (m_i − m_j) over the neighbours, for every array of the message.
        """
        ...

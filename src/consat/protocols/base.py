"""Interfaces of a protocol: functions of ONE agent's own state, its own objective and the messages of its neighbours.

Every array has one row for each copy that the agent holds. `consat.engine` passes the rows of all agents at once; a networked agent passes
only its own rows. The functions are the same in both cases, because no argument contains another agent's constraints.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from jax import Array

from consat.protocols.local.interior import Interior
from consat.protocols.local.proximal import Memory


class State(NamedTuple):
    """State of an agent in continuous time.

    Attributes:
        x: (rows, d) its estimates of the positions of which it holds copies, its own position included.
        z: (rows, d) the integral of its disagreement.
    """

    x: Array
    z: Array


class Local(Protocol):
    """Local objective of an agent, as a continuous-time protocol sees it."""

    @property
    def own(self) -> Array:
        """(rows, 1) 1.0 on the row of its own position, 0.0 on the copies of other agents' positions."""
        ...

    def gradient(self, x: Array) -> Array:
        """(rows, d) ∇f_i at the estimates `x`, (rows, d)."""
        ...

    def ascent(self, x: Array) -> Array:
        """(rows, d) ∇α_i at the estimates `x`, (rows, d)."""
        ...


class Flow(Protocol):
    """A continuous-time protocol."""

    @property
    def name(self) -> str:
        """Name of the protocol in ``--protocol``."""
        ...

    def start(self, x: Array) -> State:
        """Initial state for the initial estimates `x`, (rows, d)."""
        ...

    def message(self, state: State) -> Any:
        """Message to the neighbours: arrays of shape (rows, d). Each neighbour receives the rows of the positions that it also holds."""
        ...

    def rate(self, state: State, local: Local, disagreement: Any) -> State:
        """Time derivative of the state.

        Args:
            state: state of the agent.
            local: local objective of the agent.
            disagreement: Σ_j (m_i − m_j) over the neighbours j, for every array m of the message; (rows, d).
        """
        ...


class Known(NamedTuple):
    """Knowledge of each agent about the bodies; arrays of shape (N,).

    Attributes:
        satisfied: number of rounds for which it has known that all agents are satisfied; see `consat.protocols.agreement`.
        margin: ᾱ_i at the measured position of its own body and the last received positions of the others.
    """

    satisfied: Array
    margin: Array


class Links(Protocol):
    """The ends of links at an agent: one for each copy that it shares with a neighbour."""

    @property
    def degree(self) -> Array:
        """(rows,) number of links that share each copy."""
        ...

    @property
    def metropolis(self) -> Array:
        """(links,) Metropolis weight 1/(1 + max(degree of both ends)). Neighbours exchange their degrees to compute it."""
        ...

    def at(self, rows: Array) -> Array:
        """(rows, …) → (links, …): the value of each link's copy."""
        ...

    def sum(self, links: Array) -> Array:
        """(links, …) → (rows, …): the sum over the links of each copy."""
        ...

    def least(self, links: Array) -> Array:
        """(links, …) → (rows, …): the smallest over the links of each copy, +∞ without links."""
        ...


class Solver(Protocol):
    """Local computations that a protocol in rounds may use. Common knowledge is the same for every agent of the team."""

    @property
    def links(self) -> Links:
        """The ends of links at the agent."""
        ...

    @property
    def length(self) -> Array:
        """() the team's unit of length, from the scale of the scenario; common knowledge."""
        ...

    @property
    def hops(self) -> int:
        """Largest number of links between two agents of a cluster; common knowledge."""
        ...

    @property
    def convex(self) -> bool:
        """Whether every constraint of the team is known to be concave; common knowledge."""
        ...

    @property
    def interior(self) -> Interior | None:
        """Local step of `consat.protocols.interior_point`; None unless the protocol sends one message per pair."""
        ...

    def nearby(self, x: Array) -> Array:
        """(rows, d) the positions `x`, moved into the team's region, which is common knowledge. Positions inside stay unchanged. Positions
        far away are moved to the rim and keep their directions. Rows without links and constraints stay unchanged."""
        ...

    def recall(self, x: Array, kappa: Array) -> Memory:
        """Initial warm start of the local solver for the first step from `x`, (rows, d), with weights κ, (rows,)."""
        ...

    def prox(self, v: Array, kappa: Array, x: Array, memory: Memory) -> tuple[Array, Memory, Array]:
        """Proximal step argmin_y f_i(y) + Σ_r κ_r/2 ‖y_r − v_r‖².

        Args:
            v: (rows, d) centre of the quadratic term.
            kappa: (rows,) weights κ.
            x: (rows, d) where the solver starts.
            memory: warm start from the last step.

        Returns:
            (rows, d) the solution, the new warm start, and (rows,) the mean diagonal of ∇²f_i; NaN in rows that no constraint reads.
        """
        ...

    def gradient(self, x: Array) -> Array:
        """(rows, d) ∇f_i at the estimates `x`, (rows, d). Where ln f_i exceeds 600, f_i counts as e^600, so that it stays finite."""
        ...

    def margin(self, x: Array) -> Array:
        """(N,) ᾱ_i at the estimates `x`, (rows, d); +∞ without constraints."""
        ...

    def to_rows(self, numbers: Array) -> Array:
        """(N,) → (rows,): the value of the agent that holds each row."""
        ...

    def least(self, numbers: Array) -> Array:
        """(links,) → (N,): the smallest over all links of each agent; +∞ without links."""
        ...


class Rounds(Protocol):
    """A protocol in rounds. In each round every agent sends once (`speak`), then receives (`hear`)."""

    @property
    def per(self) -> Mapping[str, Any]:
        """Leading axis of each field of the state: ``row``, ``link``, ``agent``, ``pair`` of neighbours, or ``constraint``."""
        ...

    @property
    def speaks(self) -> str:
        """Leading axis of a message: ``link``, one row for each copy that two neighbours share, or ``pair``, one row for each neighbour."""
        ...

    @property
    def name(self) -> str:
        """Name of the protocol in ``--protocol``."""
        ...

    def earliest(self, solver: Solver) -> int:
        """First round from which a small step may count as convergence."""
        ...

    def start(self, x: Array, solver: Solver) -> Any:
        """Initial state for the initial estimates `x`, (rows, d). The field ``x`` of a state always holds the estimates."""
        ...

    def speak(self, state: Any, solver: Solver, round_: Array, known: Known) -> tuple[Any, Any]:
        """Advance the state by one round. Returns the state and the message, whose leading axis is named by `speaks`.

        Args:
            state: state of the agent.
            solver: local computations of the agent.
            round_: number of the round, from 0.
            known: what the agent knows about the bodies.
        """
        ...

    def news(self, said: Any, held: Any, solver: Solver) -> Array:
        """Whether a message differs from the last one sent by more than a tolerance, so that it must be sent; leading axis as in `speaks`.

        Args:
            said: the present messages.
            held: the messages sent last, which the neighbours hold.
            solver: local computations of the agent.
        """
        ...

    def brief(self, message: Any) -> Any:
        """The message with floats rounded to 32 bits where the protocol tolerates it, to send fewer bytes."""
        ...

    def hear(self, state: Any, message: Any, arrived: Array, solver: Solver) -> Any:
        """Update the state with the received messages.

        Args:
            state: state of the agent.
            message: the messages of the other ends.
            arrived: (links,) whether each message arrived; where it did not, the entries of `message` are meaningless.
            solver: local computations of the agent.
        """
        ...

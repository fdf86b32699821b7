"""What a protocol is: functions of ONE agent's own state, own objective and disagreement with its neighbours' messages.

Every array has one row a copy the agent holds. `consat.engine` passes the rows of all agents at once, a networked agent only its own:
the functions cannot tell, because nothing in their arguments speaks of another agent's constraints.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from jax import Array

from consat.protocols.local.interior import Interior
from consat.protocols.local.proximal import Memory


class State(NamedTuple):
    """What an agent remembers in continuous time.

    Attributes:
        x: (rows, d) its estimates of the positions it holds, its own among them.
        z: (rows, d) the integral of its disagreement.
    """

    x: Array
    z: Array


class Local(Protocol):
    """What an agent can ask of itself in continuous time."""

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


class Known(NamedTuple):
    """What an agent knows of the bodies; one number an agent.

    Attributes:
        satisfied: for how many rounds it has known that all are satisfied; see `consat.protocols.agreement`.
        margin: ᾱ_i where its own body is and where it last heard that the others are.
    """

    satisfied: Array
    margin: Array


class Links(Protocol):
    """An agent's own ends of its links: one for each copy that it shares with a neighbour."""

    @property
    def degree(self) -> Array:
        """(rows,) how many links share each copy."""
        ...

    @property
    def metropolis(self) -> Array:
        """(links,) weight of each link, 1/(1 + the larger degree of its two ends), for which neighbours tell each other their degrees."""
        ...

    def at(self, rows: Array) -> Array:
        """(rows, …) → (links, …): to each link the value of its copy."""
        ...

    def sum(self, links: Array) -> Array:
        """(links, …) → (rows, …): the sum over the links of each copy."""
        ...

    def least(self, links: Array) -> Array:
        """(links, …) → (rows, …): the smallest over the links of each copy, +∞ without links."""
        ...


class Solver(Protocol):
    """What an agent can ask of itself in rounds."""

    @property
    def links(self) -> Links:
        """Its ends of its links."""
        ...

    @property
    def length(self) -> Array:
        """The team's unit of length, common knowledge: the scenario's scale."""
        ...

    @property
    def hops(self) -> int:
        """Links that a message crosses, at most, from one agent of a cluster to another; common knowledge."""
        ...

    @property
    def convex(self) -> bool:
        """Whether every constraint of the team is known to be concave; common knowledge."""
        ...

    @property
    def interior(self) -> Interior | None:
        """Its part in `consat.protocols.interior_point`; None unless the protocol speaks to pairs."""
        ...

    def nearby(self, x: Array) -> Array:
        """(rows, d) positions, brought to where the team's places are, which is common knowledge: unchanged inside, and from far away to
        their rim, keeping their directions. Rows that nothing ties to anything stay."""
        ...

    def recall(self, x: Array, kappa: Array) -> Memory:
        """What its solver remembers before the first step from x, (rows, d), at weights κ, (rows,)."""
        ...

    def prox(self, v: Array, kappa: Array, x: Array, memory: Memory) -> tuple[Array, Memory, Array]:
        """argmin_y f_i(y) + Σ_r κ_r/2 ‖y_r − v_r‖².

        Returns:
            (rows, d) the solution, the solver's memory, and (rows,) the mean diagonal of ∇²f_i, NaN where no constraint reads a row.
        """
        ...

    def margin(self, x: Array) -> Array:
        """ᾱ_i at its estimates, one number an agent; +∞ without constraints."""
        ...

    def to_rows(self, numbers: Array) -> Array:
        """One number an agent → (rows,)."""
        ...

    def least(self, numbers: Array) -> Array:
        """(links,) → the smallest over all of an agent's links, one number an agent; +∞ without links."""
        ...


class Rounds(Protocol):
    """A protocol in rounds. In each, an agent speaks once, then hears what arrives."""

    @property
    def per(self) -> Mapping[str, Any]:
        """For each field of the state, what it has one of: ``row``, ``link``, ``agent``, ``pair`` of neighbours, or ``constraint``."""
        ...

    @property
    def speaks(self) -> str:
        """What a message has one row of: ``link``, for each copy that two neighbours share, or ``pair``, for each neighbour."""
        ...

    @property
    def name(self) -> str:
        """What ``--protocol`` calls it."""
        ...

    def earliest(self, solver: Solver) -> int:
        """The round before which to stand still means nothing."""
        ...

    def start(self, x: Array, solver: Solver) -> Any:
        """The state with which an agent begins from first estimates x; its field ``x`` holds its estimates from then on."""
        ...

    def speak(self, state: Any, solver: Solver, round_: Array, known: Known) -> tuple[Any, Any]:
        """Its step, and its message: arrays with one row of what `speaks` says.

        Args:
            state: own.
            solver: own.
            round_: which round it is, from 0.
            known: of the bodies.
        """
        ...

    def news(self, said: Any, held: Any, solver: Solver) -> Array:
        """Whether what would be said differs from what a neighbour holds by more than it can do without; one row of what `speaks` says.

        Args:
            said: what would be.
            held: what was sent last.
            solver: own.
        """
        ...

    def brief(self, message: Any) -> Any:
        """The message as it is sent where few bytes count: numbers that may be are rounded to 32 bits."""
        ...

    def hear(self, state: Any, message: Any, arrived: Array, solver: Solver) -> Any:
        """Take in what came.

        Args:
            state: own.
            message: as the other ends sent it.
            arrived: (links,) whether it did; where not, the message holds nothing of use.
            solver: own.
        """
        ...

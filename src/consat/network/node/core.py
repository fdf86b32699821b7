"""The protocol compiled for one agent, independent of transport and timing.

A core takes the messages received since its last step, and returns its next state and the messages to send: one row of numbers for each end
of a link, and one for each neighbour. `Embodied` adds to any core the exchange of body positions, and the agreement that all are satisfied.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.part import Part
from consat.network.node.problem import OwnSolver, ends, live_of
from consat.network.wire import Numbers
from consat.numerics import quick_compilation
from consat.protocols import Known, Rounds, agreement
from consat.protocols.interior_point import near
from consat.protocols.local.proximal import Memory

LARGEST: Final = 1e100
"""Largest magnitude of a number in a message, except margins. It is that of a number in a scenario; its square is finite."""
PENALTY: Final = 1e80
"""Largest penalty ρ in a message of ADMM, in the team's unit of length, because forces are rescaled by changes of ρ. A ρ that is not
positive makes the state NaN, which `consat.network.node.guard` prevents."""


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


class AgentView(NamedTuple):
    """What an agent knows after a step.

    Attributes:
        x: (rows, d) its estimates.
        bodies: (rows, d) last known positions of the bodies.
        heard: whether it has received the positions of all these bodies.
        known: number of steps for which it has known that all agents are satisfied at the positions of their bodies.
        bound: proven upper bound on the best margin of the team; +∞ without proof.
        least: smallest margin of the team at the positions of the bodies, as received; −∞ until all have been received.
        near: whether `least` is proven to be near the best margin.
    """

    x: np.ndarray
    bodies: np.ndarray
    heard: bool
    known: float
    bound: float = np.inf
    least: float = -np.inf
    near: bool = False


class Rows(NamedTuple):
    """Messages that an agent sends or receives in a step.

    Attributes:
        link: (E, width) one row for each end of a link.
        pair: (G, W) one row for each neighbour that is present, in the order of the part, padded to the longest.
    """

    link: np.ndarray
    pair: np.ndarray


class StepResult(NamedTuple):
    """Result of a step of a protocol.

    Attributes:
        state: the next state.
        outbox: messages to send.
        x: (rows, d) estimates.
        bound: see `AgentView`.
        least: see `AgentView`.
    """

    state: Any
    outbox: Rows
    x: np.ndarray
    bound: float = np.inf
    least: float = -np.inf


class Core(Protocol):
    """A protocol on one agent."""

    @property
    def part(self) -> Part:
        """The agent's part, without absent agents."""
        ...

    @property
    def ends(self) -> Sequence[tuple[str, str]]:
        """(neighbour, agent) for each end of a link; see `consat.network.node.problem.ends`."""
        ...

    @property
    def width(self) -> int:
        """Number of entries of a row for an end of a link."""
        ...

    @property
    def largest(self) -> np.ndarray:
        """(width,) largest allowed magnitude of each entry."""
        ...

    @property
    def pair_numbers(self) -> Mapping[str, Numbers]:
        """Format of the row for each neighbour, whether or not it is present."""
        ...

    @property
    def solver(self) -> OwnSolver:
        """Solver of the part."""
        ...

    def begin(self, first: np.ndarray, time: float = 0.0) -> Any:
        """Initial state, from initial estimates `first`, (rows, d). `time`: see `Moment.time`."""
        ...

    def turn(self, state: Any, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        """Compute a step. `arrived`: masks, (E,) and (G,), of the rows of `inbox` that were received."""
        ...

    def without(self, gone: Collection[str], whole: Part | None = None) -> Core:
        """The core without the agents `gone`, for the part `whole` if it is given."""
        ...

    def carry(self, other: Core, state: Any, first: np.ndarray, time: float = 0.0) -> Any:
        """The state of this core that continues `state` of the core `other`. New rows start from `first`, (rows, d)."""
        ...

    def without_proofs(self, state: Any) -> Any:
        """The state without proofs, which become invalid when constraints change."""
        ...


class IndexMap(NamedTuple):
    """For each row and each end of a core the index in another core; −1 for new ones."""

    row: np.ndarray
    link: np.ndarray

    @classmethod
    def of(cls, new: Core | Embodied, old: Core | Embodied) -> IndexMap:
        rows = {agent: k for k, agent in enumerate(old.part.team.ids)}
        links = {end: k for k, end in enumerate(old.ends)}
        return cls(
            np.array([rows.get(agent, -1) for agent in new.part.team.ids], dtype=int),
            np.array([links.get(end, -1) for end in new.ends], dtype=int),
        )

    def merge(self, per: str | Mapping[str, Any], old: Any, fresh: Any) -> Any:
        """The values `old` where they have an index, else `fresh`. `per`: see `consat.protocols.Rounds.per`."""
        if isinstance(per, str):
            index = {"row": self.row, "link": self.link}.get(per)
            return old if index is None else jax.tree.map(functools.partial(_take, index), old, fresh)
        return type(fresh)(**{name: self.merge(kind, getattr(old, name), getattr(fresh, name)) for name, kind in per.items()})


def _take(index: np.ndarray, old: Array, fresh: Array) -> Array:
    if not len(old) or not len(index):
        return fresh
    kept = (index >= 0).reshape(-1, *[1] * (np.ndim(fresh) - 1))
    return jnp.where(kept, jnp.asarray(old)[np.maximum(index, 0)], fresh)


def no_pair_numbers(whole: Part) -> Mapping[str, Numbers]:
    """`Core.pair_numbers` of a protocol that sends rows for ends of links only."""
    return {neighbour.id: Numbers((0,)) for neighbour in whole.neighbours}


class _RoundState(NamedTuple):
    state: Any
    ages: agreement.Ages


class RoundCore:
    """Core of a protocol in rounds, with the counters of `consat.protocols.agreement`."""

    def __init__(self, protocol: Rounds, whole: Part, gone: Collection[str] = ()) -> None:
        self.protocol = protocol
        self.whole = whole
        self.part = whole.without(gone)
        self.ends = ends(self.part)
        self.solver = OwnSolver.of(self.part)
        self._begin, self._turn, *_ = _compiled()
        self.layout = _Layout.of(protocol, self.solver, self.part.team.dimension)
        self.width = sum(self.layout.sizes) + 1
        # In admm a scalar is ρ. In other protocols it may be a margin, which is infinite for an agent without constraints.
        single = PENALTY / whole.length**2 if protocol.name == "admm" else np.inf
        self.largest = np.array([*(LARGEST if shape else single for shape, size in self.layout.each for _ in range(size)), LARGEST])
        self.pair_numbers = no_pair_numbers(whole)

    def begin(self, first: np.ndarray, time: float = 0.0) -> _RoundState:
        return self._begin(self.protocol, self.solver, first, time)

    def turn(self, state: _RoundState, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        heard = inbox.link, arrived.link, moment.fresh
        now, outbox = self._turn(self.protocol, self.layout, self.solver, state, heard, (moment.round, moment.margin, moment.time))
        return StepResult(now, Rows(np.asarray(outbox), inbox.pair), np.asarray(now.state.x))

    def without(self, gone: Collection[str], whole: Part | None = None) -> RoundCore:
        return RoundCore(self.protocol, whole or self.whole, gone)

    def without_proofs(self, state: _RoundState) -> _RoundState:
        """The state unchanged: it contains no proofs."""
        return state

    def carry(self, other: Core, state: _RoundState, first: np.ndarray, time: float = 0.0) -> _RoundState:
        """Initial state with the old estimates. The rest of the state belongs to the old problem."""
        return self.begin(np.asarray(IndexMap.of(self, other).merge("row", state.state.x, first)), time)


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


class _Layout(NamedTuple):
    """Structure of a message, and for each of its arrays the shape for one end of a link."""

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, protocol: Rounds, solver: OwnSolver, dimension: int) -> _Layout:
        """Find the layout by tracing, without computing."""
        first, outline = jax.ShapeDtypeStruct((len(solver.holder), dimension), float), _Outline(solver)

        def message(x: Array) -> Any:
            return protocol.speak(protocol.start(x, outline), outline, jnp.asarray(0.0), Known(jnp.zeros(1), jnp.zeros(1)))[1]

        leaves, structure = jax.tree.flatten(jax.eval_shape(message, first))
        return cls(structure, tuple(leaf.shape[1:] for leaf in leaves))

    @property
    def sizes(self) -> list[int]:
        return [math.prod(shape) for shape in self.shapes]

    @property
    def each(self) -> Iterator[tuple[tuple[int, ...], int]]:
        """Shape and size of each array."""
        return zip(self.shapes, self.sizes, strict=True)

    def unpack(self, packed: Array) -> Any:
        """The message from its rows, (E, Σ sizes)."""
        stops = np.cumsum(self.sizes)
        leaves = [
            packed[:, stop - size : stop].reshape(len(packed), *shape)
            for stop, size, shape in zip(stops, self.sizes, self.shapes, strict=True)
        ]
        return jax.tree.unflatten(self.structure, leaves)


def _begin(protocol: Rounds, solver: OwnSolver, first: Array, time: Array) -> _RoundState:
    solver = solver.at(time)
    return _RoundState(protocol.start(first, solver), agreement.start(first, solver))


def _turn(
    protocol: Rounds,
    layout: _Layout,
    solver: OwnSolver,
    now: _RoundState,
    heard: tuple[Array, Array, Array],
    moment: tuple[Array, Array, Array],
) -> tuple[_RoundState, Array]:
    inbox, arrived, fresh = heard
    round_, margin, time = moment
    solver = solver.at(time)
    state = protocol.hear(now.state, layout.unpack(inbox), arrived, solver)
    ages = known_of(agreement.hear(now.ages, inbox[:, -1], arrived), fresh)
    known = Known(agreement.known(ages, solver), jnp.asarray(margin)[None])
    state, message = protocol.speak(state, solver, round_, known)
    ages, told = agreement.speak(ages, state.x, solver)
    outbox = jnp.concatenate(
        [*(leaf.reshape(len(inbox), size) for leaf, size in zip(jax.tree.leaves(message), layout.sizes, strict=True)), told[:, None]],
        axis=1,
    )
    return _RoundState(state, ages), outbox


def known_of(ages: agreement.Ages, fresh: Array | np.ndarray) -> agreement.Ages:
    """The counters, with those of silent neighbours set to 0."""
    return ages._replace(heard=jnp.where(fresh, ages.heard, 0.0))


class EmbodiedState(NamedTuple):
    """State of an agent.

    Attributes:
        core: state of its core.
        bodies: see `consat.protocols.agreement`.
    """

    core: Any
    bodies: agreement.Bodies


_PER_BODIES: Final[Mapping[str, Any]] = {"position": "row", "stale": "row", "ages": {"age": "agent", "heard": "link"}}


class Embodied:
    """A core that also exchanges positions of bodies. It appends d + 2 entries to each row of a link: the position, the number of steps
    since it was measured, and the number of rounds for which all are satisfied.

    Args:
        core: the core of the protocol.
    """

    def __init__(self, core: Core) -> None:
        self.core, self.part = core, core.part
        self.ends: Sequence[tuple[str, str]] = core.ends
        dimension = self.part.team.dimension
        self.width = core.width + dimension + 2
        self.largest = np.append(core.largest, np.full(dimension + 2, LARGEST))
        self.pair_numbers = core.pair_numbers
        self.ages = (*([core.width - 1] if core.width else []), self.width - 1)
        """Columns of the rows of links that count rounds."""
        self._owners, (*_, self._start, self._agree, self._margin) = owners_of(self.part), _compiled()

    def begin(self, first: np.ndarray, time: float = 0.0) -> EmbodiedState:
        """See `Core.begin`."""
        return EmbodiedState(self.core.begin(first, time), self._start(self.core.solver, first))

    def turn(self, state: EmbodiedState, inbox: Rows, arrived: Rows, moment: Moment) -> tuple[EmbodiedState, Rows, AgentView]:
        """See `Core.turn`. Returns the next state, the messages to send, and what the agent then knows."""
        width = self.core.width
        bodies, said, sight = self._agree(
            self.core.solver, self._owners, state.bodies, (inbox.link[:, width:], arrived.link, moment.fresh), moment.body, moment.time
        )
        heard, known, margin = (np.asarray(each)[0] for each in sight)
        moment = moment._replace(margin=float(margin))
        inner = self.core.turn(state.core, Rows(inbox.link[:, :width], inbox.pair), arrived, moment)
        proven = near(inner.bound, inner.least, self.part.psi)
        view = AgentView(inner.x, np.asarray(bodies.position), bool(heard), float(known), inner.bound, inner.least, proven)
        link = np.concatenate([inner.outbox.link, np.asarray(said)], axis=1)
        return EmbodiedState(inner.state, bodies), Rows(link, inner.outbox.pair), view

    def empty(self) -> tuple[Rows, Rows]:
        """An inbox and its masks of arrival, without messages."""
        neighbours = [neighbour.id for neighbour in self.part.neighbours]
        longest = max((self.pair_numbers[neighbour].shape[0] for neighbour in neighbours), default=0)
        inbox = Rows(np.zeros((len(self.ends), self.width)), np.zeros((len(neighbours), longest)))
        return inbox, Rows(*(np.zeros(len(rows), dtype=bool) for rows in inbox))

    def margin(self, positions: np.ndarray, time: float = 0.0) -> float:
        """ᾱ_i at the positions, (rows, d), of the agents of the part; +∞ without constraints. `time`: see `Moment.time`."""
        return float(np.asarray(self._margin(self.core.solver, positions, time))[0])

    def without(self, gone: Collection[str], whole: Part | None = None) -> Embodied:
        """See `Core.without`."""
        return Embodied(self.core.without(gone, whole))

    def adjusted(self, whole: Part) -> Embodied:
        """Copy with other constraint parameters. Nothing is compiled. `whole`: a part that differs only in these parameters."""
        core: Any = copy.copy(self.core)
        core.whole, core.part = whole, whole.without(set(core.whole.team.ids) - set(self.part.team.ids))
        core.solver = replace(core.solver, live=live_of(core.part))
        return Embodied(core)

    def without_proofs(self, state: EmbodiedState) -> EmbodiedState:
        """See `Core.without_proofs`."""
        return state._replace(core=self.core.without_proofs(state.core))

    def carry(self, other: Embodied, state: EmbodiedState, first: np.ndarray, time: float = 0.0) -> EmbodiedState:
        """See `Core.carry`. Positions of bodies are kept; the counters of satisfied rounds restart."""
        fresh = self._start(self.core.solver, first)
        bodies = IndexMap.of(self, other).merge(_PER_BODIES, state.bodies, fresh)._replace(ages=fresh.ages)
        return EmbodiedState(self.core.carry(other.core, state.core, first, time), bodies)


def owners_of(part: Part) -> agreement.Owners:
    """The agents whose positions the agent of a part holds, and the ends of links over which it accepts positions of their bodies."""
    place, pairs = {agent: row for row, agent in enumerate(part.team.ids)}, ends(part)
    row = np.array([place[agent] for _, agent in pairs], dtype=np.int64)
    direct = np.array([neighbour == agent for neighbour, agent in pairs], dtype=bool)
    return agreement.Owners.of(np.array([place[part.me]]), row, direct, part.team.count)


def _agree(
    solver: OwnSolver, owners: agreement.Owners, bodies: agreement.Bodies, heard: tuple[Array, Array, Array], body: Array,
    time: Array,
) -> tuple[agreement.Bodies, Array, tuple[Array, Array, Array]]:  # fmt: skip
    solver = solver.at(time)
    inbox, arrived, fresh = heard
    bodies = agreement.hear_bodies(bodies, agreement.Word(inbox[:, :-2], inbox[:, -2], inbox[:, -1]), arrived, owners, solver)
    bodies, word = agreement.speak_bodies(bodies._replace(ages=known_of(bodies.ages, fresh)), body[None], owners, solver)
    said = jnp.concatenate([word.position, word.stale[:, None], word.age[:, None]], axis=1)
    all_heard = agreement.all_heard(bodies, solver)
    margin = jnp.where(all_heard & jnp.isfinite(body).all(), solver.margin(bodies.position), -jnp.inf)
    return bodies, said, (all_heard, agreement.known(bodies.ages, solver), margin)


class _Programs(NamedTuple):
    begin: Callable[..., Any]
    turn: Callable[..., Any]
    start: Callable[..., Any]
    agree: Callable[..., Any]
    margin: Callable[..., Any]


@functools.cache
def _compiled() -> _Programs:
    """The compiled functions, which all agents of the same shape share."""
    options = quick_compilation()

    def start(solver: OwnSolver, first: Array) -> agreement.Bodies:
        return agreement.start_bodies(first, solver)

    def margin(solver: OwnSolver, positions: Array, time: Array) -> Array:
        return solver.at(time).margin(positions)

    return _Programs(
        jax.jit(_begin, static_argnames=("protocol",), compiler_options=options),
        jax.jit(_turn, static_argnames=("protocol", "layout"), compiler_options=options),
        *(jax.jit(function, compiler_options=options) for function in (start, _agree, margin)),
    )

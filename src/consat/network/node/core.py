"""What an agent computes, apart from how its messages travel: a protocol, compiled for its own part, and what it knows of bodies.

A core turns what has come since its last turn into its next state and what it says next: one row of numbers for each end of a link, and one
for each neighbour. `Embodied` adds to any core the agreement about bodies.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple, Protocol, TypeVar

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
"""No number that agents send is larger, margins apart, as none in a scenario is: squares stay finite."""
PENALTY: Final = 1e80
"""No ρ is larger that agents tell each other in ADMM, in the team's own unit of length: forces are rescaled by its changes. One that is
not positive makes the state NaN, which `consat.network.node.guard` does not let happen."""


class Moment(NamedTuple):
    """What a turn may ask about time.

    Attributes:
        round: which turn it is, from 0.
        elapsed: since the last turn, s.
        delay: (E,) how long messages take over each end, s.
        fresh: (E,) whether the neighbour at the other end was heard lately.
        body: (d,) where the agent's body is, NaN where that is not known.
        margin: ᾱ_i there, and where it last heard that the others are; −∞ where that is not known.
        time: by the clock that the team shares, s since t = 0; what schedules go by.
    """

    round: float
    elapsed: float
    delay: np.ndarray
    fresh: np.ndarray
    body: np.ndarray
    margin: float = -np.inf
    time: float = 0.0


class AgentView(NamedTuple):
    """What an agent sees of itself after a turn.

    Attributes:
        x: (rows, d) its estimates.
        bodies: (rows, d) where its own body is, and where it last heard that the others are.
        heard: whether it has heard of all of them.
        known: for how many turns it has known that all are satisfied, by their bodies.
        bound: proven to be at least the best margin that the team can have; +∞ without proof.
        least: the least margin of the team's bodies that it knows of; −∞ while it has not heard of all.
        near: whether that is proven to be near the best.
    """

    x: np.ndarray
    bodies: np.ndarray
    heard: bool
    known: float
    bound: float = np.inf
    least: float = -np.inf
    near: bool = False


class Rows(NamedTuple):
    """What an agent says or hears in a turn.

    Attributes:
        link: (E, width) for each end of a link.
        pair: (G, W) for each neighbour that is there, in the order of the part, padded to the longest.
    """

    link: np.ndarray
    pair: np.ndarray


class StepResult(NamedTuple):
    """What comes of a turn of a protocol.

    Attributes:
        state: the next.
        outbox: what to send.
        x: (rows, d) the estimates.
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
        """Whose."""
        ...

    @property
    def ends(self) -> Sequence[tuple[str, str]]:
        """(neighbour, agent) for each end; see `consat.network.node.problem.ends`."""
        ...

    @property
    def width(self) -> int:
        """How many numbers an end sends."""
        ...

    @property
    def largest(self) -> np.ndarray:
        """(width,) the largest magnitude that each of them may have."""
        ...

    @property
    def pair_numbers(self) -> Mapping[str, Numbers]:
        """What it says to each neighbour besides, whoever is there."""
        ...

    @property
    def solver(self) -> OwnSolver:
        """Of the part."""
        ...

    def begin(self, first: np.ndarray, time: float = 0.0) -> Any:
        """The state from first estimates, (rows, d), at a time of the shared clock, s."""
        ...

    def turn(self, state: Any, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        """Hear what arrived, where `arrived`, (E,) and (G,), and take a step."""
        ...

    def among(self, gone: Collection[str], whole: Part | None = None) -> Core:
        """The same protocol when these agents are not there, on another part if one is given."""
        ...

    def carry(self, other: Core, state: Any, first: np.ndarray, time: float = 0.0) -> Any:
        """The state that `state` of an `other` core becomes in this one; what is new begins from `first`, (rows, d)."""
        ...

    def without_proofs(self, state: Any) -> Any:
        """The state when constraints have changed: what was proven with others holds no more."""
        ...


_Any = TypeVar("_Any", bound=Any)


def adjusted(core: _Any, whole: Part) -> _Any:
    """A core with other parameters of its constraints: those of a part that differs in nothing else. Nothing compiles."""
    other = copy.copy(core)
    other.whole, other.part = whole, whole.without(set(core.whole.team.ids) - set(core.part.team.ids))
    other.solver = replace(core.solver, live=live_of(other.part))
    return other


class IndexMap(NamedTuple):
    """Which rows and ends of another core live on: the index there, −1 where new."""

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
        """`old` where it lives on, else `fresh`; `per` as in `consat.protocols.Rounds.per`."""
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
    """Of a protocol that speaks for each end of a link only."""
    return {neighbour.id: Numbers((0,)) for neighbour in whole.neighbours}


class _RoundState(NamedTuple):
    state: Any
    ages: agreement.Ages


class RoundCore:
    """A protocol in rounds on one agent, with the ages of `consat.protocols.agreement` by which it paces itself."""

    def __init__(self, protocol: Rounds, whole: Part, gone: Collection[str] = ()) -> None:
        self.protocol = protocol
        self.whole = whole
        self.part = whole.without(gone)
        self.ends = ends(self.part)
        self.solver = OwnSolver.of(self.part)
        self._begin, self._turn, *_ = _compiled()
        self.layout = _Layout.of(protocol, self.solver, self.part.team.dimension)
        self.width = sum(self.layout.sizes) + 1
        # A single number is ρ in admm; in others it may be a margin, which is infinite of an agent without constraints.
        single = PENALTY / whole.length**2 if protocol.name == "admm" else np.inf
        self.largest = np.array([*(LARGEST if shape else single for shape, size in self.layout.each for _ in range(size)), LARGEST])
        self.pair_numbers = no_pair_numbers(whole)

    def begin(self, first: np.ndarray, time: float = 0.0) -> _RoundState:
        return self._begin(self.protocol, self.solver, first, time)

    def turn(self, state: _RoundState, inbox: Rows, arrived: Rows, moment: Moment) -> StepResult:
        heard = inbox.link, arrived.link, moment.fresh
        now, outbox = self._turn(self.protocol, self.layout, self.solver, state, heard, (moment.round, moment.margin, moment.time))
        return StepResult(now, Rows(np.asarray(outbox), inbox.pair), np.asarray(now.state.x))

    def among(self, gone: Collection[str], whole: Part | None = None) -> RoundCore:
        return RoundCore(self.protocol, whole or self.whole, gone)

    def without_proofs(self, state: _RoundState) -> _RoundState:
        """Nothing is proven in it; that constraints hold is counted afresh in every turn."""
        return state

    def carry(self, other: Core, state: _RoundState, first: np.ndarray, time: float = 0.0) -> _RoundState:
        """Only the estimates live on: the rest has settled on a problem that is no more, what is known of its satisfaction included."""
        return self.begin(np.asarray(IndexMap.of(self, other).merge("row", state.state.x, first)), time)


class _Outline:
    """A solver that gives what a true one gives, but for the values: enough to find the shape of a message, and quick to trace."""

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
    """What a message consists of: its structure, and for each array the shape of what one end sends."""

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, protocol: Rounds, solver: OwnSolver, dimension: int) -> _Layout:
        """Found by tracing, not by running."""
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
        """(E, Σ sizes) → the message."""
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
    """Of a neighbour that has fallen silent nothing is known."""
    return ages._replace(heard=jnp.where(fresh, ages.heard, 0.0))


class EmbodiedState(NamedTuple):
    """What an agent remembers.

    Attributes:
        core: the state of its core.
        bodies: see `consat.protocols.agreement`.
    """

    core: Any
    bodies: agreement.Bodies


_PER_BODIES: Final[Mapping[str, Any]] = {"position": "row", "stale": "row", "ages": {"age": "agent", "heard": "link"}}


class Embodied:
    """Any core, with word of where the bodies are: d coordinates, for how many turns they have been on their way, and an age.

    Args:
        core: the protocol on the agent.
    """

    def __init__(self, core: Core) -> None:
        self.core, self.part = core, core.part
        self.ends: Sequence[tuple[str, str]] = core.ends
        dimension = self.part.team.dimension
        self.width = core.width + dimension + 2
        self.largest = np.append(core.largest, np.full(dimension + 2, LARGEST))
        self.pair_numbers = core.pair_numbers
        self.ages = (*([core.width - 1] if core.width else []), self.width - 1)
        """Columns of the rows that say for how many rounds something has held."""
        self._owners, (*_, self._start, self._agree, self._margin) = owners_of(self.part), _compiled()

    def begin(self, first: np.ndarray, time: float = 0.0) -> EmbodiedState:
        """The state from first estimates, (rows, d), at a time of the shared clock, s."""
        return EmbodiedState(self.core.begin(first, time), self._start(self.core.solver, first))

    def turn(self, state: EmbodiedState, inbox: Rows, arrived: Rows, moment: Moment) -> tuple[EmbodiedState, Rows, AgentView]:
        """See `Core.turn`; and what the agent then sees of itself."""
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
        """Nothing has come: an inbox, and what in it has arrived."""
        neighbours = [neighbour.id for neighbour in self.part.neighbours]
        longest = max((self.pair_numbers[neighbour].shape[0] for neighbour in neighbours), default=0)
        inbox = Rows(np.zeros((len(self.ends), self.width)), np.zeros((len(neighbours), longest)))
        return inbox, Rows(*(np.zeros(len(rows), dtype=bool) for rows in inbox))

    def margin(self, positions: np.ndarray, time: float = 0.0) -> float:
        """ᾱ_i at a time of the shared clock, s, were the agents of the part at these positions, (rows, d); +∞ without constraints."""
        return float(np.asarray(self._margin(self.core.solver, positions, time))[0])

    def among(self, gone: Collection[str], whole: Part | None = None) -> Embodied:
        """The same when these agents are not there, on another part if one is given."""
        return Embodied(self.core.among(gone, whole))

    def adjusted(self, whole: Part) -> Embodied:
        """See `adjusted`."""
        return Embodied(adjusted(self.core, whole))

    def without_proofs(self, state: EmbodiedState) -> EmbodiedState:
        """See `Core.without_proofs`."""
        return state._replace(core=self.core.without_proofs(state.core))

    def carry(self, other: Embodied, state: EmbodiedState, first: np.ndarray, time: float = 0.0) -> EmbodiedState:
        """See `Core.carry`. Where bodies are lives on; who is satisfied does not."""
        fresh = self._start(self.core.solver, first)
        bodies = IndexMap.of(self, other).merge(_PER_BODIES, state.bodies, fresh)._replace(ages=fresh.ages)
        return EmbodiedState(self.core.carry(other.core, state.core, first, time), bodies)


def owners_of(part: Part) -> agreement.Owners:
    """Whose positions the agent of a part holds, and from whom it takes word of their bodies."""
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
    """Compiled once for all agents of the same shape."""
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

"""Rounds of one team in several processes. Each process computes both halves of a round for its own agents, with one exchange between."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from consat.engine.bodies import Body
from consat.engine.chunks import CHUNK, Chunk, Kept
from consat.engine.partition import Halo, Share, assign
from consat.engine.recording import Choice
from consat.engine.round import Now, Spoken, begin, hear, speak
from consat.engine.world import Part, World, precision_for, world_of
from consat.errors import InvalidSettings
from consat.faults import Faults
from consat.numerics import on_device, quick_compilation
from consat.problem.graphs import hops
from consat.problem.objective import Nu
from consat.problem.team import Team
from consat.problem.units import Scale
from consat.protocols import Rounds
from consat.protocols.estimates import Estimates
from consat.protocols.sending import HEADER

PATIENCE = 600
"""Largest time, in s, that processes wait for one another to compile."""


class _Way(NamedTuple):
    """A `Halo` on the device."""

    out: Array
    into: Array

    @classmethod
    def of(cls, halo: Halo) -> _Way:
        return cls(on_device(halo.out), on_device(halo.into))


class _Book(NamedTuple):
    """Buffers of a chunk of rounds, each with leading axis CHUNK: positions of bodies, recorded estimates, and counters."""

    body: Array
    estimate: Array
    known: Array
    messages: Array
    floats: Array


class _State(NamedTuple):
    """State of this process's agents."""

    now: Now
    number: int
    """Number of the next round."""


class ManyProcesses:
    """`consat.engine.chunks.Engine` that runs in several processes, each of which computes its share of the agents.

    Every process creates one with the same arguments after it has joined (`consat.processes`), and makes the same calls in the same order.

    Args:
        team: the whole team.
        protocol: the protocol.
        copies: the layout of estimates.
        nu: the smoothing.
        size: the team's natural scale.
        first: (C, d) initial estimates.
        convex: whether every ψ is known to be concave.
        faults: message loss and sleep.
        body: how fast positions follow estimates.
        choice: what is recorded.
        hold: number of consecutive satisfied rounds that end the run; None if they do not.

    Raises:
        InvalidSettings: there are more processes than agents.
    """

    def __init__(
        self, team: Team, protocol: Rounds, copies: Estimates, nu: Nu, size: Scale, first: np.ndarray, *, convex: bool, faults: Faults,
        body: Body | None, choice: Choice, hold: int | None,
    ) -> None:  # fmt: skip
        self._count, self._me = jax.process_count(), jax.process_index()
        if team.count < self._count:
            raise InvalidSettings(f"there are {self._count} processes for {team.count} agents; start no more processes than agents")
        part = assign(team, copies, self._count)
        self._share = share = Share.of(team, copies, part, self._me, self._count)
        self._protocol, self._hold, self._choice, self._seed = protocol, hold, choice, faults.seed
        self._first, self._agents, self._dimension = first[share.rows], team.count, team.dimension
        world = world_of(share.team, share.copies, nu, size, convex=convex, faults=faults, body=body, partial=True)
        links = dataclasses.replace(world.everyone.links, metropolis=on_device(1.0 / (1.0 + share.degree)))
        everyone = dataclasses.replace(
            world.everyone, links=links, hops=hops(team.count, copies.links), precision=precision_for(team.count)
        )
        ours = np.arange(len(share.agents)) < share.mine
        self.world = dataclasses.replace(
            world, everyone=everyone,
            part=Part(on_device(share.agents.astype(np.int32)), on_device(share.pair.astype(np.int32)), on_device(ours), team.count,
                      share.pairs),
        )  # fmt: skip
        self._capacity = -(-CHUNK // choice.every) + 1
        self._messages, self._positions = _Way.of(share.messages), _Way.of(share.positions)
        self.cut = float(np.mean(part[copies.links[:, 0]] != part[copies.links[:, 1]])) if len(copies.links) else 0.0
        mesh = Mesh(np.array(jax.devices()), ("process",))
        self._sharding = NamedSharding(mesh, PartitionSpec("process"))
        self._swap, self._gather = _collectives(mesh)
        self._people = _Places.of(choice.agents, part, share.agents[: share.mine], self._me, self._count)
        chosen = np.zeros(0, dtype=np.int64) if choice.copies is None else choice.copies
        self._rows = _Places.of(chosen, part[copies.holder], np.where(share.ours, share.rows, -1), self._me, self._count)
        self._warm_up()
        together()
        self._all = _Places.of(np.arange(team.count), part, share.agents[: share.mine], self._me, self._count)

    def _warm_up(self) -> None:
        """Compile the local programs before the first exchange, because processes in an exchange wait only for a short time."""
        run, world, rows = _compiled(), self.world, jnp.asarray(self._rows.mine)
        now = run.begin(self._protocol, world, jnp.asarray(self._first), jax.random.key(self._seed))
        book, zero = run.empty(now, rows), jnp.asarray(0)
        spoken, out = run.speak(self._protocol, world, now, jnp.asarray(0.0), self._messages.out)
        now, book = run.hear(self._protocol, world, spoken, (out, self._messages.into), (book, rows, zero))
        across = run.pack_positions(book.body, self._positions.out)
        jax.block_until_ready(run.look(world, run.note(book, now, rows, zero), now.body, across, self._positions.into))

    def start(self) -> tuple[_State, Chunk]:
        now = _compiled().begin(self._protocol, self.world, jnp.asarray(self._first), jax.random.key(self._seed))
        book = _compiled().empty(now, jnp.asarray(self._rows.mine))
        book = _compiled().note(book, now, jnp.asarray(self._rows.mine), jnp.asarray(0))
        chunk = self._seen(book, now.body, np.zeros(1, dtype=int), 1)
        return _State(now, 0), chunk

    def advance(self, state: _State, number: int, count: int, streak: tuple[int, int] | None, every: int) -> tuple[_State, Chunk]:
        now, run = state.now, _compiled()
        book = run.empty(now, jnp.asarray(self._rows.mine))
        for k in range(count):
            at = jnp.asarray(float(number + k))
            spoken, out = run.speak(self._protocol, self.world, now, at, self._messages.out)
            into = self._exchanged(out)
            noted = (book, jnp.asarray(self._rows.mine), jnp.asarray(k))
            now, book = run.hear(self._protocol, self.world, spoken, (into, self._messages.into), noted)
        numbers = np.arange(number + 1, number + 1 + count)
        chunk = self._seen(book, state.now.body, np.flatnonzero(numbers % every == 0), count)
        if self._hold is not None:
            satisfied = 0 if streak is None else streak[0]
            for k, margin in enumerate(chunk.margin[:count]):
                satisfied = satisfied + 1 if margin > 0 else 0
                if satisfied >= self._hold and k + 1 < count:  # the run ends within the chunk: compute it again up to that round
                    return self.advance(state, number, k + 1, (satisfied - k - 1, 0), every)
        return _State(now, number + count), chunk

    def _seen(self, book: _Book, anchor: Array, kept: np.ndarray, count: int) -> Chunk:
        """The chunk as an observer of the whole team sees it. Positions are exchanged once, then per-process scalars are gathered.

        Args:
            book: buffers of the chunk.
            anchor: (n, d) positions before the chunk.
            kept: indices of the recorded rounds in the chunk.
            count: number of rounds in the chunk.
        """
        run = _compiled()
        into = self._exchanged(run.pack_positions(book.body, self._positions.out))
        margins, scalars = run.look(self.world, book, anchor, into, self._positions.into)
        margin, smooth, known, messages, floats, drift = np.moveaxis(self._gathered(scalars), 2, 0)  # each (P, CHUNK)
        nu = float(self.world.everyone.nu.beta)
        padded = jnp.asarray(np.pad(kept, (0, self._capacity - len(kept))))
        people = self._people.all(self._gathered(run.people(book.body, margins, jnp.asarray(self._people.mine), padded)))
        rows = self._rows.all(self._gathered(book.estimate[padded]))
        d = self._dimension
        return Chunk(
            done=count,
            margin=margin.min(axis=0),
            smooth_margin=-np.logaddexp.reduce(-nu * smooth, axis=0) / nu,
            known=(known.min(axis=0) > 0).astype(np.int64),
            bound=np.full(CHUNK, np.nan),
            near=0,
            messages=messages.sum(axis=0).astype(np.int64),
            floats=floats.sum(axis=0).astype(np.int64),
            bytes=(HEADER * messages + 8 * floats).sum(axis=0).astype(np.int64),
            drift=drift[:, :count].max(),
            violated=None,
            kept=Kept(people[..., :d], people[..., d], rows, np.zeros((len(people), 0))),
        )

    def positions(self, state: _State) -> np.ndarray:
        mine = jnp.asarray(self._all.mine)
        return self._all.all(self._gathered(state.now.body[mine][None]))[0]

    def agree(self, stop: bool) -> bool:
        return bool(self._gathered(jnp.asarray(float(stop))).any())

    def look(self, state: _State, number: int) -> Kept:
        book = _compiled().empty(state.now, jnp.asarray(self._rows.mine))
        book = _compiled().note(book, state.now, jnp.asarray(self._rows.mine), jnp.asarray(0))
        kept = self._seen(book, state.now.body, np.zeros(1, dtype=int), 1).kept
        return Kept(*(leaf[0] for leaf in kept))

    def _exchanged(self, out: Array) -> Array:
        """(P, H, …) items for each process → (P, H, …) items from each process."""
        return self._swap(self._shared(out)).addressable_data(0)[0]

    def _gathered(self, mine: Array) -> np.ndarray:
        """(…) → (P, …): the array of every process."""
        return np.asarray(self._gather(self._shared(mine)).addressable_data(0))

    def _shared(self, mine: Array) -> Array:
        return jax.make_array_from_single_device_arrays((self._count, *mine.shape), self._sharding, [mine[None]])


def together() -> None:
    """Barrier: wait up to `PATIENCE` until every process has arrived, which is longer than an exchange waits."""
    from jax._src import distributed  # public barriers are exchanges between devices, which wait for a short and fixed time

    client: Any = distributed.global_state.client
    client.wait_at_barrier("consat", PATIENCE * 1000)


class _Places(NamedTuple):
    """Distribution of a list of items (agents or rows) over the processes.

    Attributes:
        mine: (W,) local indices of this process's items, padded with 0 to the largest number of any process.
        whose: for each process the indices of its items in the list.
    """

    mine: np.ndarray
    whose: list[np.ndarray]

    @classmethod
    def of(cls, items: np.ndarray, part: np.ndarray, held: np.ndarray, me: int, processes: int) -> _Places:
        """Distribute a list of items.

        Args:
            items: (K,) indices in the whole team.
            part: process of each agent or row of the whole team.
            held: indices in the whole team of what this process holds; −1 where it belongs to another process.
            me: this process.
            processes: number of processes.
        """
        whose = [np.flatnonzero(part[items] == process) for process in range(processes)]
        width = max(map(len, whose), default=0)
        place = np.zeros(len(part), dtype=np.int64)
        place[held[held >= 0]] = np.flatnonzero(held >= 0)
        mine = place[items[whose[me]]]
        return cls(np.pad(mine, (0, width - len(mine))), whose)

    def all(self, gathered: np.ndarray) -> np.ndarray:
        """(P, S, W, …) gathered from all processes → (S, K, …) in the order of the list."""
        _, steps, _, *rest = gathered.shape
        found = np.empty((steps, sum(map(len, self.whose)), *rest))
        for mine, places in zip(gathered, self.whose, strict=True):
            found[:, places] = mine[:, : len(places)]
        return found


@functools.cache
def _collectives(mesh: Mesh) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """The two compiled exchanges: all-to-all and all-gather."""
    parts, whole = PartitionSpec("process"), PartitionSpec()

    def swap(mine: Array) -> Array:
        return jax.lax.all_to_all(mine[0], "process", 0, 0, tiled=True)[None]

    def gather(mine: Array) -> Array:
        return jax.lax.all_gather(mine[0], "process")

    return (
        jax.jit(jax.shard_map(swap, mesh=mesh, in_specs=parts, out_specs=parts)),
        jax.jit(jax.shard_map(gather, mesh=mesh, in_specs=parts, out_specs=whole, check_vma=False)),
    )


class _Programs(NamedTuple):
    """The compiled functions of `_compiled`."""

    begin: Callable[..., Now]
    empty: Callable[..., _Book]
    note: Callable[..., _Book]
    speak: Callable[..., tuple[Spoken, Array]]
    hear: Callable[..., tuple[Now, _Book]]
    pack_positions: Callable[..., Array]
    look: Callable[..., tuple[Array, Array]]
    people: Callable[..., Array]


def _packed(spoken: Spoken) -> Array:
    """(E, W) all arrays of a message, flattened and concatenated."""
    return jnp.concatenate([leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(spoken.crossing)], axis=1)


def _with(spoken: Spoken, packed: Array) -> Spoken:
    leaves, structure = jax.tree.flatten(spoken.crossing)
    found = jnp.split(packed, np.cumsum([leaf[0].size for leaf in leaves])[:-1], axis=1)
    crossing = [new.reshape(old.shape) for new, old in zip(found, leaves, strict=True)]
    return spoken._replace(crossing=jax.tree.unflatten(structure, crossing))


@functools.cache
def _compiled() -> _Programs:
    def start(protocol: Rounds, world: World, first: Array, key: Array) -> Now:
        return begin(protocol, world, first, key)[0]

    def empty(now: Now, rows: Array) -> _Book:
        real, d = now.body.dtype, now.body.shape[1]
        numbers = (jnp.zeros(CHUNK, real) for _ in range(3))
        return _Book(jnp.zeros((CHUNK, *now.body.shape), real), jnp.zeros((CHUNK, len(rows), d), real), *numbers)

    def note(book: _Book, now: Now, rows: Array, place: Array) -> _Book:
        return book._replace(body=book.body.at[place].set(now.body), estimate=book.estimate.at[place].set(now.state.x[rows]))

    def speak_(protocol: Rounds, world: World, now: Now, number: Array, out: Array) -> tuple[Spoken, Array]:
        spoken = speak(protocol, world, now, number)
        return spoken, _packed(spoken)[out]

    def hear_(protocol: Rounds, world: World, spoken: Spoken, heard: tuple[Array, Array], noted: tuple[_Book, Array, Array]) -> Any:
        came, into = heard
        packed = _packed(spoken).at[into.reshape(-1)].set(came.reshape(-1, came.shape[-1]), mode="drop")
        now, (known, _) = hear(protocol, world, _with(spoken, packed))
        book, rows, place = noted
        counts = {"known": known, "messages": spoken.sent.messages, "floats": spoken.sent.floats}
        book = book._replace(**{name: getattr(book, name).at[place].set(value.astype(float)) for name, value in counts.items()})
        return now, note(book, now, rows, place)

    def pack_positions(body: Array, out: Array) -> Array:
        return jnp.moveaxis(body[:, out], 0, 2)  # (P, H, CHUNK, d)

    def look(world: World, book: _Book, anchor: Array, came: Array, into: Array) -> tuple[Array, Array]:
        steps = jnp.moveaxis(came.reshape(-1, *came.shape[2:]), 1, 0)
        body = book.body.at[:, into.reshape(-1)].set(steps, mode="drop")
        ours = world.part.ours if world.part is not None else jnp.ones(len(anchor), bool)

        def one(at: Array) -> tuple[Array, Array, Array, Array]:
            margins = world.observer.agent_margins(at)
            moved = jnp.max(jnp.where(ours[:, None], jnp.abs(at - anchor), 0.0))
            return margins, jnp.min(margins), world.observer.smooth_margin(at, world.everyone.nu), moved

        margins, least, smooth, moved = jax.lax.map(one, body)
        return margins, jnp.stack([least, smooth, book.known, book.messages, book.floats, moved], axis=1)

    def people(body: Array, margins: Array, agents: Array, kept: Array) -> Array:
        return jnp.concatenate([body[kept][:, agents], margins[kept][:, agents, None]], axis=2)

    options = quick_compilation()
    functions = (start, empty, note, speak_, hear_, pack_positions, look, people)
    return _Programs(
        *(jax.jit(f, static_argnames=("protocol",) if f in (start, speak_, hear_) else (), compiler_options=options) for f in functions)
    )

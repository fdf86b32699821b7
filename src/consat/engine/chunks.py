"""Who carries out the rounds, a chunk at a time: a program on the device, so that nothing waits for Python between two rounds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.engine.recording import Choice
from consat.engine.round import SATISFIED, Now, Seen, Sent, World, begin, one_round, see
from consat.engine.violations import violated
from consat.numerics import quick_compilation, thorough_compilation
from consat.protocols import Rounds

if TYPE_CHECKING:
    from consat.engine.ways import Ways

CHUNK = 10
"""Rounds between two looks at the stop rule and the progress bar."""
LARGE = 200_000
"""Of more agents than these the rounds take longer than their program takes to compile well."""
SURE = 3
"""For so many rounds on end all must know what ends a run: what they have heard of the others' margins is some rounds old."""
NEVER = 2**62
"""More rounds than there are."""
SCALARS = ("margin", "smooth_margin", "known", "bound", "messages", "floats", "bytes")
"""Of what is seen of a round, the numbers that every chunk tells."""


class Kept(NamedTuple):
    """What is recorded of a round, or with a leading axis of several.

    Attributes:
        position: (R, d).
        agent_margin: (R,).
        estimate: (E, d), of no copies where none are recorded.
        heading: (R,) rad; (0,) where bodies have none.
    """

    position: Any
    agent_margin: Any
    estimate: Any
    heading: Any


class Chunk(NamedTuple):
    """What is seen of up to `CHUNK` rounds.

    Attributes:
        done: how many.
        margin: (CHUNK,) β̄ after each.
        smooth_margin: (CHUNK,).
        known: (CHUNK,) what everybody knew; see `consat.engine.round.knowledge`.
        bound: (CHUNK,) on the best margin, proven by all; NaN where none is.
        near: for how many rounds everybody has known what ends the run.
        messages: (CHUNK,) sent.
        floats: (CHUNK,) sent.
        bytes: (CHUNK,) sent.
        drift: how far any position was, on any axis, from where it was before; not finite if a position is not.
        violated: (W,) after how many of them each watched constraint was violated; None where nobody counts.
        kept: of every so manieth round, with a leading axis; what stands beyond these means nothing.
    """

    done: Any
    margin: Any
    smooth_margin: Any
    known: Any
    bound: Any
    near: Any
    messages: Any
    floats: Any
    bytes: Any
    drift: Any
    violated: Any
    kept: Kept


class Engine(Protocol):
    """Who carries out the rounds: this process, or several."""

    world: World
    """What does not change, of this process's agents."""

    def start(self) -> tuple[Any, Chunk]:
        """The state before the first round, and what is seen of it."""
        ...

    def advance(self, state: Any, number: int, count: int, streak: tuple[int, int] | None, every: int) -> tuple[Any, Chunk]:
        """Some rounds.

        Args:
            state: given up.
            number: of the first of them.
            count: how many.
            streak: for how many rounds every margin has been positive, and for how many all have known what ends the run; the rounds end
                when either are enough, if that ends the run. None while nothing does.
            every: each how manieth round to keep.
        """
        ...

    def positions(self, state: Any) -> np.ndarray:
        """(N, d) everyone's positions."""
        ...

    def look(self, state: Any, number: int) -> Kept:
        """What is recorded of the state as it is, after so many rounds."""
        ...

    def agree(self, stop: bool) -> bool:
        """Whether any process wants to stop."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chosen:
    """Who is recorded, and what is watched.

    Attributes:
        agents: (R,), or None for all in order.
        copies: (E,).
        watched: (W,) constraints.
    """

    agents: Array | None
    copies: Array
    watched: Array

    @classmethod
    def of(cls, choice: Choice) -> Chosen:
        agents = None if choice.everyone else jnp.asarray(choice.agents)
        copies = np.zeros(0, dtype=np.int32) if choice.copies is None else choice.copies.astype(np.int32)
        return cls(agents, jnp.asarray(copies), jnp.asarray(choice.watched))

    def of_seen(self, seen: Seen) -> Kept:
        position, margin = (values if self.agents is None else values[self.agents] for values in (seen.position, seen.agent_margin))
        heading = seen.heading if self.agents is None or not len(seen.heading) else seen.heading[self.agents]
        return Kept(position, margin, seen.estimate[self.copies], heading)


class _Loop(NamedTuple):
    done: Array
    now: Now
    streak: Array
    told: Array
    places: Array
    chunk: Chunk


def start(protocol: Rounds, world: World, chosen: Chosen, first: Array, key: Array) -> tuple[Now, Chunk]:
    """See `Engine.start`."""
    now, seen = begin(protocol, world, first, key)
    kept = Kept(*(jnp.expand_dims(leaf, 0) for leaf in chosen.of_seen(seen)))
    scalars = {name: getattr(seen, name)[None] for name in SCALARS}
    count = violated(world.observer, chosen.watched, now.body).astype(jnp.asarray(0).dtype)
    return now, Chunk(
        jnp.asarray(1), **scalars, near=jnp.asarray(0), drift=jnp.max(jnp.abs(now.body), initial=0.0), violated=count, kept=kept
    )


class Ask(NamedTuple):
    """Of the arguments of `Engine.advance` the numbers; `hold`: how many satisfied rounds on end end the run, if all know it by then, and
    `most`: how many at the latest; and `knowing`: what all must know, for `SURE` rounds on end, to end it, as bits; see
    `consat.engine.round.knowledge`."""

    number: Array
    rounds: Array
    streak: Array
    every: Array
    hold: Array
    most: Array
    near: Array
    knowing: Array


def advance(protocol: Rounds, world: World, chosen: Chosen, capacity: int, now: Now, ask: Ask) -> tuple[Now, Chunk]:
    """Rounds until there are so many, or enough on end are satisfied; what is kept of them goes into buffers of `capacity`."""
    anchor = now.body
    real, whole = now.body.dtype, jnp.asarray(0).dtype
    d = now.body.shape[1]
    recorded = len(now.body) if chosen.agents is None else len(chosen.agents)
    empty = Chunk(
        done=jnp.zeros_like(ask.rounds),
        margin=jnp.zeros(CHUNK, real),
        smooth_margin=jnp.zeros(CHUNK, real),
        known=jnp.zeros(CHUNK, whole),
        bound=jnp.zeros(CHUNK, real),
        near=ask.near,
        messages=jnp.zeros(CHUNK, whole),
        floats=jnp.zeros(CHUNK, whole),
        bytes=jnp.zeros(CHUNK, whole),
        drift=jnp.zeros((), real),
        violated=jnp.zeros(len(chosen.watched), whole),
        kept=Kept(
            jnp.zeros((capacity, recorded, d), real),
            jnp.zeros((capacity, recorded), real),
            jnp.zeros((capacity, len(chosen.copies), d), real),
            jnp.zeros((capacity, recorded if now.robots is not None else 0), real),
        ),
    )

    def step(at: _Loop) -> _Loop:
        number = ask.number + at.done
        here = world.at(number.astype(real) + 1.0)  # an agent's own constraints are those of the time for which it moves
        now, seen, keep = _one(protocol, here, chosen, at.now, number)
        chunk = at.chunk
        drift = jnp.maximum(chunk.drift, jnp.max(jnp.abs(now.body - anchor), initial=0.0))
        numbers = {
            name: jax.lax.dynamic_update_index_in_dim(getattr(chunk, name), value, at.done, 0)
            for name, value in zip(SCALARS, seen, strict=True)
        }
        count = chunk.violated + violated(here.observer, chosen.watched, now.body).astype(whole)
        # what is not to be kept is overwritten by the next
        kept = jax.tree.map(lambda buffer, value: jax.lax.dynamic_update_index_in_dim(buffer, value, at.places, 0), chunk.kept, keep)
        places = jnp.where((number + 1) % ask.every == 0, at.places + 1, at.places)
        streak = jnp.where(seen[0] > 0, at.streak + 1, 0)
        known = seen[SCALARS.index("known")]
        near = jnp.where(known & ask.knowing > 0, chunk.near + 1, 0)
        told = known & SATISFIED > 0
        return _Loop(
            at.done + 1, now, streak, told, places, Chunk(at.done + 1, **numbers, near=near, drift=drift, violated=count, kept=kept)
        )

    def goes_on(at: _Loop) -> Array:
        satisfied = (at.streak >= ask.hold) & (at.told | (at.streak >= ask.most))
        return (at.done < ask.rounds) & ~satisfied & (at.chunk.near < SURE)

    end = jax.lax.while_loop(goes_on, step, _Loop(empty.done, now, ask.streak, jnp.asarray(False), empty.done, empty))
    return end.now, end.chunk


def _one(protocol: Rounds, world: World, chosen: Chosen, now: Now, number: Array) -> tuple[Now, tuple[Array, ...], Kept]:
    now, seen = one_round(protocol, world, now, number.astype(float))
    return now, tuple(getattr(seen, name) for name in SCALARS), chosen.of_seen(seen)


def _look(world: World, chosen: Chosen, now: Now, number: Array) -> Kept:
    nothing = jnp.asarray(0)
    return chosen.of_seen(see(world.at(number), now, (nothing, nothing), Sent(nothing, nothing, nothing)))


@functools.cache
def _compiled(large: bool) -> tuple[Callable[..., tuple[Now, Chunk]], Callable[..., tuple[Now, Chunk]], Callable[..., Kept]]:
    options = thorough_compilation() if large else quick_compilation()
    return (
        jax.jit(start, static_argnames=("protocol",), compiler_options=options),
        jax.jit(advance, static_argnames=("protocol", "capacity"), donate_argnames=("now",), compiler_options=options),
        jax.jit(_look, compiler_options=options),
    )


class OneProcess:
    """All rounds in this process.

    Args:
        protocol: what the agents do.
        world: what does not change.
        first: (C, d) first estimates.
        seed: of what goes wrong.
        choice: what is recorded.
        hold: how many satisfied rounds on end are the end, at the earliest and at the latest; None if nothing of the kind is.
        knowing: what all must know for the end; see `Ask`.
    """

    def __init__(
        self, protocol: Rounds, world: World, first: np.ndarray, seed: int, choice: Choice, hold: tuple[int, int] | None, *,
        knowing: int = 0,
    ) -> None:  # fmt: skip
        self._first, self._seed, self._hold, self._knowing = first, seed, hold, knowing
        self._large = world.everyone.agents > LARGE
        self._protocol, self.world, self._chosen = protocol, world, Chosen.of(choice)
        self._capacity = -(-CHUNK // choice.every) + 1
        self._ways: Ways | None = None
        if world.drive is not None and world.drive.map.count:
            from consat.engine.ways import Ways

            self._ways = Ways(world.drive, CHUNK)

    def start(self) -> tuple[Now, Chunk]:
        first, key = jnp.asarray(self._first), jax.random.key(self._seed)
        return _compiled(self._large)[0](self._protocol, self.world, self._chosen, first, key)

    def advance(self, state: Now, number: int, count: int, streak: tuple[int, int] | None, every: int) -> tuple[Now, Chunk]:
        if self._ways is not None and state.robots is not None:
            targets = np.asarray(state.state.x)[np.asarray(self.world.own)]
            state = state._replace(robots=self._ways.planned(state.robots, np.asarray(state.body), targets))
        hold, most = (NEVER, NEVER) if self._hold is None or streak is None else self._hold
        knowing = 0 if streak is None else self._knowing
        satisfied, near = streak or (0, 0)
        ask = Ask(*(jnp.asarray(value) for value in (number, count, satisfied, every, hold, most, near, knowing)))
        return _compiled(self._large)[1](self._protocol, self.world, self._chosen, self._capacity, state, ask)

    def positions(self, state: Now) -> np.ndarray:
        return np.array(state.body)

    def agree(self, stop: bool) -> bool:
        return stop

    def look(self, state: Now, number: int) -> Kept:
        kept = _compiled(self._large)[2](self.world, self._chosen, state, jnp.asarray(float(number)))
        return Kept(*map(np.array, kept))

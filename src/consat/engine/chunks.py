"""Engine that computes rounds in chunks: one compiled loop on the device, without Python between two rounds."""

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
from consat.engine.round import SATISFIED, Now, Seen, Sent, begin, one_round, see
from consat.engine.violations import violated
from consat.engine.world import World
from consat.numerics import on_device, quick_compilation, thorough_compilation
from consat.problem.objective import Objective
from consat.protocols import Rounds

if TYPE_CHECKING:
    from consat.engine.ways import Ways

CHUNK = 10
"""Number of rounds between two checks of the stop rules and updates of the progress bar."""
LARGE = 200_000
"""Number of agents above which the program is compiled with full optimization, because the rounds then take longer than the compiler."""
SURE = 3
"""Number of consecutive rounds for which all agents must know the result that ends a run, because received margins are some rounds old."""
NEVER = 2**62
"""A number of rounds that is never reached."""
SCALARS = ("margin", "smooth_margin", "known", "bound", "messages", "floats", "bytes")
"""Fields of `Seen` that every chunk reports for each round."""
REALS = ("margin", "smooth_margin", "bound")
"""Those of them that are not integers."""


class Kept(NamedTuple):
    """Record of one round; of several rounds with a leading axis.

    Attributes:
        position: (R, d) positions of the recorded agents.
        agent_margin: (R,) their margins.
        estimate: (E, d) recorded estimates; E = 0 without any.
        heading: (R,) headings, rad; (0,) for bodies without a heading.
    """

    position: Any
    agent_margin: Any
    estimate: Any
    heading: Any


class Chunk(NamedTuple):
    """Result of up to `CHUNK` rounds.

    Attributes:
        done: () number of rounds.
        margin: (CHUNK,) team margin β̄ after each round.
        smooth_margin: (CHUNK,) smooth margin after each round.
        known: (CHUNK,) what all agents know, as bits; see `consat.engine.round.knowledge`.
        bound: (CHUNK,) upper bound on the best margin that all agents have proven; NaN without one.
        near: () number of consecutive rounds for which all agents have known the result that ends the run.
        messages: (CHUNK,) number of messages sent.
        floats: (CHUNK,) number of floats sent.
        bytes: (CHUNK,) number of bytes sent.
        drift: () largest distance of a position, on any axis, from its value before the chunk; not finite if a position is not.
        violated: (W,) number of rounds after which each watched constraint was violated; None if not counted.
        kept: the recorded rounds, with a leading axis; entries beyond their number are meaningless.
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
    """Computes the rounds of a run, in this process or in several."""

    world: World
    """Data of this process's agents that is constant during a run."""

    def start(self) -> tuple[Any, Chunk]:
        """The state before the first round, and a chunk with that state alone."""
        ...

    def advance(self, state: Any, number: int, count: int, streak: tuple[int, int] | None, every: int) -> tuple[Any, Chunk]:
        """Advance `state` by up to `count` rounds.

        Args:
            state: the state. Its buffers are donated and must not be used again.
            number: number of the first round.
            count: largest number of rounds.
            streak: number of consecutive rounds for which every margin has been positive, and for which all agents have known the result
                that ends the run. The rounds end early when one of them is large enough. None disables this.
            every: record one round in `every`.
        """
        ...

    def positions(self, state: Any) -> np.ndarray:
        """(N, d) positions of all agents."""
        ...

    def look(self, state: Any, number: int) -> Kept:
        """Record of the state after `number` rounds."""
        ...

    def agree(self, stop: bool) -> bool:
        """Whether any process wants to stop. `stop`: whether this one does."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chosen:
    """`consat.engine.recording.Choice` on the device.

    Attributes:
        agents: (R,) recorded agents; None for all.
        copies: (E,) recorded rows.
        watched: (W,) constraints whose violations are counted.
    """

    agents: Array | None
    copies: Array
    watched: Array

    @classmethod
    def of(cls, choice: Choice) -> Chosen:
        agents = None if choice.everyone else on_device(choice.agents)
        copies = np.zeros(0, dtype=np.int32) if choice.copies is None else choice.copies.astype(np.int32)
        return cls(agents, on_device(copies), on_device(choice.watched))

    def of_seen(self, seen: Seen) -> Kept:
        position, margin = (values if self.agents is None else values[self.agents] for values in (seen.position, seen.agent_margin))
        heading = seen.heading if self.agents is None or not len(seen.heading) else seen.heading[self.agents]
        return Kept(position, margin, seen.estimate[self.copies], heading)


class _Loop(NamedTuple):
    """Carry of the loop over rounds. `places`: number of recorded rounds; `all_know`: whether all agents know that all are satisfied."""

    done: Array
    now: Now
    streak: Array
    all_know: Array
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
    """Scalar arguments of `advance`.

    Attributes:
        number: number of the first round.
        rounds: largest number of rounds.
        streak: consecutive satisfied rounds before this chunk.
        every: record one round in `every`.
        hold: consecutive satisfied rounds that end the run, if all agents know by then that all are satisfied.
        most: consecutive satisfied rounds that end the run in any case.
        near: consecutive rounds before this chunk for which all agents have known the result that ends the run.
        knowing: results that end the run when all agents know one of them for `SURE` rounds; bits of `consat.engine.round.knowledge`.
    """

    number: Array
    rounds: Array
    streak: Array
    every: Array
    hold: Array
    most: Array
    near: Array
    knowing: Array


def advance(protocol: Rounds, world: World, chosen: Chosen, capacity: int, now: Now, ask: Ask) -> tuple[Now, Chunk]:
    """Compute rounds until `ask.rounds` are done or a stop rule holds.

    Args:
        protocol: the protocol.
        world: constant data of the run.
        chosen: what is recorded.
        capacity: number of rounds in the buffers of the record.
        now: the state. Its buffers are donated and must not be used again.
        ask: scalar arguments.
    """
    anchor = now.body
    real, whole = now.body.dtype, jnp.asarray(0).dtype
    d = now.body.shape[1]
    recorded = len(now.body) if chosen.agents is None else len(chosen.agents)
    empty = Chunk(
        **{name: jnp.zeros(CHUNK, real if name in REALS else whole) for name in SCALARS},
        done=jnp.zeros_like(ask.rounds),
        near=ask.near,
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
        here = world.at(number.astype(real) + 1.0)  # constraints at the end of the round
        now, seen, keep = _one(protocol, here, chosen, at.now, number)
        chunk = at.chunk
        drift = jnp.maximum(chunk.drift, jnp.max(jnp.abs(now.body - anchor), initial=0.0))
        numbers = {
            name: jax.lax.dynamic_update_index_in_dim(getattr(chunk, name), value, at.done, 0)
            for name, value in zip(SCALARS, seen, strict=True)
        }
        count = chunk.violated + violated(here.observer, chosen.watched, now.body).astype(whole)
        # a round that is not recorded is overwritten by the next one
        kept = jax.tree.map(lambda buffer, value: jax.lax.dynamic_update_index_in_dim(buffer, value, at.places, 0), chunk.kept, keep)
        places = jnp.where((number + 1) % ask.every == 0, at.places + 1, at.places)
        streak = jnp.where(seen[0] > 0, at.streak + 1, 0)
        known = seen[SCALARS.index("known")]
        near = jnp.where(known & ask.knowing > 0, chunk.near + 1, 0)
        all_know = known & SATISFIED > 0
        return _Loop(
            at.done + 1, now, streak, all_know, places, Chunk(at.done + 1, **numbers, near=near, drift=drift, violated=count, kept=kept)
        )

    def goes_on(at: _Loop) -> Array:
        satisfied = (at.streak >= ask.hold) & (at.all_know | (at.streak >= ask.most))
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
    """`Engine` that computes all agents in this process.

    Args:
        protocol: the protocol.
        world: constant data of the run.
        first: (C, d) initial estimates.
        seed: random seed of message loss and faults.
        choice: what is recorded.
        hold: `Ask.hold` and `Ask.most`; None if satisfied rounds do not end the run.
        knowing: see `Ask`.
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
        first, key = on_device(self._first), jax.random.key(self._seed)
        return _compiled(self._large)[0](self._protocol, self.world, self._chosen, first, key)

    def advance(self, state: Now, number: int, count: int, streak: tuple[int, int] | None, every: int) -> tuple[Now, Chunk]:
        if self._ways is not None and state.robots is not None:
            targets = np.asarray(state.state.x)[np.asarray(self.world.own)]
            state = state._replace(robots=self._ways.planned(state.robots, np.asarray(state.body), targets))
        hold, most = (NEVER, NEVER) if self._hold is None or streak is None else self._hold
        knowing = 0 if streak is None else self._knowing
        satisfied, near = streak or (0, 0)
        asked = (number, count, satisfied, every, hold, most, near, knowing)
        ask = Ask(*map(np.asarray, asked))  # type: ignore[arg-type]  # numpy arrays are transferred with the call
        return _compiled(self._large)[1](self._protocol, self.world, self._chosen, self._capacity, state, ask)

    def positions(self, state: Now) -> np.ndarray:
        return np.array(state.body)

    def margins(self, state: Now, number: int) -> np.ndarray:
        """(N,) margins of the agents where their bodies are, in round `number`."""
        return np.asarray(_agent_margins(self.world, state, float(number)))

    def agree(self, stop: bool) -> bool:
        return stop

    def look(self, state: Now, number: int) -> Kept:
        kept = _compiled(self._large)[2](self.world, self._chosen, state, on_device(float(number)))
        return Kept(*map(np.array, kept))


@jax.jit
def _agent_margins(world: World, now: Now, round_: Any) -> Any:
    observer: Objective = world.at(on_device(round_)).observer
    return observer.agent_margins(now.body)

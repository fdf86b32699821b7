"""Protocols in rounds: the outer loop, what is recorded of it, and when it ends."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.estimates import Estimates
from consat.numerics import CompileClock, float64, quick_compilation
from consat.objective import Nu
from consat.protocols import Rounds
from consat.scale import Scale
from consat.simulate import Stop
from consat.simulate.checkpoint import Checkpoint, fingerprint
from consat.simulate.interruption import heeded
from consat.simulate.kernel import Body, Now, Seen, Weather, World, begin, one_round, see, world_of
from consat.simulate.recording import Choice, Memory, Rows, Sink, told, velocities
from consat.team import Team
from consat.trace import Ending, Trace

HOLD = 10
"""How many rounds on end every margin must stay positive before a team counts as satisfied."""
PATIENCE = 2000
"""How many rounds a team may take when nobody says."""
CHUNK = 10
"""Rounds between two looks at the stop rule and the progress bar."""
PATIENT = 1.5
"""Whether a team that stands still has no hope is asked again only when the run is so many times as long: the answer takes its time."""
LARGE = 200_000
"""Of more agents than these the rounds take longer than their program takes to compile well."""
NEVER = 2**62
"""More rounds than there are."""
SETTLED = 1e-5
"""A team has settled when over a chunk no position moved by more than this fraction of the team's unit of length, …"""
SETTLED_ALL_THE_SAME = 1e-7
"""… or than this, where a certificate should say when it is `enough`."""


class Kept(NamedTuple):
    """What is recorded of a round, or with a leading axis of several.

    Attributes:
        position: (R, d).
        agent_margin: (R,).
        estimate: (E, d), of no copies where none are recorded.
    """

    position: Any
    agent_margin: Any
    estimate: Any


class Chunk(NamedTuple):
    """What is seen of up to `CHUNK` rounds.

    Attributes:
        done: how many.
        margin: (CHUNK,) β̄ after each.
        smooth_margin: (CHUNK,).
        known: (CHUNK,) whether everybody knew that all were satisfied.
        messages: (CHUNK,) sent.
        floats: (CHUNK,) sent.
        drift: how far any position was, on any axis, from where it was before; not finite if a position is not.
        kept: of every so manieth round, with a leading axis; what stands beyond these means nothing.
    """

    done: Any
    margin: Any
    smooth_margin: Any
    known: Any
    messages: Any
    floats: Any
    drift: Any
    kept: Kept


class Engine(Protocol):
    """Who carries out the rounds: this process, or several."""

    def start(self) -> tuple[Any, Chunk]:
        """The state before the first round, and what is seen of it."""
        ...

    def advance(self, state: Any, number: int, count: int, streak: int, every: int) -> tuple[Any, Chunk]:
        """Some rounds.

        Args:
            state: given up.
            number: of the first of them.
            count: how many.
            streak: for how many rounds every margin has been positive; the rounds end when it reaches `HOLD`, if that ends the run.
            every: each how manieth round to keep.
        """
        ...

    def positions(self, state: Any) -> np.ndarray:
        """(N, d) everyone's positions."""
        ...

    def look(self, state: Any) -> Kept:
        """What is recorded of the state as it is."""
        ...

    def agree(self, stop: bool) -> bool:
        """Whether any process wants to stop."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chosen:
    """Who is recorded.

    Attributes:
        agents: (R,), or None for all in order.
        copies: (E,).
    """

    agents: Array | None
    copies: Array

    @classmethod
    def of(cls, choice: Choice) -> Chosen:
        agents = None if choice.everyone else jnp.asarray(choice.agents)
        return cls(agents, jnp.asarray(np.zeros(0, dtype=np.int32) if choice.copies is None else choice.copies.astype(np.int32)))

    def of_seen(self, seen: Seen) -> Kept:
        position, margin = (values if self.agents is None else values[self.agents] for values in (seen.position, seen.agent_margin))
        return Kept(position, margin, seen.estimate[self.copies])


class _Loop(NamedTuple):
    done: Array
    now: Now
    streak: Array
    places: Array
    chunk: Chunk


def start(protocol: Rounds, world: World, chosen: Chosen, first: Array, key: Array) -> tuple[Now, Chunk]:
    """See `Engine.start`."""
    now, seen = begin(protocol, world, first, key)
    kept = Kept(*(jnp.expand_dims(leaf, 0) for leaf in chosen.of_seen(seen)))
    scalars = {name: getattr(seen, name)[None] for name in SCALARS}
    return now, Chunk(jnp.asarray(1), **scalars, drift=jnp.max(jnp.abs(now.body), initial=0.0), kept=kept)


SCALARS = ("margin", "smooth_margin", "known", "messages", "floats")


class Ask(NamedTuple):
    """Of the arguments of `Engine.advance` the numbers, and `hold`: how many satisfied rounds on end end the run."""

    number: Array
    rounds: Array
    streak: Array
    every: Array
    hold: Array


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
        known=jnp.zeros(CHUNK, bool),
        messages=jnp.zeros(CHUNK, whole),
        floats=jnp.zeros(CHUNK, whole),
        drift=jnp.zeros((), real),
        kept=Kept(
            jnp.zeros((capacity, recorded, d), real),
            jnp.zeros((capacity, recorded), real),
            jnp.zeros((capacity, len(chosen.copies), d), real),
        ),
    )

    def step(at: _Loop) -> _Loop:
        now, seen, keep = _one(protocol, world, chosen, at.now, ask.number + at.done)
        chunk = at.chunk
        drift = jnp.maximum(chunk.drift, jnp.max(jnp.abs(now.body - anchor), initial=0.0))
        numbers = {
            name: jax.lax.dynamic_update_index_in_dim(getattr(chunk, name), value, at.done, 0)
            for name, value in zip(SCALARS, seen, strict=True)
        }
        # what is not to be kept is overwritten by the next
        kept = jax.tree.map(lambda buffer, value: jax.lax.dynamic_update_index_in_dim(buffer, value, at.places, 0), chunk.kept, keep)
        places = jnp.where((ask.number + at.done + 1) % ask.every == 0, at.places + 1, at.places)
        streak = jnp.where(seen[0] > 0, at.streak + 1, 0)
        return _Loop(at.done + 1, now, streak, places, Chunk(at.done + 1, **numbers, drift=drift, kept=kept))

    def goes_on(at: _Loop) -> Array:
        return (at.done < ask.rounds) & (at.streak < ask.hold)

    end = jax.lax.while_loop(goes_on, step, _Loop(empty.done, now, ask.streak, empty.done, empty))
    return end.now, end.chunk


def _one(protocol: Rounds, world: World, chosen: Chosen, now: Now, number: Array) -> tuple[Now, tuple[Array, ...], Kept]:
    now, seen = one_round(protocol, world, now, number.astype(float))
    return now, tuple(getattr(seen, name) for name in SCALARS), chosen.of_seen(seen)


def _look(world: World, chosen: Chosen, now: Now) -> Kept:
    nothing = jnp.asarray(0)
    return chosen.of_seen(see(world, now.state.x, now.body, nothing, nothing, nothing))


@functools.cache
def _compiled(large: bool) -> tuple[Callable[..., tuple[Now, Chunk]], Callable[..., tuple[Now, Chunk]], Callable[..., Kept]]:
    options = None if large else quick_compilation()
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
        hold: how many satisfied rounds on end are the end; None if nothing of the kind is.
    """

    def __init__(self, protocol: Rounds, world: World, first: np.ndarray, seed: int, choice: Choice, hold: int | None) -> None:
        self._first, self._seed, self._hold = first, seed, hold
        self._large = world.everyone.agents > LARGE
        self._protocol, self._world, self._chosen = protocol, world, Chosen.of(choice)
        self._capacity = -(-CHUNK // choice.every) + 1

    def start(self) -> tuple[Now, Chunk]:
        first, key = jnp.asarray(self._first), jax.random.key(self._seed)
        return _compiled(self._large)[0](self._protocol, self._world, self._chosen, first, key)

    def advance(self, state: Now, number: int, count: int, streak: int, every: int) -> tuple[Now, Chunk]:
        hold = NEVER if self._hold is None else self._hold
        ask = Ask(*(jnp.asarray(value) for value in (number, count, streak, every, hold)))
        return _compiled(self._large)[1](self._protocol, self._world, self._chosen, self._capacity, state, ask)

    def positions(self, state: Now) -> np.ndarray:
        return np.array(state.body)

    def agree(self, stop: bool) -> bool:
        return stop

    def look(self, state: Now) -> Kept:
        kept = _compiled(self._large)[2](self._world, self._chosen, state)
        return Kept(*map(np.array, kept))


@dataclass
class Tally:
    """What is counted as the rounds go by; plain numbers, which a checkpoint holds.

    Attributes:
        done: rounds.
        streak: for how many rounds every margin has been positive.
        last_bad: the last round whose margin was ≤ 0, or −1.
        last_unknown: the last round after which not everybody knew, or −1.
        messages: sent.
        floats: sent.
        margin: the last.
        smooth_margin: the last.
        drift: of the last chunk.
        asked: the round at which it was last asked whether there is hope.
        recorded: steps in the record.
        every: each how manieth round is recorded.
    """

    done: int = -1
    streak: int = 0
    last_bad: int = -1
    last_unknown: int = -1
    messages: int = 0
    floats: int = 0
    margin: float = np.nan
    smooth_margin: float = np.nan
    drift: float = np.inf
    asked: int = 0
    recorded: int = 0
    every: int = 1

    def add(self, chunk: Chunk) -> np.ndarray:
        """Count some rounds; gives their numbers."""
        count = int(chunk.done)
        numbers = np.arange(self.done + 1, self.done + 1 + count)
        margin, known = np.asarray(chunk.margin)[:count], np.asarray(chunk.known)[:count]
        bad, unknown = np.flatnonzero(~(margin > 0)), np.flatnonzero(~known)
        self.streak = self.streak + count if not len(bad) else count - 1 - int(bad[-1])
        self.last_bad = int(numbers[bad[-1]]) if len(bad) else self.last_bad
        self.last_unknown = int(numbers[unknown[-1]]) if len(unknown) else self.last_unknown
        self.messages += int(np.sum(np.asarray(chunk.messages)[:count]))
        self.floats += int(np.sum(np.asarray(chunk.floats)[:count]))
        self.done += count
        self.margin, self.smooth_margin = float(margin[-1]), float(chunk.smooth_margin[count - 1])
        self.drift = float(chunk.drift) if count == CHUNK or not np.isfinite(chunk.drift) else np.inf
        return numbers


def stillness(length: float, enough: Callable[[np.ndarray], bool] | None) -> float:
    """A chunk in which no position moved farther is one in which the team stood still; length: the team's unit."""
    return (SETTLED if enough is None else SETTLED_ALL_THE_SAME) * length


@float64
def simulate_rounds(
    team: Team,
    protocol: Rounds,
    copies: Estimates,
    nu: Nu,
    size: Scale,
    first: np.ndarray,
    *,
    convex: bool,
    rounds: int | None = None,
    stop: Stop = "satisfied",
    weather: Weather | None = None,
    body: Body | None = None,
    record: bool | None = None,
    choice: Choice | None = None,
    sink: Sink | None = None,
    checkpoint: Checkpoint | None = None,
    hopeless: Callable[[np.ndarray], bool] = lambda _: False,
    enough: Callable[[np.ndarray], bool] | None = None,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Trace:
    """Run a protocol in rounds.

    Args:
        team: whose clusters are connected.
        protocol: what they do.
        copies: the layout of estimates.
        nu: the smoothing.
        size: the team's natural size.
        first: (C, d) first estimates, with x_i^(i)(0) = x_i(0).
        convex: whether every ψ is known to be concave.
        rounds: how many; `PATIENCE` if None.
        stop: when to end earlier: every margin positive for `HOLD` rounds (or `hopeless` and settled); settled, or `enough`; or never.
        weather: loss and sleep; none if None.
        body: how fast positions follow estimates; at once if None.
        record: whether to keep all estimates; if None, while they are few.
        choice: what to record; if None, what the size of the team suggests.
        sink: where to; in memory if None.
        checkpoint: where to keep the state, and what to take up; nowhere and nothing if None.
        hopeless: says of (N, d) positions whether they prove that no formation satisfies every constraint.
        enough: says of (N, d) positions whether no formation is better by more than a tolerance.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    weather = weather or Weather()
    choice = choice or Choice.of(team, copies, estimates=record)
    hold = stop == "satisfied"
    if jax.process_count() > 1:
        from consat.simulate.cluster import ManyProcesses

        together = ManyProcesses(
            team, protocol, copies, nu, size, first, convex=convex, weather=weather, body=body, choice=choice, hold=hold
        )
        engine, everyone = cast(Engine, together), together.world.everyone
    else:
        world = world_of(team, copies, nu, size, convex=convex, weather=weather, body=body)
        engine, everyone = OneProcess(protocol, world, first, weather.seed, choice, HOLD if hold else None), world.everyone
    rules = Rules(
        end=PATIENCE if rounds is None else rounds, stop=stop, still=stillness(size.length, enough),
        earliest=protocol.earliest(everyone),
        hopeless=hopeless, enough=enough,
    )  # fmt: skip
    problem = "" if checkpoint is None else fingerprint(team, protocol, nu, size, first, weather, body, copies.layout, convex)
    return conduct(
        engine,
        rules,
        copies,
        choice,
        sink=sink or Memory(choice.every),
        checkpoint=checkpoint,
        problem=problem,
        body=body,
        progress=progress,
    )


@dataclass(frozen=True)
class Rules:
    """When a run ends; see `simulate_rounds`.

    Attributes:
        end: rounds at most.
        stop: when to end earlier.
        still: a chunk in which no position moved farther is one in which the team stood still, length.
        earliest: the round before which to stand still means nothing.
        hopeless: see `simulate_rounds`.
        enough: see `simulate_rounds`.
    """

    end: int
    stop: Stop
    still: float
    earliest: int = 0
    hopeless: Callable[[np.ndarray], bool] = lambda _: False
    enough: Callable[[np.ndarray], bool] | None = None

    def ending(self, tally: Tally, positions: Callable[[], np.ndarray]) -> Ending | None:
        """Why the run should end now, or None."""
        if np.isnan(tally.drift) or (tally.drift == np.inf and not np.isfinite(positions()).all()):
            return "diverged"
        if self.stop == "never":
            return None
        if self.stop == "satisfied" and tally.streak >= HOLD:
            return "satisfied"
        if self.stop == "converged" and self.enough is not None and self.enough(positions()):
            return "settled"
        if tally.done < self.earliest or tally.drift > self.still:
            return None
        if self.stop == "converged":
            return "settled"
        if tally.done < PATIENT * tally.asked:
            return None
        tally.asked = tally.done
        return "settled" if self.hopeless(positions()) else None


def conduct(
    engine: Engine, rules: Rules, copies: Estimates, choice: Choice, *, sink: Sink, checkpoint: Checkpoint | None, problem: str,
    body: Body | None, progress: Callable[[float, float], None],
) -> Trace:  # fmt: skip
    """The loop around the rounds.

    Args:
        engine: who carries them out.
        rules: when they end.
        copies: the layout of estimates.
        choice: what is recorded.
        sink: where to.
        checkpoint: where the state is kept.
        problem: its fingerprint.
        body: see `simulate_rounds`.
        progress: see `simulate_rounds`.
    """
    ending: Ending = "out of time"
    tally = Tally(every=choice.every)
    with CompileClock() as clock, heeded() as stopped:
        state, chunk = engine.start()
        taken = None if checkpoint is None else checkpoint.restore(state, problem)
        if taken is None:
            _record(sink, choice, tally, chunk)
        else:
            state, tally = taken[0], Tally(**taken[1])
            sink.every = tally.every

        def save() -> None:
            if checkpoint is not None:
                sink.flush()
                checkpoint.write(state, tally.__dict__, problem)

        while tally.done < rules.end:
            count = min(CHUNK, rules.end - tally.done)
            state, chunk = engine.advance(state, tally.done, count, tally.streak, sink.every)
            _record(sink, choice, tally, chunk)
            found = rules.ending(tally, functools.partial(engine.positions, state))
            if engine.agree(not told(progress, tally.done / rules.end, tally.margin) or stopped()) and found is None:
                found = "interrupted"
            if found is not None:
                ending = found
                break
            if checkpoint is not None and checkpoint.due():
                save()
        save()
    if tally.done % sink.every:  # the last round is always recorded
        kept = engine.look(state)
        _append(
            sink, choice, np.array([tally.done]), np.array([tally.margin]), np.array([tally.smooth_margin]), Kept(*(k[None] for k in kept))
        )
    rows = sink.close()
    dt = 1.0 if body is None else 1.0 / body.rate
    return Trace(
        clock="round",
        steps=rows.step,
        position=rows.position,
        velocity=velocities(rows.step, rows.position, dt),
        margin=rows.margin,
        smooth_margin=rows.smooth_margin,
        agent_margin=rows.agent_margin,
        estimate=rows.estimate,
        integral=None,
        holder=copies.holder if choice.copies is None else copies.holder[choice.copies],
        held=copies.position if choice.copies is None else copies.position[choice.copies],
        cluster=copies.cluster,
        ending=ending,
        satisfied_from=float(tally.last_bad + 1) if tally.last_bad < tally.done else None,
        messages=tally.messages,
        floats_sent=tally.floats,
        known_from=tally.last_unknown + 1 if tally.last_unknown < tally.done else None,
        seconds=clock.seconds,
        period=None if body is None else dt,
        recorded=None if choice.everyone else choice.agents,
        final=engine.positions(state),
        drift=tally.drift if tally.done >= CHUNK else np.inf,
        file=sink.path,
    )


def _record(sink: Sink, choice: Choice, tally: Tally, chunk: Chunk) -> None:
    """Count some rounds, and keep of them what is wanted."""
    every = sink.every
    numbers = tally.add(chunk)
    chosen = np.flatnonzero(numbers % every == 0)
    kept = Kept(*(np.asarray(leaf)[: len(chosen)] for leaf in chunk.kept))
    _append(sink, choice, numbers[chosen], np.asarray(chunk.margin)[chosen], np.asarray(chunk.smooth_margin)[chosen], kept)
    tally.recorded += len(chosen)
    tally.every = sink.every


def _append(sink: Sink, choice: Choice, step: np.ndarray, margin: np.ndarray, smooth_margin: np.ndarray, kept: Kept) -> None:
    estimate = None if choice.copies is None else kept.estimate
    sink.append(Rows(step, kept.position, None, margin, smooth_margin, kept.agent_margin, estimate, None))

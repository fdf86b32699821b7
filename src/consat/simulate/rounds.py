"""Protocols in rounds: everybody speaks, the messages travel (or don't), everybody hears."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat import prox
from consat.estimates import Estimates
from consat.graphs import hops
from consat.numerics import CompileClock, Groups, float64, quick_compilation
from consat.objective import Nu, Objective
from consat.protocols import Rounds, agreement
from consat.scale import Scale
from consat.simulate import Stop
from consat.team import Team
from consat.trace import Ending, Trace, satisfied_from

HOLD = 10
"""How many rounds on end every margin must stay positive before a team counts as satisfied."""
PATIENCE = 2000
"""How many rounds a team may take when nobody says."""
CHUNK = 10
"""Rounds between two looks at the stop rule and the progress bar."""
SETTLED = 1e-5
"""A team has settled when over `HOLD` rounds no position moved by more than this fraction of the team's unit of length, …"""
SETTLED_ALL_THE_SAME = 1e-7
"""… or than this, where a certificate should say when it is `enough`."""
TOLERANCE = 1e-9
"""Of every local step, relative."""
MOST_NUMBERS = 1000
"""Estimates are recorded by default while there are at most this many numbers."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ends:
    """Both ends of every link of every copy: `consat.protocols.Links` of all agents at once.

    Attributes:
        row: (E,) the copy at this end.
        other: (E,) the index of the same link's other end.
        groups: groups the ends by copy.
        degree: (C,).
        metropolis: (E,).
    """

    row: Array
    other: Array
    groups: Groups
    degree: Array
    metropolis: Array

    @classmethod
    def of(cls, copies: Estimates) -> Ends:
        receiver, sender = copies.edges.T.astype(np.int64)
        other = np.searchsorted(receiver * copies.count + sender, sender * copies.count + receiver)
        degree = np.bincount(receiver, minlength=copies.count)
        metropolis = 1.0 / (1.0 + np.maximum(degree[receiver], degree[sender]))
        return cls(
            jnp.asarray(receiver, dtype=jnp.int32),
            jnp.asarray(other, dtype=jnp.int32),
            Groups.of(receiver, copies.count),
            jnp.asarray(degree, dtype=float),
            jnp.asarray(metropolis),
        )

    def at(self, rows: Array) -> Array:
        return self.groups.spread(rows)

    def sum(self, links: Array) -> Array:
        return self.groups.sum(links)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Everyone:
    """`consat.protocols.Solver`, for all agents at once.

    Attributes:
        links: all ends.
        length: the team's unit of length.
        center: (d,) the team's middle.
        reach: how far around it the team's places are.
        batches: the agents by shape.
        nu: the smoothing.
        local: every agent's objective over its copies.
        holder: (C,) who holds each copy.
        talkers: groups the ends by agent.
        agents: N.
        hops: see `consat.graphs.hops`.
        convex: whether every ψ is known to be concave.
    """

    links: Ends
    length: Array
    center: Array
    reach: Array
    batches: tuple[prox.Bucket, ...]
    nu: Nu
    local: Objective
    holder: Array
    talkers: Groups
    agents: int = field(metadata={"static": True})
    hops: int = field(metadata={"static": True})
    convex: bool = field(metadata={"static": True})

    def recall(self, x: Array, kappa: Array) -> prox.Memory:
        return prox.recall(self.batches, self.agents, self.nu, x, kappa)

    def prox(
        self, v: Array, kappa: Array, x: Array, memory: prox.Memory, sharper: Array | float = 1.0, above: Array | float = 0.0
    ) -> tuple[Array, prox.Memory, Array]:
        nu = Nu(self.nu.alpha * sharper, self.nu.beta * sharper)
        return prox.step(self.batches, nu, v, kappa, x, memory, offset=nu.beta * above - jnp.log(sharper), tolerance=TOLERANCE)

    def nearby(self, x: Array) -> Array:
        away = (x - self.center[None, :]) / self.reach
        far = jnp.maximum(jnp.max(jnp.abs(away), axis=1, keepdims=True), 1.0)
        idle = (self.links.degree == 0) & jnp.isinf(self.to_rows(self.margin(x)))
        return jnp.where(idle[:, None], x, self.center[None, :] + self.reach * away * ((2.0 - 1.0 / far) / far))

    def margin(self, x: Array) -> Array:
        return self.local.agent_margins(x)

    def to_rows(self, numbers: Array) -> Array:
        return numbers[self.holder]

    def least(self, numbers: Array) -> Array:
        return -self.talkers.max(-numbers)


@dataclass(frozen=True)
class Weather:
    """What goes wrong on the way, seeded.

    Attributes:
        loss: probability that a message between two agents is lost, each direction by itself.
        sleep: probability that an agent skips a round: it computes and sends nothing, but hears.
        seed: of the draws.
    """

    loss: float = 0.0
    sleep: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Body:
    """A body cannot jump: p ← p + clip(x − p) to at most speed/rate a round.

    Attributes:
        rate: rounds a second, Hz.
        speed: the most that a body moves, length/s.
    """

    rate: float
    speed: float = np.inf


class Seen(NamedTuple):
    """What an observer of the whole team sees after each round; leading axis T."""

    position: Any
    margin: Any
    smooth_margin: Any
    agent_margin: Any
    estimate: Any
    known: Any
    messages: Any
    floats: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _World:
    """Everything a round needs that does not change.

    Attributes:
        everyone: the agents.
        observer: of their true positions.
        own: (N,) rows of own positions.
        talker: (E,) who speaks at each end.
        pair: (E,) the directed pair of agents that each end belongs to: a message carries all its copies.
        reach: most that a body moves in a round.
        loss: see `Weather`.
        sleep: see `Weather`.
        pairs: how many directed pairs.
        record: whether to keep the estimates.
        rough: whether messages can be lost or agents sleep.
    """

    everyone: Everyone
    observer: Objective
    own: Array
    talker: Array
    pair: Array
    reach: Array
    loss: Array
    sleep: Array
    pairs: int = field(metadata={"static": True})
    record: bool = field(metadata={"static": True})
    rough: bool = field(metadata={"static": True})


class _Now(NamedTuple):
    state: Any
    ages: agreement.Ages
    body: Array
    key: Array


def _round(protocol: Rounds, world: _World, now: _Now, round_: Array) -> tuple[_Now, Seen]:
    everyone, ends = world.everyone, world.everyone.links
    spoken, message = protocol.speak(now.state, everyone, round_, agreement.known(now.ages, everyone))
    ages, told = agreement.speak(now.ages, spoken.x, everyone)
    arrived = jnp.ones(len(ends.row), dtype=bool)
    key, sent, copies_sent = now.key, jnp.asarray(world.pairs), jnp.asarray(len(ends.row))
    if world.rough:
        key, draw_loss, draw_sleep = jax.random.split(now.key, 3)
        awake = jax.random.uniform(draw_sleep, (everyone.agents,)) >= world.sleep
        spoken = _where_awake(protocol.per, world, awake, spoken, now.state)
        ages = _where_awake({"age": "agent", "heard": "link"}, world, awake, ages, now.ages)
        goes = awake[world.talker]
        sent = jnp.sum(jax.ops.segment_max(goes.astype(int), world.pair, world.pairs))
        copies_sent = jnp.sum(goes)
        arrived = (goes & (jax.random.uniform(draw_loss, (world.pairs,)) >= world.loss)[world.pair])[ends.other]
    state = protocol.hear(spoken, jax.tree.map(lambda leaf: leaf[ends.other], message), arrived, everyone)
    ages = agreement.hear(ages, told[ends.other], arrived)
    target = state.x[world.own]
    away = target - now.body
    distance = jnp.linalg.norm(away, axis=1, keepdims=True)
    body = jnp.where(distance > world.reach, now.body + away * (world.reach / jnp.where(distance > 0, distance, 1.0)), target)
    floats = sent + copies_sent * sum(leaf.size // max(len(ends.row), 1) for leaf in jax.tree.leaves(message))
    known = jnp.all(agreement.known(ages, everyone) > 0)
    return _Now(state, ages, body, key), _see(world, state.x, body, known, sent, floats)


def _see(world: _World, x: Array, body: Array, known: Array, messages: Array, floats: Array) -> Seen:
    margins = world.observer.agent_margins(body)
    smooth = world.observer.smooth_margin(body, world.everyone.nu)
    return Seen(body, jnp.min(margins), smooth, margins, x if world.record else x[:0], known, messages, floats)


def _where_awake(per: Mapping[str, Any], world: _World, awake: Array, new: Any, old: Any) -> Any:
    """The new state of those awake, the old one of those asleep."""
    masks = {"row": awake[world.everyone.holder], "link": awake[world.talker], "agent": awake}

    def choose(per: str | Mapping[str, Any], fresh: Any, stale: Any) -> Any:
        if isinstance(per, str):
            return jax.tree.map(lambda a, b: jnp.where(masks[per].reshape(-1, *[1] * (a.ndim - 1)), a, b), fresh, stale)
        return type(fresh)(**{name: choose(kind, getattr(fresh, name), getattr(stale, name)) for name, kind in per.items()})

    return choose(per, new, old)


def _rounds(protocol: Rounds, world: _World, now: _Now, numbers: Array) -> tuple[_Now, Seen]:
    return jax.lax.scan(lambda at, number: _round(protocol, world, at, number), now, numbers)


def _begin(protocol: Rounds, world: _World, first: Array, key: Array) -> tuple[_Now, Seen]:
    start = first[world.own]
    now = _Now(protocol.start(first, world.everyone), agreement.start(first, world.everyone), start, key)
    return now, jax.tree.map(lambda leaf: leaf[None], _see(world, first, start, jnp.asarray(False), jnp.asarray(0), jnp.asarray(0)))


@functools.cache
def _compiled() -> tuple[Callable[..., tuple[_Now, Seen]], Callable[..., tuple[_Now, Seen]]]:
    begin, rounds = (
        jax.jit(function, static_argnames=("protocol",), compiler_options=quick_compilation()) for function in (_begin, _rounds)
    )
    return begin, rounds


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
        hopeless: says of (N, d) positions whether they prove that no formation satisfies every constraint.
        enough: says of (N, d) positions whether no formation is better by more than a tolerance.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    weather = weather or Weather()
    end = PATIENCE if rounds is None else rounds
    world = _world(team, copies, nu, size, convex=convex, weather=weather, body=body, record=record)
    seen: list[Seen] = []
    ending: Ending = "out of time"
    done = 0
    begin, go_on = _compiled()
    with CompileClock() as clock:
        now, looked = begin(protocol, world, jnp.asarray(first), jax.random.key(weather.seed))
        seen.append(jax.tree.map(np.asarray, looked))
        try:
            while done < end:
                count = min(CHUNK, end - done)
                now, looked = go_on(protocol, world, now, jnp.arange(done, done + count, dtype=float))
                seen.append(jax.tree.map(np.asarray, looked))
                done += count
                progress(done / end, float(seen[-1].margin[-1]))
                settle = done >= protocol.earliest(world.everyone)
                if (found := _ending(seen, stop, size.length, settle, hopeless, enough)) is not None:
                    ending = found
                    break
        except KeyboardInterrupt:
            ending = "interrupted"
    whole = Seen(*(np.concatenate([getattr(part, name) for part in seen]) for name in Seen._fields))
    if stop == "satisfied" and ending == "satisfied":
        whole = Seen(*(leaf[: _satisfied_at(whole.margin) + 1] for leaf in whole))
    return _trace(whole, world, copies, ending, body, clock.seconds)


def _world(
    team: Team, copies: Estimates, nu: Nu, size: Scale, *, convex: bool, weather: Weather, body: Body | None, record: bool | None
) -> _World:
    ends = Ends.of(copies)
    everyone = Everyone(
        links=ends,
        length=jnp.asarray(size.length),
        center=jnp.asarray(size.center),
        reach=jnp.asarray(size.reach),
        batches=prox.buckets(team, copies.rows, copies.count, convex),
        nu=Nu(jnp.asarray(nu.alpha), jnp.asarray(nu.beta)),
        local=Objective.of(team, lambda family: copies.rows(family.owner[:, None], family.agents), copies.count),
        holder=jnp.asarray(copies.holder),
        talkers=Groups.of(copies.holder[copies.edges[:, 0]], team.count),
        agents=team.count,
        hops=hops(team.count, copies.links),
        convex=convex,
    )
    talker, listener = copies.holder[copies.edges].astype(np.int64).T.reshape(2, -1)
    pairs, pair = np.unique(talker * team.count + listener, return_inverse=True)
    return _World(
        everyone=everyone,
        observer=Objective.at_positions(team),
        own=jnp.asarray(copies.own),
        talker=jnp.asarray(talker, dtype=jnp.int32),
        pair=jnp.asarray(pair, dtype=jnp.int32),
        reach=jnp.asarray(np.inf if body is None else body.speed / body.rate),
        loss=jnp.asarray(weather.loss),
        sleep=jnp.asarray(weather.sleep),
        pairs=len(pairs),
        record=copies.count * team.dimension <= MOST_NUMBERS if record is None else record,
        rough=weather.loss > 0 or weather.sleep > 0,
    )


def _satisfied_at(margin: np.ndarray) -> int:
    """The round at which every margin was positive for `HOLD` rounds on end, or −1."""
    good = np.concatenate([[0], np.cumsum(margin > 0)])
    whole = np.flatnonzero(good[HOLD:] - good[:-HOLD] == HOLD)
    return int(whole[0]) + HOLD - 1 if len(whole) else -1


def _for_good(known: np.ndarray) -> int | None:
    """The round from which on everybody knew, or None."""
    unknown = np.flatnonzero(~known)
    since = int(unknown[-1]) + 1 if len(unknown) else 0
    return since if since < len(known) else None


def _ending(
    seen: list[Seen], stop: Stop, length: float, settle: bool, hopeless: Callable[[np.ndarray], bool],
    enough: Callable[[np.ndarray], bool] | None,
) -> Ending | None:  # fmt: skip
    last = seen[-1]
    if not np.isfinite(last.position).all():
        return "diverged"
    if stop == "never":
        return None
    if stop == "satisfied" and _satisfied_at(np.concatenate([part.margin for part in seen[-3:]])) >= 0:
        return "satisfied"
    if stop == "converged" and enough is not None and enough(last.position[-1]):
        return "settled"
    position = np.concatenate([part.position for part in seen[-3:]])[-HOLD:]
    still = SETTLED if enough is None else SETTLED_ALL_THE_SAME
    settled = settle and len(position) == HOLD and np.abs(position - position[-1]).max(initial=0.0) <= still * length
    return "settled" if settled and (stop == "converged" or hopeless(position[-1])) else None


def _trace(seen: Seen, world: _World, copies: Estimates, ending: Ending, body: Body | None, seconds: dict[str, float]) -> Trace:
    steps = np.arange(len(seen.margin))
    dt = 1.0 if body is None else 1.0 / body.rate
    velocity = np.diff(seen.position, axis=0, append=seen.position[-1:]) / dt
    return Trace(
        clock="round",
        steps=steps,
        position=seen.position,
        velocity=velocity,
        margin=seen.margin,
        smooth_margin=seen.smooth_margin,
        agent_margin=seen.agent_margin,
        estimate=seen.estimate if world.record else None,
        integral=None,
        holder=copies.holder,
        held=copies.position,
        cluster=copies.cluster,
        ending=ending,
        satisfied_from=satisfied_from(steps, seen.margin, interpolate=False),
        messages=int(seen.messages.sum()),
        floats_sent=int(seen.floats.sum()),
        known_from=_for_good(seen.known),
        seconds=seconds,
        period=None if body is None else dt,
    )

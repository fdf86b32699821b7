"""One round of all agents: every agent sends, messages travel or are lost, every agent receives.

`speak` and `hear` are the two halves of a round, with the transport of messages between them; `begin` is the state before the first round,
`see` what an observer of the whole team sees, and `knowledge` what all agents know.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.engine.bodies import Driven, driven, moved, started
from consat.engine.world import World
from consat.faults import Draw, draw
from consat.numerics import pick
from consat.protocols import InteriorPoint, Known, Rounds, agreement, sending
from consat.protocols.interior_point import EXACTLY, near
from consat.protocols.sending import HEADER, Crossing, Held

SATISFIED, INFEASIBLE, NEAR, BEST = 1, 2, 4, 8
"""Knowledge of all agents, as bits: all constraints are satisfied; the team is infeasible; its margin is proven to be near the best; its
margin is proven to be the best up to `EXACTLY`."""


class Sent(NamedTuple):
    """Traffic of a round: number of messages, of floats in them, and of bytes, names and shapes included."""

    messages: Array
    floats: Array
    bytes: Array


class Seen(NamedTuple):
    """Observation of the whole team after a round.

    Attributes:
        heading: (N,) headings, rad; (0,) for bodies without a heading.
        position: (N, d) positions of the bodies.
        margin: () team margin β̄.
        smooth_margin: () smooth margin β.
        agent_margin: (N,) agent margins.
        estimate: (C, d) estimates.
        known: () bits; see `knowledge`.
        bound: () see `knowledge`.
        messages: see `Sent`.
        floats: see `Sent`.
        bytes: see `Sent`.
    """

    heading: Any
    position: Any
    margin: Any
    smooth_margin: Any
    agent_margin: Any
    estimate: Any
    known: Any
    bound: Any
    messages: Any
    floats: Any
    bytes: Any


class Now(NamedTuple):
    """State of a run between two rounds.

    Attributes:
        state: state of the protocol.
        ages: state of the detection of satisfaction; see `consat.protocols.agreement`.
        body: (N, d) positions of the bodies.
        key: random key of the faults.
        heard: received positions of bodies; None where bodies are at the estimates.
        robots: the robots; None for bodies that follow the estimates.
        bad: (pairs,) channels in a burst of loss; None without bursts.
        held: what the neighbours hold of the agents' messages; None where every message is sent.
    """

    state: Any
    ages: agreement.Ages
    body: Array
    key: Array
    heard: agreement.Bodies | None = None
    robots: Driven | None = None
    bad: Array | None = None
    held: Held | None = None


class Spoken(NamedTuple):
    """State between the two halves of a round.

    Attributes:
        now: the state after sending.
        crossing: the message at each end of a link, for the other end.
        went: (E,) whether it was sent and not lost; None if all arrive.
        reached: (pairs,) the same for each pair of neighbours; None if no one reads it.
        sent: traffic.
    """

    now: Now
    crossing: Crossing
    went: Array | None
    reached: Array | None
    sent: Sent


def one_round(protocol: Rounds, world: World, now: Now, round_: Array) -> tuple[Now, Seen]:
    """Compute one round. `round_`: () its number."""
    spoken = speak(protocol, world, now, round_)
    now, known = hear(protocol, world, spoken)
    return now, see(world, now, known, spoken.sent)


def speak(protocol: Rounds, world: World, now: Now, round_: Array) -> Spoken:
    """First half of a round: every agent that is awake computes its step and its messages, and its body moves."""
    everyone, before = world.everyone, now
    at = now.state.x if now.heard is None else now.heard.position
    known = Known(agreement.known(now.ages, everyone), everyone.margin(at))
    state, message = protocol.speak(now.state, everyone, round_, known)
    ages, age = agreement.speak(now.ages, state.x, everyone)
    key, awake, through, bad = now.key, None, None, now.bad
    if world.rough:
        key, awake, through, bad = _drawn(world, now.key, now.bad)
        state = _where_awake(protocol.per, world, awake, state, before.state)
        ages = _where_awake(_AGES, world, awake, ages, before.ages)
    targets, robots = pick(state.x, world.own), None
    if now.robots is None or world.drive is None:
        body = moved(now.body, targets, world.reach)
    else:
        errors = jax.random.fold_in(now.key, round_.astype(jnp.int32))
        robots = driven(world.drive, now.robots, targets, errors, wind=world.wind, noise=world.noise)
        body = world.drive.position(robots.state)
    heard, word = now.heard, None
    if now.heard is not None and world.owners is not None:
        heard, word = agreement.speak_bodies(now.heard, body, world.owners, everyone)
        if awake is not None:
            heard = _where_awake(_BODIES, world, awake, heard, before.heard)
    crossing, held, goes = Crossing(message, age, word), now.held, None if awake is None else _of_pairs(world, awake)
    if held is not None:
        crossing, held, goes = sending.sifted(
            protocol, everyone, crossing, held, world.pair, beat=float(sending.BEAT), lasting=not world.rough, talks=goes
        )
    reached = goes if through is None else through if goes is None else goes & through
    if through is None:  # without loss, silence means that nothing has changed
        reached = jnp.ones(world.pairs, bool) if protocol.speaks == "pair" else None
    went = None if through is None or reached is None else reached[world.pair]
    now = Now(state, ages, body, key, heard, robots, bad, held)
    return Spoken(now, crossing, went, reached, _sent(protocol, world, crossing, goes))


def _of_pairs(world: World, agents: Array) -> Array:
    """(N,) → (pairs,) bool: the value of each pair's sender."""
    return jax.ops.segment_max(agents[world.talker].astype(int), world.pair, world.pairs) > 0


def _sent(protocol: Rounds, world: World, crossing: Crossing, goes: Array | None) -> Sent:
    """Traffic of a round. `goes`: (pairs,) which pairs send; None for all."""
    everyone, ends, word = world.everyone, world.everyone.links, crossing.word
    per_copy = jax.tree.leaves((crossing.message if protocol.speaks == "link" else (), () if word is None else (word.position, word.stale)))
    width = sum(leaf.size // max(len(ends), 1) for leaf in per_copy)
    ours = None if world.part is None else world.part.ours[world.talker]  # each process counts the messages of its own agents
    if goes is None and ours is None:
        messages, copies = jnp.asarray(world.pairs), jnp.asarray(len(ends))
    else:
        went = jnp.ones(len(ends), bool) if goes is None else goes[world.pair]
        went = went if ours is None else went & ours
        messages = jnp.sum(jax.ops.segment_max(went.astype(int), world.pair, world.pairs))
        copies = jnp.sum(went)
    floats, less = (messages if word is None else 2 * messages) + copies * width, jnp.asarray(0)
    if protocol.speaks == "pair" and everyone.interior is not None:
        plan = everyone.interior.plan
        talks = jnp.ones(world.pairs, bool) if goes is None else goes
        floats += jnp.sum(jnp.where(talks, plan.floats, 0))
        less = jnp.sum(jnp.where(talks, plan.singles, 0)) if world.events else less
    return Sent(messages, floats, HEADER * messages + 8 * floats - 4 * less)


_AGES: Mapping[str, Any] = {"age": "agent", "heard": "link"}
_BODIES: Mapping[str, Any] = {"position": "row", "stale": "row", "ages": _AGES}


def _drawn(world: World, key: Array, bad: Array | None) -> Draw:
    part = world.part
    agents, pairs = (
        ((world.everyone.agents, None), (world.pairs, None)) if part is None else ((part.agents, part.agent), (part.pairs, part.pair))
    )
    return draw(key, bad, loss=world.loss, sleep=world.sleep, burst=world.burst, agents=agents, pairs=pairs)


def _where_awake(per: Mapping[str, Any], world: World, awake: Array, new: Any, old: Any) -> Any:
    """The new state of agents that are awake, (N,), and the old state of the others. `per`: see `consat.protocols.Rounds.per`."""
    masks = {"row": awake[world.everyone.holder], "link": awake[world.talker], "agent": awake}
    if (interior := world.everyone.interior) is not None:
        masks |= {"pair": awake[interior.talker], "constraint": awake[interior.owner]}

    return by_axis(per, lambda axis, a, b: jnp.where(masks[axis].reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)


def by_axis(per: Any, function: Callable[[str, Any, Any], Any], new: Any, old: Any) -> Any:
    """Combine two states of a protocol, array by array.

    Args:
        per: leading axis of each field; see `consat.protocols.Rounds.per`.
        function: function of the name of the leading axis and two arrays.
        new: state whose type the result has.
        old: the other state.
    """
    if isinstance(per, str):
        return jax.tree.map(functools.partial(function, per), new, old)
    return type(new)(**{name: by_axis(kind, function, getattr(new, name), getattr(old, name)) for name, kind in per.items()})


def hear(protocol: Rounds, world: World, spoken: Spoken) -> tuple[Now, tuple[Array, Array]]:
    """Second half of a round: every agent receives. Returns the state, and what all agents know; see `knowledge`."""
    everyone, ends, now = world.everyone, world.everyone.links, spoken.now
    arrived = jnp.ones(len(ends), dtype=bool) if spoken.went is None else ends.across(spoken.went)
    message, age, word = spoken.crossing
    age, word = jax.tree.map(ends.across, (age, word))
    if protocol.speaks == "pair" and everyone.interior is not None and spoken.reached is not None:
        interior = everyone.interior
        state = protocol.hear(now.state, interior.across(message), pick(spoken.reached, interior.other), everyone)
    else:
        state = protocol.hear(now.state, jax.tree.map(ends.across, message), arrived, everyone)
    ages, heard = agreement.hear(now.ages, age, arrived), now.heard
    if heard is not None and word is not None and world.owners is not None:
        heard = agreement.hear_bodies(heard, word, arrived, world.owners, everyone)
    known = agreement.known(ages if heard is None else heard.ages, everyone) > 0
    now = now._replace(state=state, ages=ages, heard=heard)
    return now, knowledge(protocol, world, now, known if world.part is None else known | ~world.part.ours)


def knowledge(protocol: Rounds, world: World, now: Now, satisfied: Array) -> tuple[Array, Array]:
    """Knowledge of all agents, and the bound on the best margin that all have proven.

    Args:
        protocol: the protocol.
        world: constant data of the run.
        now: the state.
        satisfied: (N,) which agents know that all constraints are satisfied.

    Returns:
        () bits of `SATISFIED` and the following, and () the bound, NaN without one.
    """
    everyone = world.everyone
    known = jnp.where(jnp.all(satisfied), SATISFIED, 0)
    if not isinstance(protocol, InteriorPoint) or everyone.interior is None:
        return known, jnp.asarray(jnp.nan)
    margin = everyone.margin(now.state.x if now.heard is None else now.heard.position)
    bound, least = protocol.proven(now.state, everyone, margin)
    gap, unit = bound - least, everyone.interior.units.psi
    idle = jnp.isinf(margin) & (everyone.interior.degree == 0)
    torn = bound < 0
    proven = jnp.isfinite(bound)
    best = proven & (gap <= EXACTLY * jnp.maximum(unit, jnp.abs(bound)))
    some = jnp.any(torn)
    known += jnp.where(jnp.all(satisfied | torn | idle) & some, INFEASIBLE, 0)
    known += jnp.where(jnp.all(satisfied | (torn & near(bound, least, unit)) | idle) & some, NEAR, 0)
    most = jnp.max(jnp.where(idle, -jnp.inf, bound), initial=-jnp.inf)
    return known + jnp.where(jnp.all(best | idle), BEST, 0), jnp.where(jnp.isfinite(most), most, jnp.nan)


def see(world: World, now: Now, known: tuple[Array, Array], sent: Sent) -> Seen:
    """Observation of the whole team. `known`: see `knowledge`."""
    margins = world.observer.agent_margins(now.body)
    smooth = world.observer.smooth_margin(now.body, world.everyone.nu)
    turns = now.robots is not None and world.drive is not None
    heading = world.drive.model.heading(now.robots.state) if turns else jnp.zeros(0)  # type: ignore[union-attr]
    return Seen(heading, now.body, jnp.min(margins), smooth, margins, now.state.x, *known, *sent)


def many_rounds(
    protocol: Rounds, world: World, now: Now, numbers: Array, look: Callable[[Seen], Any] = lambda seen: seen
) -> tuple[Now, Any]:
    """Compute the rounds with these numbers. Returns the state, and the results of `look` for each round, stacked."""

    def step(at: Now, number: Array) -> tuple[Now, Any]:
        at, seen = one_round(protocol, world, at, number)
        return at, look(seen)

    return jax.lax.scan(step, now, numbers)


def begin(protocol: Rounds, world: World, first: Array, key: Array) -> tuple[Now, Seen]:
    """The state before the first round, and its observation. `first`: (C, d) initial estimates; `key`: random key of the faults."""
    start = first[world.own]
    now = Now(
        protocol.start(first, world.everyone),
        agreement.start(first, world.everyone),
        start,
        key,
        heard=None if world.owners is None else agreement.start_bodies(first, world.everyone),
        robots=None if world.drive is None else started(world.drive, start),
        bad=None if world.burst is None else jnp.zeros(world.pairs, bool),
    )
    if world.events:
        now = now._replace(held=_nothing_held(protocol, world, now))
    nothing = jnp.asarray(0)
    seen = see(world, now, (nothing, jnp.asarray(jnp.nan)), Sent(nothing, nothing, nothing))
    return now, seen._replace(estimate=first)  # a protocol may move the initial estimates


def _nothing_held(protocol: Rounds, world: World, now: Now) -> Held:
    """What the neighbours hold before the first message."""

    def said() -> Crossing:
        everyone = world.everyone
        known = Known(jnp.zeros(everyone.agents), jnp.zeros(everyone.agents))
        _, message = protocol.speak(now.state, everyone, jnp.asarray(0.0), known)
        word = None
        if now.heard is not None and world.owners is not None:
            _, word = agreement.speak_bodies(now.heard, now.body, world.owners, everyone)
        return Crossing(message, agreement.speak(now.ages, now.state.x, everyone)[1], word)

    crossing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(said))
    word: agreement.Word | None = crossing.word
    return Held(crossing, jnp.full(world.pairs, agreement.NEVER), None if word is None else word.position)

"""Which messages are worth sending (``--sends events``): the same rule in the engine and on a network.

An agent remembers what each neighbour holds from it. It keeps silent towards a neighbour while what it would say differs from that by less
than a tolerance, which is relative to what is said, or to the barrier of the interior point, and so shrinks as the team converges. What
it sends it remembers as the neighbour reads it, rounded, so that what rounding took off is sent with the next message.

Where nothing gets lost, silence says "as before, and ages go on": the receiver goes on with what it holds, and counts ages up, as the
sender does. Where messages get lost, silence is nothing but a lost message: the receiver keeps what it has, ages are told until they say
all there is to know, and an agent repeats itself now and then, in case its last message was lost.
"""

from __future__ import annotations

from typing import Any, Final, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import Array

from consat.protocols.agreement import NEVER, Word
from consat.protocols.base import Rounds, Solver

Sends = Literal["all", "events"]
"""When agents send: in every round, or when they have something to say."""
SENDS: Final = get_args(Sends)
PLACE: Final = 1e-4
"""A body that moved by less, in the team's unit of length, is where it was; …"""
LAG: Final = 10.0
"""… and one that moves is told of when it is farther from where it was said to be than it moves in so many rounds."""
BEAT: Final = 16
"""Where messages get lost, an agent repeats itself 2, 4, 8, … rounds after its last news, and then whenever so many have passed."""
HEADER: Final = 72
"""Bytes of a message beside its numbers and the names in it; see `consat.network.wire`."""


class Crossing(NamedTuple):
    """What stands at the ends of links, on its way to the others.

    Attributes:
        message: of the protocol; one row of what it `speaks` of.
        told: (links,) ages, see `consat.protocols.agreement`.
        word: of bodies; None where they can jump.
    """

    message: Any
    told: Array
    word: Word | None


class Held(NamedTuple):
    """What an agent remembers of what it said.

    Attributes:
        crossing: what the neighbours hold from it.
        since: (pairs,) rounds since it last had news for them; `NEVER` before it has said anything.
        place: (links, d) where bodies were a round ago; None where they can jump.
    """

    crossing: Crossing
    since: Array
    place: Array | None


def due(since: Array, beat: float) -> Array:
    """Who repeats itself; beat: see `BEAT`, ∞ where nothing gets lost."""
    doubled = 2.0 ** jnp.arange(1.0, 16.0)
    soon = jnp.any((since[:, None] == doubled[None]) & (doubled[None] < beat), axis=1)
    return (since >= NEVER) | ((soon | (since % beat == 0.0)) & jnp.isfinite(beat))


def passed(since: Array, goes: Array, beat: float) -> Array:
    """Rounds since the last news, a round later."""
    later = since + 1.0
    return jnp.where(goes, 0.0, jnp.where(later < NEVER, later, beat if beat < NEVER else 1.0))


def goes_on(crossing: Crossing) -> Crossing:
    """What silence says where nothing gets lost: all as before, and ages one round later."""
    word = crossing.word
    return crossing._replace(told=_later(crossing.told), word=None if word is None else word._replace(age=_later(word.age)))


def _later(age: Array) -> Array:
    return jnp.where(age > 0, age + 1.0, age)


def news(
    protocol: Rounds, solver: Solver, said: Crossing, held: Crossing, place: Array | None, most: float
) -> tuple[Array, Array | None]:
    """Where what would be said differs from what is held by more than a tolerance.

    Args:
        protocol: which says what its own messages may differ by.
        solver: of the agents.
        said: what would be.
        held: by the neighbours.
        place: see `Held`.
        most: ages above it say no more than it does; +∞ where ages go on by themselves.

    Returns:
        (links,), and (pairs,) of a protocol that speaks to pairs, else None.
    """
    differs = protocol.news(said.message, held.message, solver)
    pair = differs if protocol.speaks == "pair" else None
    link = jnp.zeros(len(said.told), bool) if pair is not None else differs | _aged(said.told, held.told, most)
    if said.word is not None and held.word is not None and place is not None:
        away, step = (jnp.abs(said.word.position - other).max(axis=1, initial=0.0) for other in (held.word.position, place))
        moved = away > jnp.maximum(PLACE * solver.length, LAG * step)
        found = (held.word.stale >= NEVER) & (said.word.stale < NEVER)
        link |= moved | found | _aged(said.word.age, held.word.age, most)
    return link, pair


def _aged(said: Array, held: Array, most: float) -> Array:
    return jnp.minimum(said, most) != jnp.minimum(held, most)


def chosen(goes: Array, new: Any, old: Any) -> Any:
    """`new` in the rows that go, `old` in the others."""
    return jax.tree.map(lambda a, b: jnp.where(goes.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)


def single(values: Array) -> Array:
    """The nearest numbers of 32 bits, as numbers of 64."""
    largest = float(jnp.finfo(jnp.float32).max)
    rounded = jnp.clip(values, -largest, largest).astype(jnp.float32).astype(values.dtype)
    return jnp.where(jnp.isfinite(values), rounded, values)

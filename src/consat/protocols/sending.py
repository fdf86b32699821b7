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
"""Bytes of a message beside its numbers, their shapes and the names in it; see `consat.network.wire`."""


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


def due(since: Array, beat: Any) -> Array:
    """Who repeats itself, so many rounds after its last news; beat: see `BEAT`."""
    doubled = jnp.array([2.0**k for k in range(1, 12)])
    soon = jnp.any((since[:, None] == doubled[None]) & (doubled[None] < beat), axis=1)
    return (soon | (since % beat == 0.0)) & (since > 0)


def passed(since: Array, fresh: Array, beat: Any) -> Array:
    """Rounds since the last news, a round later."""
    later = since + 1.0
    return jnp.where(fresh, 1.0, jnp.where(later < NEVER, later, beat))


def goes_on(crossing: Crossing) -> Crossing:
    """What silence says where nothing gets lost: all as before, and ages one round later."""
    word = crossing.word
    return crossing._replace(told=_later(crossing.told), word=None if word is None else word._replace(age=_later(word.age)))


def _later(age: Array) -> Array:
    return jnp.where(age > 0, age + 1.0, age)


def sifted(
    protocol: Rounds, solver: Solver, said: Crossing, held: Held, pair: Array, *, beat: Any, lasting: bool, talks: Array | None = None
) -> tuple[Crossing, Held, Array]:
    """What crosses, what is held from then on, and who sends.

    Args:
        protocol: of the agents.
        solver: theirs.
        said: what would be.
        held: by the neighbours.
        pair: (links,) to which neighbour each end leads.
        beat: see `BEAT`; means nothing where nothing gets lost.
        lasting: whether nothing gets lost, so that silence says that all is as before. Then what is held of the protocol does not hang on
            what is said of bodies, and a run is the same wherever bodies are measured.
        talks: (pairs,) whether whoever speaks there is awake; all are if None.

    Returns:
        the crossing and what is held, both with old rows where nothing is sent, and (pairs,).
    """
    before = goes_on(held.crossing) if lasting else held.crossing
    most = jnp.inf if lasting else solver.hops + 1.0
    by_pair = protocol.speaks == "pair"
    differs, first = protocol.news(said.message, before.message, solver), held.since >= NEVER
    if not by_pair:
        differs = _any(differs | _aged(said.told, before.told, most), pair, len(first))
    differs |= first
    bodies = first | _any(_moved(said, before, held.place, most, solver), pair, len(first))
    goes, since = differs | bodies, passed(held.since, differs | bodies, beat)
    if not lasting:
        goes = differs = goes | due(held.since, beat)
    if talks is not None:
        goes, differs, since = goes & talks, differs & talks, jnp.where(talks, since, held.since)
    message = chosen(differs if by_pair else differs[pair], protocol.brief(said.message), before.message)
    told, word = chosen(differs[pair], said.told, before.told), chosen(goes[pair], said.word, before.word)
    crossing = Crossing(message, told, word)
    return crossing, Held(crossing, since, None if said.word is None else said.word.position), goes


def _any(links: Array, pair: Array, pairs: int) -> Array:
    return jax.ops.segment_max(links.astype(int), pair, pairs) > 0


def _moved(said: Crossing, held: Crossing, place: Array | None, most: Any, solver: Solver) -> Array:
    """(links,) whether there is news of a body, or of those that are where they should be."""
    if said.word is None or held.word is None or place is None:
        return jnp.zeros(len(said.told), bool)
    away, step = (jnp.abs(said.word.position - other).max(axis=1, initial=0.0) for other in (held.word.position, place))
    found = (held.word.stale >= NEVER) & (said.word.stale < NEVER)
    return found | (away > jnp.maximum(PLACE * solver.length, LAG * step)) | _aged(said.word.age, held.word.age, most)


def _aged(said: Array, held: Array, most: Any) -> Array:
    """Where ages differ; above `most` they say no more than it does."""
    return jnp.minimum(said, most) != jnp.minimum(held, most)


def chosen(goes: Array, new: Any, old: Any) -> Any:
    """`new` in the rows that go, `old` in the others."""
    return jax.tree.map(lambda a, b: jnp.where(goes.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)


def single(values: Array) -> Array:
    """The nearest numbers of 32 bits, as numbers of 64."""
    largest = float(jnp.finfo(jnp.float32).max)
    rounded = jnp.clip(values, -largest, largest).astype(jnp.float32).astype(values.dtype)
    return jnp.where(jnp.isfinite(values), rounded, values)

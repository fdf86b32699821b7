"""The rule by which agents send only news (``--sends events``); the engine and the network share it.

An agent remembers what each neighbour holds from it, as rounded for the message. It sends nothing to a neighbour while the new message
differs from that by less than a tolerance. The tolerance is relative to the message, or to the barrier of the interior point, so that it
shrinks as the team converges. Rounding errors do not accumulate: they are part of the next difference.

If no message is lost, silence means "as before, one round later": sender and receiver both keep the old message and increase its ages. If
messages can be lost, silence has no meaning: the receiver keeps what it has, ages are sent until they are complete, and an agent repeats
its last message from time to time in case it was lost.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.protocols.agreement import NEVER, Word
from consat.protocols.base import Rounds, Solver

PLACE: Final = 1e-4
"""Smallest motion of a body that is news, in the team's unit of length."""
LAG: Final = 10.0
"""A moving body is news once it is farther from its last sent position than it moves in `LAG` rounds."""
BEAT: Final = 16
"""If messages can be lost, an agent repeats its last message 2, 4, 8, … rounds after the last news, and then every `BEAT` rounds."""
HEADER: Final = 72
"""Size of a message without numbers, shapes and names, bytes; see `consat.network.wire`."""


class Crossing(NamedTuple):
    """The messages of a round, one row per end of a link.

    Attributes:
        message: message of the protocol; one row per link or per pair, see `consat.protocols.Rounds.speaks`.
        age: (links,) ages, see `consat.protocols.agreement`.
        word: positions of bodies; None if bodies can jump.
    """

    message: Any
    age: Array
    word: Word | None


class Held(NamedTuple):
    """What an agent remembers of its messages.

    Attributes:
        crossing: the messages that the neighbours hold.
        since: (pairs,) rounds since the last news for each neighbour; `NEVER` before the first message.
        place: (links, d) positions of bodies in the previous round; None if bodies can jump.
    """

    crossing: Crossing
    since: Array
    place: Array | None


def due(since: Array, beat: Any) -> Array:
    """(pairs,) whether a repetition is due `since` rounds after the last news. `beat`: see `BEAT`."""
    doubled = jnp.array([2.0**k for k in range(1, 12)])
    soon = jnp.any((since[:, None] == doubled[None]) & (doubled[None] < beat), axis=1)
    return (soon | (since % beat == 0.0)) & (since > 0)


def passed(since: Array, fresh: Array, beat: Any) -> Array:
    """(pairs,) rounds since the last news, one round later. `fresh`: (pairs,) whether there was news in this round."""
    later = since + 1.0
    return jnp.where(fresh, 1.0, jnp.where(later < NEVER, later, beat))


def goes_on(crossing: Crossing) -> Crossing:
    """The meaning of silence if no message is lost: everything as before, and ages one round later."""
    word = crossing.word
    return crossing._replace(age=_later(crossing.age), word=None if word is None else word._replace(age=_later(word.age)))


def _later(age: Array) -> Array:
    return jnp.where(age > 0, age + 1.0, age)


def sifted(
    protocol: Rounds, solver: Solver, said: Crossing, held: Held, pair: Array, *, beat: Any, lasting: bool, talks: Array | None = None
) -> tuple[Crossing, Held, Array]:
    """Select the messages that are sent.

    Args:
        protocol: the protocol.
        solver: local computations of the agents.
        said: the new messages.
        held: what the neighbours hold.
        pair: (links,) index of the pair of each end.
        beat: see `BEAT`; without effect if no message is lost.
        lasting: whether no message is lost, so that silence means "as before". Then what is held of the protocol does not depend on
            messages about bodies, and a run is the same wherever bodies are measured.
        talks: (pairs,) whether the sender is awake; None if all are.

    Returns:
        The messages that the receivers have, and what is held, both with the old rows where nothing is sent; and (pairs,) whether a message
        is sent.
    """
    before = goes_on(held.crossing) if lasting else held.crossing
    most = jnp.inf if lasting else solver.hops + 1.0
    by_pair = protocol.speaks == "pair"
    differs, first = protocol.news(said.message, before.message, solver), held.since >= NEVER
    if not by_pair:
        differs = _any(differs | _aged(said.age, before.age, most), pair, len(first))
    differs |= first
    bodies = first | _any(_moved(said, before, held.place, most, solver), pair, len(first))
    goes, since = differs | bodies, passed(held.since, differs | bodies, beat)
    if not lasting:
        goes = differs = goes | due(held.since, beat)
    if talks is not None:
        goes, differs, since = goes & talks, differs & talks, jnp.where(talks, since, held.since)
    message = chosen(differs if by_pair else differs[pair], protocol.brief(said.message), before.message)
    age, word = chosen(differs[pair], said.age, before.age), chosen(goes[pair], said.word, before.word)
    crossing = Crossing(message, age, word)
    return crossing, Held(crossing, since, None if said.word is None else said.word.position), goes


def _any(links: Array, pair: Array, pairs: int) -> Array:
    return jax.ops.segment_max(links.astype(int), pair, pairs) > 0


def _moved(said: Crossing, held: Crossing, place: Array | None, most: Any, solver: Solver) -> Array:
    """(links,) whether there is news of the position or the age of a body."""
    if said.word is None or held.word is None or place is None:
        return jnp.zeros(len(said.age), bool)
    away, step = (jnp.abs(said.word.position - other).max(axis=1, initial=0.0) for other in (held.word.position, place))
    found = (held.word.stale >= NEVER) & (said.word.stale < NEVER)
    return found | (away > jnp.maximum(PLACE * solver.length, LAG * step)) | _aged(said.word.age, held.word.age, most)


def _aged(said: Array, held: Array, most: Any) -> Array:
    """(links,) whether ages differ; ages above `most` are equivalent to it."""
    return jnp.minimum(said, most) != jnp.minimum(held, most)


def chosen(goes: Array, new: Any, old: Any) -> Any:
    """The rows of `new` where `goes` is true, else those of `old`."""
    return jax.tree.map(lambda a, b: jnp.where(goes.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)


def single(values: Array) -> Array:
    """The values rounded to 32 bits, as 64-bit numbers."""
    largest = float(jnp.finfo(jnp.float32).max)
    rounded = jnp.clip(values, -largest, largest).astype(jnp.float32).astype(values.dtype)
    return jnp.where(jnp.isfinite(values), rounded, values)

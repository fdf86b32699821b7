"""With ``sends=events``, decides to which neighbours an agent sends. Applies `consat.protocols.sending` to the rows of one agent."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import Embodied, RoundCore, Rows
from consat.network.node.pair_core import PairCore
from consat.numerics import quick_compilation
from consat.protocols import Rounds, sending
from consat.protocols.agreement import NEVER, Word
from consat.protocols.sending import Crossing, Held


class Sent(NamedTuple):
    """What an agent remembers of what it sent.

    Attributes:
        rows: the rows that the neighbours hold.
        since: see `consat.protocols.sending.Held`.
        place: see `consat.protocols.sending.Held`.
    """

    rows: Rows
    since: np.ndarray
    place: np.ndarray


class NewsFilter:
    """Keeps what the neighbours hold from an agent, and selects the messages that contain news.

    Args:
        core: the agent's core.
        beat: number of steps after which a message is repeated. ∞ if no message is lost, so that silence means "as before".
    """

    def __init__(self, core: Embodied, beat: float) -> None:
        inner = core.core
        assert isinstance(inner, RoundCore | PairCore), "mode link sends everything"
        self._core, self._inner, self._beat = core, inner, beat
        order = [neighbour.id for neighbour in core.part.neighbours]
        self._pair = jnp.asarray(np.array([order.index(neighbour) for neighbour, _ in core.ends], dtype=np.int32))
        shape = core.part.team.dimension, inner.width, len(order)
        self._how = _How(inner.protocol, inner.layout if isinstance(inner, RoundCore) else None, shape, not np.isfinite(beat))
        self._packing = inner.packing if isinstance(inner, PairCore) else None
        empty, _ = core.empty()
        self._sent = Sent(empty, np.full(len(order), NEVER), np.zeros((len(core.ends), shape[0])))

    def resume(self, rows: Rows, bodies: np.ndarray) -> None:
        """Continue after a restart.

        Args:
            rows: the rows that were sent last.
            bodies: (rows, d) positions of the bodies at that time.
        """
        place = np.asarray(self._core.core.solver.links.at(jnp.asarray(bodies)))
        self._sent = Sent(rows, np.ones(len(self._sent.since)), place)

    def filter(self, rows: Rows) -> tuple[Rows, np.ndarray]:
        """The rows that the neighbours hold after this step, and (G,) to which of them a message must be sent."""
        found = _compiled()(self._how, self._inner.solver, self._packing, rows, self._sent, (self._pair, self._beat))
        link, pair, since, place, goes = map(np.asarray, found)
        self._sent = Sent(Rows(link, pair), since, place)
        return self._sent.rows, goes


class _How(NamedTuple):
    """Static arguments of the compiled function.

    Attributes:
        protocol: the protocol.
        layout: layout of its messages; None for messages per neighbour.
        shape: dimension, width of the rows, and number of neighbours.
        lasting: whether silence means "as before".
    """

    protocol: Rounds
    layout: Any
    shape: tuple[int, int, int]
    lasting: bool


def _crossing(how: _How, solver: Any, packing: Any, rows: Rows) -> Crossing:
    d, width, _ = how.shape
    link = jnp.asarray(rows.link)
    word = Word(link[:, width : width + d], link[:, width + d], link[:, width + d + 1])
    if packing is not None:
        return Crossing(packing.unpack(jnp.asarray(rows.pair), solver.interior.plan.width), jnp.zeros(len(link)), word)
    return Crossing(how.layout.unpack(link), link[:, width - 1], word)


def _rows(how: _How, packing: Any, crossing: Crossing, pair: Array) -> tuple[Array, Array]:
    word, count = crossing.word, len(crossing.told)
    assert word is not None
    bodies = [word.position, word.stale[:, None], word.age[:, None]]
    if packing is not None:
        return jnp.concatenate(bodies, axis=1), packing.pack(crossing.message)
    leaves = [leaf.reshape(count, size) for leaf, size in zip(jax.tree.leaves(crossing.message), how.layout.sizes, strict=True)]
    return jnp.concatenate([*leaves, crossing.told[:, None], *bodies], axis=1), pair


def _filtered(
    how: _How, solver: Any, packing: Any, rows: Rows, sent: Sent, to: tuple[Array, Array]
) -> tuple[Array, ...]:  # fmt: skip
    pair, beat = to
    new, old = (_crossing(how, solver, packing, each) for each in (rows, sent.rows))
    held = Held(old, jnp.asarray(sent.since), jnp.asarray(sent.place))
    crossing, held, goes = sending.sifted(how.protocol, solver, new, held, pair, beat=beat, lasting=how.lasting)
    link, mail = _rows(how, packing, crossing, jnp.asarray(rows.pair))
    assert held.place is not None
    return link, mail, held.since, held.place, goes


@functools.cache
def _compiled() -> Callable[..., Any]:
    return jax.jit(_filtered, static_argnames=("how",), compiler_options=quick_compilation())

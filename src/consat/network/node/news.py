"""With ``sends=events``, decides to which neighbours an agent sends. Applies `consat.protocols.sending` to the rows of one agent."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import Rows
from consat.network.node.embodied import Embodied, columns_of, word_of
from consat.network.node.pair_core import PairCore
from consat.network.node.round_core import RoundCore
from consat.numerics import quickly_compiled
from consat.protocols import Rounds, sending
from consat.protocols.agreement import NEVER
from consat.protocols.sending import Crossing, Held


class NewsFilter:
    """Keeps what the neighbours hold from an agent, and selects the messages that contain news.

    Args:
        core: the agent's core.
        beat: number of steps after which a message is repeated. ∞ if no message is lost, so that silence means "as before".
    """

    def __init__(self, core: Embodied, beat: float) -> None:
        inner = core.core
        assert isinstance(inner, RoundCore | PairCore), "mode link sends everything"
        self._core, self._beat = inner, beat
        order = [neighbour.id for neighbour in core.part.neighbours]
        self._pair = jnp.asarray(np.array([order.index(neighbour) for neighbour, _ in core.ends], dtype=np.int32))
        self._held, _ = core.empty()
        self._since: Any = np.full(len(order), NEVER)
        self._place: Any = np.zeros((len(core.ends), core.part.team.dimension))

    def resume(self, rows: Rows, bodies: np.ndarray) -> None:
        """Continue after a restart.

        Args:
            rows: the rows that were sent last.
            bodies: (rows, d) positions of the bodies at that time.
        """
        self._held, self._since = rows, np.ones(len(self._since))
        self._place = np.asarray(self._core.solver.links.at(jnp.asarray(bodies)))

    def filter(self, rows: Rows) -> tuple[Rows, np.ndarray]:
        """The rows that the neighbours hold after this step, and (G,) to which of them a message must be sent."""
        core, before = self._core, (self._held, self._since, self._place)
        lasting = bool(np.isinf(self._beat))
        held, self._since, self._place, goes = _filtered(
            core.protocol, core.packing, core.solver, rows, before, self._pair, beat=self._beat, lasting=lasting
        )
        self._held = Rows(*map(np.asarray, held))
        return self._held, np.asarray(goes)


@quickly_compiled("protocol", "lasting")
def _filtered(
    protocol: Rounds, packing: Any, solver: Any, rows: Rows, before: tuple[Rows, Any, Any], pair: Array, *, beat: float, lasting: bool
) -> tuple[Rows, Any, Any, Array]:  # fmt: skip
    held, since, place = before
    new, old = (_crossing(protocol, packing, each) for each in (rows, held))
    crossing, after, goes = sending.sifted(protocol, solver, new, Held(old, since, place), pair, beat=beat, lasting=lasting)
    assert crossing.word is not None
    words = columns_of(crossing.word)
    if protocol.speaks == "pair":
        held = Rows(words, packing.pack(crossing.message))
    else:
        held = rows._replace(link=jnp.concatenate([packing.pack(crossing.message), crossing.age[:, None], words], axis=1))
    return held, after.since, after.place, goes


def _crossing(protocol: Rounds, packing: Any, rows: Rows) -> Crossing:
    """The messages from their rows; see `RoundCore` and `Embodied` for the columns."""
    link = jnp.asarray(rows.link)
    if protocol.speaks == "pair":
        return Crossing(packing.unpack(rows.pair), jnp.zeros(len(link)), word_of(link))
    width = sum(packing.sizes)
    return Crossing(packing.unpack(link[:, :width]), link[:, width], word_of(link[:, width + 1 :]))

"""A turn that ends in numbers which are none is not taken: the messages that led there are.

A message may be well-formed and still be poison, from a neighbour that diverges or lies: an absurd number turns an agent's state into NaN,
from which no later message frees it. From any sensible state the protocols find their way once the neighbour speaks sense again; an agent
whose state leads nowhere, whatever it listens to, begins anew.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np

from consat.network.node.core import Embodied, Look, Moment, Rows


class Turn(NamedTuple):
    """What came of a turn.

    Attributes:
        state: next.
        outbox: what to say.
        look: what the agent sees of itself.
        refused: the neighbours whose messages were left out.
        anew: whether the state was given up.
    """

    state: Any
    outbox: Rows
    look: Look
    refused: tuple[str, ...] = ()
    anew: bool = False


def turn(core: Embodied, state: Any, inbox: Rows, arrived: Rows, moment: Moment) -> Turn:
    """Take a turn, see `Embodied.turn`, without those neighbours whose messages spoil it."""
    whole = Turn(*core.turn(state, inbox, arrived, moment))
    if _sound(state, whole):
        return whole
    kept, refused = set[str](), []
    for neighbour in (each.id for each in core.part.neighbours):
        its = _of(core, arrived, {neighbour})
        if not (its.link.any() or its.pair.any()):
            continue
        if _sound(state, Turn(*core.turn(state, *_only(core, inbox, arrived, kept | {neighbour}), moment))):
            kept.add(neighbour)
        else:
            refused.append(neighbour)
    rest = Turn(*core.turn(state, *_only(core, inbox, arrived, kept), moment), refused=tuple(refused))
    if _sound(state, rest):
        return rest
    fresh = core.begin(core.part.first, moment.time)
    return Turn(*core.turn(fresh, *_only(core, inbox, arrived, set()), moment), refused=tuple(refused), anew=True)


def _of(core: Embodied, arrived: Rows, neighbours: Collection[str]) -> Rows:
    """What arrived from some neighbours."""
    link = np.array([other in neighbours for other, _ in core.ends], dtype=bool)
    return Rows(arrived.link & link, arrived.pair & np.array([each.id in neighbours for each in core.part.neighbours], dtype=bool))


def _only(core: Embodied, inbox: Rows, arrived: Rows, neighbours: Collection[str]) -> tuple[Rows, Rows]:
    """What came, and from whom, as if others than these neighbours had said nothing."""
    kept = _of(core, arrived, neighbours)
    return Rows(*(np.where(there[:, None], numbers, 0.0) for numbers, there in zip(inbox, kept, strict=True))), kept


def _sound(before: Any, after: Turn) -> bool:
    """Whether nothing has become NaN, nor any vector of the state, or position, infinite."""
    pairs = zip(jax.tree.leaves(before), jax.tree.leaves(after.state), strict=True)
    return bool(np.isfinite(after.look.x).all()) and all(_kept(np.asarray(old), np.asarray(new)) for old, new in pairs)


def _kept(old: np.ndarray, new: np.ndarray) -> bool:
    if not np.issubdtype(new.dtype, np.floating):
        return True
    if new.ndim < 2:  # a margin may be infinite: of an agent without constraints
        return not (np.isnan(new) & ~np.isnan(old)).any()
    return not (~np.isfinite(new) & np.isfinite(old)).any()

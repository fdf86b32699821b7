"""A turn that ends in numbers which are none is not taken: the messages that led there are.

A message may be well-formed and still be poison, from a neighbour that diverges or lies: an absurd number turns an agent's state into NaN,
from which no later message frees it. From any sensible state the protocols find their way once the neighbour speaks sense again; an agent
whose state leads nowhere, whatever it listens to, begins anew.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from consat.network.core import Embodied, Look, Moment


class Turn(NamedTuple):
    """What came of a turn.

    Attributes:
        state: next.
        outbox: (E, width) what to say.
        look: what the agent sees of itself.
        refused: the neighbours whose messages were left out.
        anew: whether the state was given up.
    """

    state: Any
    outbox: np.ndarray
    look: Look
    refused: tuple[str, ...] = ()
    anew: bool = False


def turn(core: Embodied, state: Any, inbox: np.ndarray, arrived: np.ndarray, moment: Moment) -> Turn:
    """Take a turn, see `Embodied.turn`, without those neighbours whose messages spoil it."""
    whole = Turn(*core.turn(state, inbox, arrived, moment))
    if _sound(state, whole):
        return whole
    kept, refused = np.zeros_like(arrived), []
    for neighbour in dict.fromkeys(neighbour for neighbour, _ in core.ends):
        its = arrived & np.array([other == neighbour for other, _ in core.ends])
        if not its.any():
            continue
        if _sound(state, Turn(*core.turn(state, np.where((kept | its)[:, None], inbox, 0.0), kept | its, moment))):
            kept = kept | its
        else:
            refused.append(neighbour)
    heard = np.where(kept[:, None], inbox, 0.0), kept
    rest = Turn(*core.turn(state, *heard, moment), refused=tuple(refused))
    if _sound(state, rest):
        return rest
    fresh = core.begin(core.part.first)
    return Turn(*core.turn(fresh, np.zeros_like(inbox), np.zeros_like(arrived), moment), refused=tuple(refused), anew=True)


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

"""Guard against messages that make the state of an agent NaN or infinite: the step is computed again without these messages.

A well-formed message of a neighbour that diverges or sends false data can contain absurd numbers. These would turn an agent's state into
NaN, from which no later message recovers it. From every finite state the protocols recover once the neighbour sends valid messages again.
If the step fails even without any message, the agent restarts from its initial estimates.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np

from consat.network.node.core import Moment, Rows
from consat.network.node.embodied import AgentView, Embodied


class Turn(NamedTuple):
    """Result of a guarded step.

    Attributes:
        state: the next state.
        outbox: messages to send.
        view: what the agent knows after the step.
        refused: neighbours whose messages were not used.
        restarted: whether the agent restarted from its initial estimates.
    """

    state: Any
    outbox: Rows
    view: AgentView
    refused: tuple[str, ...] = ()
    restarted: bool = False


def turn(core: Embodied, state: Any, inbox: Rows, arrived: Rows, moment: Moment) -> Turn:
    """Compute a step (see `Embodied.turn`) without the messages of neighbours that make the state NaN or infinite."""
    whole = Turn(*core.turn(state, inbox, arrived, moment))
    if _sound(state, whole):
        return whole
    kept, refused = set[str](), []
    for neighbour in (each.id for each in core.part.neighbours):
        if not any(mask.any() for mask in _only(core, inbox, arrived, {neighbour})[1]):
            continue
        if _sound(state, Turn(*core.turn(state, *_only(core, inbox, arrived, kept | {neighbour}), moment))):
            kept.add(neighbour)
        else:
            refused.append(neighbour)
    rest = Turn(*core.turn(state, *_only(core, inbox, arrived, kept), moment), refused=tuple(refused))
    if _sound(state, rest):
        return rest
    fresh = core.begin(core.part.first, moment.time)
    return Turn(*core.turn(fresh, *_only(core, inbox, arrived, set()), moment), refused=tuple(refused), restarted=True)


def _only(core: Embodied, inbox: Rows, arrived: Rows, neighbours: Collection[str]) -> tuple[Rows, Rows]:
    """Inbox and mask of arrival, restricted to the messages of some neighbours."""
    link = np.array([other in neighbours for other, _ in core.ends], dtype=bool)
    pair = np.array([each.id in neighbours for each in core.part.neighbours], dtype=bool)
    kept = Rows(arrived.link & link, arrived.pair & pair)
    return Rows(*(np.where(there[:, None], numbers, 0.0) for numbers, there in zip(inbox, kept, strict=True))), kept


def _sound(before: Any, after: Turn) -> bool:
    """Whether the step was valid: no entry has become NaN, and no position or array of vectors has become infinite."""
    pairs = zip(jax.tree.leaves(before), jax.tree.leaves(after.state), strict=True)
    return bool(np.isfinite(after.view.x).all()) and all(_kept(np.asarray(old), np.asarray(new)) for old, new in pairs)


def _kept(old: np.ndarray, new: np.ndarray) -> bool:
    if not np.issubdtype(new.dtype, np.floating):
        return True
    if new.ndim < 2:  # the margin of an agent without constraints is infinite
        return not (np.isnan(new) & ~np.isnan(old)).any()
    return not (~np.isfinite(new) & np.isfinite(old)).any()

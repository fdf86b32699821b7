"""Counters of a run in rounds, from which it is reported when the team was satisfied, and what it sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from consat.engine.chunks import CHUNK, Chunk
from consat.engine.loop import Steps
from consat.engine.round import INFEASIBLE, SATISFIED


@dataclass
class Tally(Steps):
    """Counters of rounds. The start counts as round 0.

    Attributes:
        streak: number of consecutive rounds, up to the last, after which every margin was positive.
        near: number of consecutive rounds for which all agents have known the result that ends the run; see `consat.engine.chunks.Ask`.
        known: last knowledge of all agents; see `consat.engine.round.knowledge`.
        infeasible_from: first round after which all agents knew that the team is infeasible; None if there is none.
        last_bad: last round after which a margin was not positive; −1 if there is none.
        last_unknown: last round after which not all agents knew that all are satisfied; −1 if there is none.
        messages: number of messages sent.
        floats: number of floats sent.
        bytes: number of bytes sent.
        smooth_margin: last smooth margin.
        bound: last proven bound; NaN without one.
        held: number of rounds after which every constraint held.
        first_held: first round after which every constraint held; None if there is none.
        held_since: number of rounds from `first_held` on after which every constraint held.
        worst_since: smallest margin from `first_held` on.
        asked: round at which it was last checked whether the team is infeasible.
        turned: round after which the team switched to a spanning tree; None if it has not.
        violated: (W,) number of rounds after which each watched constraint was violated; None if not counted.
    """

    streak: int = 0
    near: int = 0
    last_bad: int = -1
    last_unknown: int = -1
    messages: int = 0
    floats: int = 0
    bytes: int = 0
    smooth_margin: float = np.nan
    bound: float = np.nan
    asked: int = 0
    known: int = 0
    infeasible_from: int | None = None
    held: int = 0
    first_held: int | None = None
    held_since: int = 0
    worst_since: float = np.inf
    violated: Any = 0
    turned: int | None = None

    def add(self, chunk: Chunk) -> np.ndarray:
        """Count the rounds of a chunk. Returns their numbers."""
        count = int(chunk.done)
        numbers = np.arange(self.done + 1, self.done + 1 + count)
        margin, known = np.asarray(chunk.margin)[:count], np.asarray(chunk.known)[:count]
        bad, unknown = np.flatnonzero(~(margin > 0)), np.flatnonzero(known & SATISFIED == 0)
        torn = np.flatnonzero(known & INFEASIBLE)
        if self.infeasible_from is None and len(torn):
            self.infeasible_from = int(numbers[torn[0]])
        self.known, self.near = int(known[-1]), int(chunk.near)
        self._hold(numbers, margin)
        self.streak = self.streak + count if not len(bad) else count - 1 - int(bad[-1])
        self.last_bad = int(numbers[bad[-1]]) if len(bad) else self.last_bad
        self.last_unknown = int(numbers[unknown[-1]]) if len(unknown) else self.last_unknown
        self.messages += int(np.sum(np.asarray(chunk.messages)[:count]))
        self.floats += int(np.sum(np.asarray(chunk.floats)[:count]))
        self.bytes += int(np.sum(np.asarray(chunk.bytes)[:count]))
        self.violated = None if chunk.violated is None else np.asarray(self.violated) + np.asarray(chunk.violated)
        self.done += count
        self.margin, self.smooth_margin, self.bound = (float(leaf[count - 1]) for leaf in (chunk.margin, chunk.smooth_margin, chunk.bound))
        self.drift = float(chunk.drift) if count == CHUNK or not np.isfinite(chunk.drift) else np.inf
        return numbers

    def motion(self, period: float) -> dict[str, Any]:
        """Fields of the summary for a team that moves. `period`: duration of a round, s."""
        since = 0 if self.first_held is None else self.done + 1 - self.first_held
        return {
            "duration": self.done * period,
            "satisfied_share": self.held / (self.done + 1),
            "satisfied_share_after": self.held_since / since if since else None,
            "worst_margin_after": self.worst_since if since else None,
        }

    def _hold(self, numbers: np.ndarray, margin: np.ndarray) -> None:
        good = margin > 0
        self.held += int(np.count_nonzero(good))
        if self.first_held is None and good.any():
            self.first_held = int(numbers[np.argmax(good)])
        if self.first_held is not None:
            since = margin[numbers >= self.first_held]
            self.held_since += int(np.count_nonzero(since > 0))
            self.worst_since = min(self.worst_since, float(since.min()))

    @property
    def knowledge(self) -> dict[str, Any]:
        """Fields of a trace: what all agents know at the end, and since which round. Agents judge by their estimates. Where a constraint is
        violated at the positions of the bodies, satisfaction does not count as known."""
        if self.known & SATISFIED and self.last_bad < self.done:
            return {"known": "satisfied", "known_from": max(self.last_unknown, self.last_bad) + 1}
        if self.known & INFEASIBLE:
            return {"known": "infeasible", "known_from": self.infeasible_from}
        return {"known": None, "known_from": None}


def known_of(tally: Tally) -> Literal["satisfied", "infeasible"] | None:
    """What all agents know."""
    return "satisfied" if tally.known & SATISFIED else "infeasible" if tally.known & INFEASIBLE else None

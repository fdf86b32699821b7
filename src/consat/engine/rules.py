"""Rules that end a run in rounds, or that switch it to another layout of copies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from consat.engine.chunks import CHUNK, SURE
from consat.engine.round import BEST, NEAR, SATISFIED
from consat.engine.tally import Tally
from consat.engine.world import World
from consat.protocols import Rounds
from consat.results.trace import Ending
from consat.settings import Stop

ENOUGH = {"satisfied": NEAR, "converged": BEST, "never": 0}
"""For each stop condition the knowledge of all agents that ends a run; see `consat.engine.round.knowledge`."""
HOLD = 10
"""Number of consecutive rounds for which every margin must be positive before a team counts as satisfied."""
WORD = 10
"""Number of additional rounds per hop for which a satisfied team goes on, at most, until all agents know that it is satisfied."""
FAR = 50
"""Above this many hops a satisfied team does not go on until all agents know."""
PATIENCE = 2000
"""Default limit of the number of rounds."""
PATIENT = 1.5
"""The check whether a settled team is infeasible is slow. It is repeated only when the run is longer by this factor."""
TURN, TURN_HOP = 10, 2
"""Number of rounds, and of additional rounds per hop, after which a team that is not satisfied over links with loops switches to a spanning
tree. Measured: random geometric graphs, rings and lattices of 9 to 100 agents are satisfied over their links by then, or infeasible."""
SETTLED = 1e-5
"""A team is settled when no position moved by more than this fraction of the team's unit of length over a chunk of rounds."""
SETTLED_CERTIFIED = 1e-7
"""The same where a certificate may end the run earlier; see `Rules.enough`."""


def stillness(length: float, enough: Callable[[np.ndarray], bool] | None) -> float:
    """Value of `Rules.still`. `length`: the team's unit of length; `enough`: see `Rules`."""
    return (SETTLED if enough is None else SETTLED_CERTIFIED) * length


def longest_hold(protocol: Rounds, world: World) -> int:
    """Value of `Rules.most`."""
    hops = world.everyone.hops
    return HOLD + (WORD * (1 + hops) if protocol.speaks == "pair" and hops <= FAR else 0)


def turn_after(world: World) -> int:
    """Value of `Rules.turn` for a team that can switch to a spanning tree."""
    return TURN + TURN_HOP * world.everyone.hops


@dataclass(frozen=True)
class Rules:
    """Stop rules of a run.

    Attributes:
        end: largest number of rounds.
        stop: condition that ends the run earlier.
        still: largest movement of a position over a chunk of rounds at which a team counts as settled, length.
        most: number of consecutive satisfied rounds that ends the run even if not all agents know.
        least: smallest number of rounds.
        earliest: number of rounds before which a team does not count as settled.
        hopeless: whether (N, d) positions prove that no formation satisfies every constraint.
        enough: whether no formation is better than (N, d) positions by more than a tolerance; None without such a certificate.
        turn: number of rounds after which a team that is not satisfied switches to another layout; None without one.
    """

    end: int
    stop: Stop
    still: float
    most: int = HOLD
    least: int = 0
    earliest: int = 0
    hopeless: Callable[[np.ndarray], bool] = lambda _: False
    enough: Callable[[np.ndarray], bool] | None = None
    turn: int | None = None

    def turns(self, tally: Tally) -> bool:
        """Whether the team switches to another layout now: it has not been satisfied in time."""
        return self.turn is not None and tally.turned is None and tally.done >= self.turn and tally.streak == 0

    def chunk(self, tally: Tally) -> int:
        """Number of rounds to compute before the next check."""
        checks = [at for at in (self.turn, self.least, self.end) if at is not None and at > tally.done]
        return min(CHUNK, min(checks, default=tally.done) - tally.done)

    def ending(self, tally: Tally, positions: Callable[[], np.ndarray]) -> Ending | None:
        """Reason to end the run now; None to go on. `positions`: returns the (N, d) positions."""
        if np.isnan(tally.drift) or (tally.drift == np.inf and not np.isfinite(positions()).all()):
            return "diverged"
        if self.stop == "never" or tally.done < self.least:
            return None
        if self.stop == "satisfied" and tally.streak >= HOLD and (tally.known & SATISFIED or tally.streak >= self.most):
            return "satisfied"
        if tally.near >= SURE:
            return "settled"
        if self.stop == "converged" and self.enough is not None and self.enough(positions()):
            return "settled"
        if tally.done - (tally.turned or 0) < self.earliest or tally.drift > self.still:
            return None
        if self.stop == "converged":
            return "settled"
        if tally.done < PATIENT * tally.asked:
            return None
        tally.asked = tally.done
        return "settled" if self.hopeless(positions()) else None

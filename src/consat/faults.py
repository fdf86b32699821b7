"""Faults of messages and agents: loss, bursts of loss, delay, repetition and sleep, drawn from a seed.

One description, `Faults`, serves the engine, which draws for all links of a round at once (`draw`), and the network, which draws message by
message (`Channel`). To add a fault: a field here, and what it does in these two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.errors import InvalidSettings


@dataclass(frozen=True)
class Faults:
    """What goes wrong.

    Attributes:
        loss: probability that a message is lost; each direction of a link is drawn by itself.
        sleep: probability that an agent skips a round: it computes and sends nothing, but receives. Engine only.
        seed: of the draws.
        burst: (p, q) of losses in bursts (Gilbert 1960). Before each message a good channel turns bad with probability p, and a bad one
            good with probability q; a bad one loses everything. In the engine each direction of a link is a channel; in an agent's
            process there is one, for all that arrives. None for no bursts.
        delay: (low, high) range of the time that a message takes, s. Each draws its own, so that they arrive out of order. Network only.
        repeat: probability that a message arrives twice. Network only.

    Raises:
        InvalidSettings: a probability is out of range, or a delay is negative.
    """

    loss: float = 0.0
    sleep: float = 0.0
    seed: int = 0
    burst: tuple[float, float] | None = None
    delay: tuple[float, float] = (0.0, 0.0)
    repeat: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.loss < 1 and 0 <= self.sleep < 1):
            raise InvalidSettings(f"loss is {self.loss} and sleep is {self.sleep}, but both must be probabilities below 1")
        if not 0 <= self.repeat <= 1:
            raise InvalidSettings(f"repeat is {self.repeat}, but must be a probability")
        if self.burst is not None and not (len(self.burst) == 2 and all(0 < each <= 1 for each in self.burst)):
            message = f"burst is {list(self.burst)}, but must be two probabilities, of a link's turning bad and of its turning good again"
            raise InvalidSettings(message)
        if not 0 <= self.delay[0] <= self.delay[1]:
            raise InvalidSettings(f"delay is {list(self.delay)}, but must be a range of times, s")

    @property
    def on_messages(self) -> bool:
        """Whether anything happens to messages."""
        return self != Faults(sleep=self.sleep, seed=self.seed)


class Channel:
    """The way of messages in one direction, message by message.

    Args:
        faults: what goes wrong.
        random: generator of the draws.
    """

    def __init__(self, faults: Faults, random: np.random.Generator) -> None:
        self._faults, self._random, self._bad = faults, random, False

    def delays(self) -> list[float]:
        """Delays of the copies of the next message that arrive, s: none if it is lost, two if it is repeated."""
        faults, random = self._faults, self._random
        if faults.burst is not None:
            self._bad = random.random() >= faults.burst[1] if self._bad else random.random() < faults.burst[0]
        copies = 1 + (random.random() < faults.repeat)
        return [random.uniform(*faults.delay) for _ in range(copies) if random.random() >= faults.loss and not self._bad]


class Draw(NamedTuple):
    """What happens in one round.

    Attributes:
        key: for the next round.
        awake: (N,) bool, agents that compute and send.
        arrives: (P,) bool, directed pairs between which messages get through.
        bad: (P,) bool, channels that are bad now; None for no bursts.
    """

    key: Array
    awake: Array
    arrives: Array
    bad: Array | None


Part = tuple[int, Array | None]
"""How many there are in the whole team, and the indices of those that this process has; None for all."""


def _uniform(key: Array, of: Part) -> Array:
    count, own = of
    draws = jax.random.uniform(key, (count,))
    return draws if own is None else draws[own]


def draw(
    key: Array, bad: Array | None, *, loss: Array, sleep: Array, burst: Array | None, agents: Part, pairs: Part
) -> Draw:  # fmt: skip
    """Draw the faults of one round. A process draws for the whole team and takes what is its own, so that several see the same as one.

    Args:
        key: random key.
        bad: (P,) bool, channels that were bad in the round before; None for no bursts.
        loss: () probability of loss.
        sleep: () probability of a skipped round.
        burst: (2,) p and q; None for no bursts.
        agents: the agents.
        pairs: the directed pairs of agents between which messages travel.
    """
    key, draw_loss, draw_sleep = jax.random.split(key, 3)
    arrives = _uniform(draw_loss, pairs) >= loss
    if bad is not None and burst is not None:
        turns = jax.random.uniform(jax.random.fold_in(draw_loss, 1), bad.shape)
        bad = jnp.where(bad, turns >= burst[1], turns < burst[0])
        arrives &= ~bad
    return Draw(key, _uniform(draw_sleep, agents) >= sleep, arrives, bad)

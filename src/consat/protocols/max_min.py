"""Exact max-min: relaxed ADMM while ν rises, so that the maximiser of the smooth margin β becomes that of the margin β̄.

In stage s the agents minimise  Σ_i e^{−ν_s (α_i − t)} / 2^s  with ν_s = 2^s ν, where t, the margin of the team in the last stage, keeps
the numbers near one. They find t by min-consensus: each passes on the smallest ᾱ_j it has heard of in its stage, and learns no more than
that; a stage lasts long enough for the smallest to reach everyone, and for penalties, which fall with every crossing, to come down.
β̄* − β̄ ≤ (ln N + ln m̄)/ν_s (paper, eq. 12) halves with every stage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from consat.protocols.admm import Admm, AdmmState
from consat.protocols.base import Solver


class MaxMinState(NamedTuple):
    """What an agent remembers.

    Attributes:
        x: (rows, d) estimates.
        admm: the state of `consat.protocols.admm`.
        heard: one number an agent, the smallest margin heard of in this stage.
        level: one number an agent, t.
    """

    x: Array
    admm: AdmmState
    heard: Array
    level: Array


@dataclass(frozen=True)
class MaxMin:
    """See the module.

    Attributes:
        stage: rounds at each ν, and …
        crossings: … as many more as a message needs to cross the team so many times.
        stages: how often ν doubles.
        rise: by which part ρ_i may rise in a stage, an equal share in each of its rounds.
        admm: how each stage is solved.
    """

    stage: int = 8
    crossings: int = 6
    stages: int = 10
    rise: float = 2.0
    admm: Admm = field(default=Admm(fall=0.8, least=1e-4, hurry=0.0))
    name = "max-min"
    per: ClassVar[Mapping[str, Any]] = {"x": "row", "admm": Admm.per, "heard": "agent", "level": "agent"}

    def earliest(self, solver: Solver) -> int:
        return self.stages * self._rounds(solver)

    def _rounds(self, solver: Solver) -> int:
        return self.stage + self.crossings * solver.hops

    def start(self, x: Array, solver: Solver) -> MaxMinState:
        margin = solver.margin(x)
        return MaxMinState(x, self.admm.start(x, solver), margin, jnp.zeros_like(margin))

    def speak(
        self, state: MaxMinState, solver: Solver, round_: Array, known: Array
    ) -> tuple[MaxMinState, tuple[tuple[Array, Array, Array], Array]]:
        stage = self._rounds(solver)
        number, within = jnp.floor(round_ / stage), round_ % stage
        turn = (number > 0) & (number <= self.stages) & (within == 0)
        level = jnp.where(turn, state.heard, state.level)
        sharper, above = 2.0 ** jnp.minimum(number, self.stages), jnp.where(number > 0, level, 0.0)
        # penalties may fall throughout, and settle once the last stage is over
        free = 1.0 + jnp.maximum(round_ - self.earliest(solver), 0.0) + jnp.zeros_like(known)
        paced = replace(self.admm, rise=self.rise / stage)
        admm, message = paced.speak(state.admm, solver, within, free, sharper, above)
        margin = solver.margin(admm.x)
        # what was heard in the first half of a stage is of positions still on their way
        heard = jnp.where(within <= stage // 2, margin, jnp.minimum(state.heard, margin))
        return MaxMinState(admm.x, admm, heard, level), (message, solver.links.at(solver.to_rows(heard)))

    def hear(self, state: MaxMinState, message: tuple[tuple[Array, Array, Array], Array], arrived: Array, solver: Solver) -> MaxMinState:
        points, margins = message
        least = solver.least(jnp.where(arrived, margins, jnp.inf))
        return state._replace(admm=self.admm.hear(state.admm, points, arrived, solver), heard=jnp.minimum(state.heard, least))

"""P-EXTRA, an implicit discretization of the gradient flow (Shi, Ling, Wu, Yin 2015). Each round, with Metropolis weights w, is

    v  = x − Σ_j w_ij (x − x_j) − z
    z⁺ = z + ½ Σ_j w_ij (x − x_j),          z(0) = 0
    x⁺ = argmin_y f_i(y) + ‖y − v‖²/(2c)

Sends x. It converges for every c > 0 when the ψ are concave and no message is lost. After a lost message the two ends of a link integrate
different disagreements, and Σ z drifts. Use `consat.protocols.admm` on links that lose messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from consat.protocols.base import Known, Solver
from consat.protocols.local.proximal import Memory


class ProximalState(NamedTuple):
    """State of an agent.

    Attributes:
        x: (rows, d) estimates.
        z: (rows, d) integral of the disagreement.
        heard: (links, d) the neighbours' estimates, as last received.
        memory: warm start of the local solver.
    """

    x: Array
    z: Array
    heard: Array
    memory: Memory


@dataclass(frozen=True)
class Proximal:
    """Gains of P-EXTRA; the equations are in the module docstring.

    Attributes:
        step: c, in length² of the team's unit of length.
    """

    step: float = 0.3
    name = "proximal"
    speaks: ClassVar[str] = "link"
    per: ClassVar[Mapping[str, Any]] = {"x": "row", "z": "row", "heard": "link", "memory": "agent"}

    def earliest(self, solver: Solver) -> int:
        return 0

    def start(self, x: Array, solver: Solver) -> ProximalState:
        x = solver.nearby(x)
        return ProximalState(x, jnp.zeros_like(x), solver.links.at(x), solver.recall(x, self._kappa(x, solver)))

    def speak(self, state: ProximalState, solver: Solver, round_: Array, known: Known) -> tuple[ProximalState, Array]:
        links = solver.links
        spread = links.sum(links.metropolis[:, None] * (links.at(state.x) - state.heard))
        x, memory, _ = solver.prox(state.x - spread - state.z, self._kappa(state.x, solver), state.x, state.memory)
        return ProximalState(x, state.z + 0.5 * spread, state.heard, memory), links.at(x)

    def _kappa(self, x: Array, solver: Solver) -> Array:
        return jnp.zeros(len(x)) + 1.0 / (self.step * solver.length**2)

    def news(self, said: Array, held: Array, solver: Solver) -> Array:
        """Every difference counts: both ends must integrate the same disagreement."""
        return jnp.any(said != held, axis=1)

    def brief(self, message: Array) -> Array:
        return message

    def hear(self, state: ProximalState, message: Array, arrived: Array, solver: Solver) -> ProximalState:
        return state._replace(heard=jnp.where(arrived[:, None], message, state.heard))

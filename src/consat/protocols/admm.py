"""Relaxed ADMM over local estimates (Bastianello, Carli, Schenato, Todescato, arXiv 1901.09252). For each link and shared copy agent i
keeps a point u_ij (w_ij = ρ_ij u_ij in the paper), and in each round

    x_i⁺ = argmin_y f_i(y) + Σ_j ρ_ij/2 ‖y − u_ij‖²
    send   x_i⁺ and the force  g_ij = ρ_ij (u_ij − x_i⁺)
    on receipt from j:   u_ij ← (1 − a) u_ij + a (x_j − g_ji/ρ_ij)             a lost message leaves u_ij as it was

x_j − g_ji/ρ_ij is q_ji/ρ_ij of the paper where both ends hold the same penalty, and keeps the balance of forces while they don't, because
a message that told of a change was lost: points alone would drift apart. It converges under random loss and wake-ups from any u: there is
no invariant to lose. The penalty of a link is the geometric mean of what its two ends want, ρ_ij = √(ρ_i ρ_j), which they send along. It
begins stiff, where constraints are met soonest; then each end lets ρ_i rise slowly towards the stiffness of its own f_i, faster while its
own constraints are violated, and fall so only once it knows that all are satisfied: by then the optimum is all that is left to find, and a
soft penalty finds it soonest. A copy that no constraint of its holder reads follows its neighbours. When ρ_ij changes, u_ij − x_i is
rescaled with it, so that the force ρ_ij (u_ij − x_i) stays. Where some ψ are not concave no ρ falls: below the negative curvature of f_i
the step would have no minimum.

The points begin where the team's places are, however far out the bodies start: any would do, and near ones are rounds away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.protocols.base import Known, Solver
from consat.protocols.local.proximal import Memory


class AdmmState(NamedTuple):
    """What an agent remembers.

    Attributes:
        x: (rows, d) estimates.
        u: (links, d) the points of its links.
        wish: (rows,) ρ_i.
        heard: (links,) ρ_j, as last received.
        penalty: (links,) ρ_ij in force.
        memory: of its solver.
    """

    x: Array
    u: Array
    wish: Array
    heard: Array
    penalty: Array
    memory: Memory


@dataclass(frozen=True)
class Admm:
    """See the module.

    Attributes:
        relaxation: a in (0, 1); above 1/2 is over-relaxed, …
        cautious: … which only convex teams are: where some ψ are not concave a is at most this. With more they fell into cycles.
        penalty: ρ at the start, in 1/length².
        share: of the stiffness, that ρ_i moves towards.
        least: of the penalty at the start, below which ρ_i does not fall: agents with room to spare have no stiffness to speak of.
        rise: by which part ρ_i may rise in a round, …
        hurry: … and how many times that is added where f_i is 1 or more, as it is while constraints are violated: agents with separations
            can turn about each other in a cycle, which a stiffer penalty of theirs breaks.
        fall: by which part it may fall while a message crosses the team, once the agent knows that all are satisfied.
        horizon: after so many crossings the moves die out, so that ρ settles and convergence is that of fixed ρ.
        tolerance: where agents send what is news, how far a point may be, in the team's unit of length, from what its neighbour holds, …
        loose: … and by which part a penalty may.
    """

    relaxation: float = 0.7
    cautious: float = 0.5
    penalty: float = 10.0
    share: float = 0.3
    least: float = 1e-6
    rise: float = 0.005
    hurry: float = 10.0
    fall: float = 0.2
    horizon: float = 50.0
    tolerance: float = 1e-4
    loose: float = 0.1
    name = "admm"
    speaks: ClassVar[str] = "link"
    per: ClassVar[Mapping[str, Any]] = {"x": "row", "u": "link", "wish": "row", "heard": "link", "penalty": "link", "memory": "agent"}

    def earliest(self, solver: Solver) -> int:
        return 0

    def start(self, x: Array, solver: Solver) -> AdmmState:
        x = solver.nearby(x)
        at_links = solver.links.at(x)
        wish = jnp.zeros(len(x)) + self.penalty / solver.length**2
        level = solver.links.at(wish)
        return AdmmState(x, at_links, wish, level, level, solver.recall(x, wish))

    def speak(self, state: AdmmState, solver: Solver, round_: Array, known: Known) -> tuple[AdmmState, tuple[Array, Array, Array]]:
        links = solver.links
        x, u, wish = state.x, state.u, state.wish
        rho = jnp.sqrt(links.at(wish) * state.heard)
        u = links.at(x) + (u - links.at(x)) * (state.penalty / rho)[:, None]
        kappa, linked = links.sum(rho), links.degree > 0
        v = jnp.where(linked[:, None], links.sum(rho[:, None] * u) / jnp.where(linked, kappa, 1.0)[:, None], x)
        x, memory, stiffness = solver.prox(v, jnp.where(linked, kappa, wish), x, state.memory)
        stiff = self.share * stiffness
        unread = jnp.isnan(stiff)

        def followed() -> Array:
            neighbours = jnp.where(linked, links.sum(state.heard) / jnp.maximum(links.degree, 1.0), wish)
            return jnp.where(unread, neighbours, stiff)

        goal = jax.lax.cond(jnp.any(unread), followed, lambda: stiff)
        least, across = self.least * self.penalty / solver.length**2, max(solver.hops, 1)
        horizon = self.horizon * across
        rise = self.rise * (1.0 + self.hurry * jnp.exp(jnp.minimum(memory.sigma, 0.0))) / (1.0 + (round_ / horizon) ** 4)
        fall = jnp.where(known.satisfied > 0, self.fall / across / (1.0 + (known.satisfied / horizon) ** 4), 0.0)
        lowest = wish * (1.0 - solver.to_rows(fall)) if solver.convex else wish
        wish = jnp.clip(jnp.maximum(goal, least), lowest, wish * (1.0 + solver.to_rows(rise)))
        here = links.at(x)
        return AdmmState(x, u, wish, state.heard, rho, memory), (here, rho[:, None] * (u - here), links.at(wish))

    def news(self, said: tuple[Array, Array, Array], held: tuple[Array, Array, Array], solver: Solver) -> Array:
        (here, force, wish), (there, pull, rho) = said, held
        apart = jnp.abs(here - there).max(axis=1, initial=0.0) + jnp.abs(force - pull).max(axis=1, initial=0.0) / wish
        return (apart > self.tolerance * solver.length) | (jnp.abs(wish - rho) > self.loose * rho)

    def brief(self, message: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        return message

    def hear(self, state: AdmmState, message: tuple[Array, Array, Array], arrived: Array, solver: Solver) -> AdmmState:
        there, force, wish = message
        q = there - force * (1.0 / state.penalty)[:, None]
        a = self.relaxation if solver.convex else min(self.relaxation, self.cautious)
        u = jnp.where(arrived[:, None], (1 - a) * state.u + a * q, state.u)
        return state._replace(u=u, heard=jnp.where(arrived, wish, state.heard))

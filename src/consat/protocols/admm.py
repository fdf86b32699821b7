"""Relaxed ADMM over local estimates (Bastianello, Carli, Schenato, Todescato, arXiv 1901.09252). For each link and shared copy agent i
keeps a point u_ij (w_ij = ρ_ij u_ij in the paper). Each round is

    x_i⁺ = argmin_y f_i(y) + Σ_j ρ_ij/2 ‖y − u_ij‖²
    send   x_i⁺ and the force  g_ij = ρ_ij (u_ij − x_i⁺)
    on receipt from j:   u_ij ← (1 − a) u_ij + a (x_j − g_ji/ρ_ij)             a lost message leaves u_ij unchanged

Messages. Where both ends hold the same penalty, x_j − g_ji/ρ_ij equals q_ji/ρ_ij of the paper. The two penalties differ while a message
about a change is lost. Sending the force keeps the forces in balance even then; sending points alone would let them drift apart. The
protocol converges under random message loss and random wake-ups from any u, because it depends on no invariant of the initial state.

Penalty. ρ_ij = √(ρ_i ρ_j) is the geometric mean of the penalties that its two ends want, which they send along. It starts stiff, because
a stiff penalty satisfies the constraints soonest. Each end then lets ρ_i rise slowly towards the stiffness of its own f_i, and faster while
its own constraints are violated. ρ_i may fall towards that stiffness only once the agent knows that all constraints are satisfied: only the
optimum is left to find then, and a soft penalty finds it soonest. A copy that no constraint of its holder reads takes the mean penalty of
its neighbours. When ρ_ij changes, u_ij − x_i is rescaled so that the force ρ_ij (u_ij − x_i) stays the same. Where some ψ are not concave,
no ρ falls: the local step has no minimum when ρ is below the negative curvature of f_i.

Start. The points u start inside the team's region even where the bodies start far from it: any start converges, but a start far away costs
rounds.
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
    """State of an agent.

    Attributes:
        x: (rows, d) estimates.
        u: (links, d) the points u_ij.
        wish: (rows,) ρ_i, the penalty that the agent wants.
        heard: (links,) ρ_j, as last received.
        penalty: (links,) ρ_ij, as used in the last step.
        memory: warm start of the local solver.
    """

    x: Array
    u: Array
    wish: Array
    heard: Array
    penalty: Array
    memory: Memory


@dataclass(frozen=True)
class Admm:
    """Gains of relaxed ADMM; the equations are in the module docstring.

    Attributes:
        relaxation: a in (0, 1); above 1/2 is over-relaxed.
        cautious: upper bound on a where some ψ are not concave. With a larger a such teams fell into cycles.
        penalty: initial ρ, in 1/length² of the team's unit of length.
        share: fraction of the stiffness of f_i that ρ_i moves towards.
        least: lower bound on ρ_i, as a fraction of the initial ρ. Agents with room to spare have almost no stiffness.
        rise: relative increase of ρ_i in a round, at most.
        hurry: factor of an additional increase, `hurry` · `rise`, where f_i ≥ 1 (constraints violated) and some ψ are not concave: agents
            with separation constraints can circle about each other, and a stiffer penalty breaks that cycle. Where all are concave it kept
            a formation of 100 from being satisfied.
        fall: relative decrease of ρ_i, at most, in the time a message needs to cross the team, once all are known to be satisfied.
        horizon: number of such crossings after which changes of ρ fade out, so that the convergence proof for fixed ρ applies.
        tolerance: with ``sends=events``, largest difference between a point and what the neighbour holds, in the team's unit of length.
        loose: the same for a penalty, as a fraction of it.
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
        hurry = 0.0 if solver.convex else self.hurry
        rise = self.rise * (1.0 + hurry * jnp.exp(jnp.minimum(memory.sigma, 0.0))) / (1.0 + (round_ / horizon) ** 4)
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

"""Distributed primal-dual interior-point method for the max-min problem

    max t   subject to   ψ_ik(x) ≥ t.

Agents send quadratic functions to their neighbours, one hop a round (after Khoshfetrat Pakazad, Hansson, Andersen, arXiv 1502.06384, who
sweep the whole tree for each Newton step). Every x is strictly feasible for a low enough t. Agent i holds copies y of the positions that it
needs, a level t_i, multipliers λ_ik > 0 and a barrier parameter μ_i. Each round, with s_k = ψ_k(y) − t_i > 0 and a_k = (∇ψ_k, −1), is

    M   = Σ_k (λ_k/s_k) a_k a_kᵀ − Σ_k λ_k ∇²ψ_k + κ I,     g = −e_t − Σ_k (μ_i/s_k) a_k
    Δ   = −(M + A)⁻¹ (g + A y − b),                          A, b: sums over the neighbours' last quadratics ½ zᵀLz − eᵀz
    y⁺  = y + α Δ,   λ⁺ = λ + (μ/s − λ − (λ/s) aᵀΔ),         shortened so that slacks and multipliers stay positive
    μ⁺  = max(σ λ·s/m,  floor,  μ_j/couple,  apart |t_j − t_i|)
    send j:  the quadratic of M + A − A_j, minimised over all variables not shared with j;  μ_i, t_i

A lost message leaves the last one in force; no synchronization is needed. Only the concave part of ∇²ψ enters M.

Bound. The level travels along a spanning tree. With it each agent sends a quadratic upper bound on Σ λψ over all agents behind the sender,
maximised over the variables that the receiver does not share. The sum of an agent's own part and all received parts bounds the best margin
of the whole team. The bound holds whatever was lost, late or outdated, because any multipliers give a valid bound. An agent whose bound is
below zero knows that the team cannot be satisfied.

Cap. With a cap, the level is at most the cap: the team asks for no more margin, and distant parts of a team need not agree on t. `max-min`
has no cap.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.protocols.base import Known, Solver
from consat.protocols.local.interior import Gains, Interior, Mail, Memory
from consat.protocols.sending import single


class InteriorState(NamedTuple):
    """State of an agent.

    Attributes:
        memory: state of the local step, which contains the estimates.
        inbox: the last message received over each end of a link.
    """

    memory: Memory
    inbox: Mail

    @property
    def x(self) -> Array:
        """(rows, d) its estimates."""
        return self.memory.y

    def changed(self, agents: list[int]) -> InteriorState:
        """State of a team after constraints of these agents have changed: their counts of changes are raised and their bounds dropped, so
        that all proofs restart."""
        changes, bound = np.array(self.memory.changes), np.array(self.memory.bound)
        changes[agents] += 1.0
        bound[agents] = np.inf
        # NumPy arrays are transferred with the next call; a separate transfer to the device takes a sixth of a small round
        return self._replace(memory=self.memory._replace(changes=changes, bound=bound))  # type: ignore[arg-type]

    def begun_anew(self) -> InteriorState:
        """State for a team of another structure: all counts of changes are raised and all bounds dropped."""
        memory = self.memory
        changes = jnp.zeros_like(memory.changes) + jnp.max(memory.changes, initial=0.0) + 1.0
        return self._replace(memory=memory._replace(changes=changes, bound=jnp.full_like(memory.bound, jnp.inf)))


@dataclass(frozen=True)
class InteriorPoint:
    """Gains of the interior-point protocol; the equations are in the module docstring.

    Attributes:
        cap: upper bound on the level, in the team's unit of ψ; None for the exact max-min.
        inertia: lower bound on κ, in units of ∇²ψ. It keeps agents with satisfied constraints in place. Oscillating agents raise their κ.
        centering: σ.
        boundary: largest fraction of any slack or multiplier that one step may remove.
        floor: lower bound on μ, relative to the level or in the team's unit of ψ.
        couple: μ_i is at least μ_j / `couple` for every neighbour j.
        apart: μ_i is at least `apart` · |t_j − t_i| for every neighbour j.
        drop: an agent lowers its level at once to the lowest level received, if the difference exceeds `drop` times its smallest slack.
        warm: number of initial rounds in which an agent maximises the mean of its margins instead. It applies to agents with only quadratic
            ψ and an initial margin below −`far`.
        far: see `warm`; in the team's unit of ψ.
        tolerance: with ``sends=events``, largest difference between a quadratic and what the neighbour holds, as a fraction of its
            largest entry. Levels may differ by μ, barriers by a factor of two. The same fraction holds for a proof while the level is
            below `PROVES`, or without a cap.
        name: name of the protocol in ``--protocol``.
    """

    cap: float | None = 0.3
    inertia: float = 0.03
    centering: float = 0.5
    boundary: float = 0.7
    floor: float = 1e-4
    couple: float = 3.0
    apart: float = 0.3
    drop: float = 3.0
    warm: int = 1
    far: float = 0.0
    tolerance: float = 0.3
    name: str = "interior-point"
    speaks: ClassVar[str] = "pair"
    per: ClassVar[Mapping[str, Any]] = {
        "memory": {"y": "row", "drift": "row", "multiplier": "constraint", **dict.fromkeys(Memory._fields[3:], "agent")},
        "inbox": "pair",
    }

    @property
    def gains(self) -> Gains:
        """The gains as the local step takes them."""
        return Gains(**{field.name: getattr(self, field.name) for field in dataclasses.fields(Gains)})

    def earliest(self, solver: Solver) -> int:
        return solver.hops

    def start(self, x: Array, solver: Solver) -> InteriorState:
        interior = _own(solver)
        return InteriorState(interior.begin(solver.nearby(x), self.gains), interior.silence())

    def speak(self, state: InteriorState, solver: Solver, round_: Array, known: Known) -> tuple[InteriorState, Mail]:
        memory, mail = _own(solver).round(state.memory, state.inbox, known.margin, self.gains)
        return InteriorState(memory, state.inbox), mail

    def news(self, said: Mail, held: Mail, solver: Solver) -> Array:
        def apart(new: Array, old: Array) -> Array:
            axes = tuple(range(1, new.ndim))
            return jnp.abs(new - old).max(axis=axes, initial=0.0) > self.tolerance * jnp.abs(new).max(axis=axes, initial=0.0)

        barrier = jnp.maximum(said.barrier, 0.0)
        differs = (said.barrier < 0) != (held.barrier < 0)
        differs |= apart(said.matrix, held.matrix) | apart(said.vector, held.vector)
        differs |= (jnp.abs(said.level - held.level) > barrier) & (said.barrier >= 0)
        differs |= (said.barrier > 2.0 * held.barrier) | (2.0 * said.barrier < held.barrier)
        new, old = said.proof, held.proof
        proves = (
            (said.changes != held.changes)
            | ((new.weight < 0) != (old.weight < 0))
            | apart(new.matrix, old.matrix)
            | apart(new.vector, old.vector)
        )
        proves |= (said.margin != held.margin) & ~(jnp.abs(said.margin - held.margin) <= EXACTLY)
        return differs | (proves & (True if self.cap is None else said.level < PROVES))

    def brief(self, message: Mail) -> Mail:
        """Proofs are not rounded: rounding them would have to be outward."""
        matrix, vector, barrier, level, margin = map(
            single, (message.matrix, message.vector, message.barrier, message.level, message.margin)
        )  # fmt: skip
        return Mail(matrix, vector, barrier, level, margin, message.changes, message.proof)

    def hear(self, state: InteriorState, message: Mail, arrived: Array, solver: Solver) -> InteriorState:
        def take(new: Array, old: Array) -> Array:
            return jnp.where(arrived.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return state._replace(inbox=jax.tree.map(take, message, state.inbox))

    def proven(self, state: InteriorState, solver: Solver, margin: Array) -> tuple[Array, Array]:
        """What each agent knows about the whole team.

        Args:
            state: state of the agents.
            solver: local computations of the agents.
            margin: (N,) own margin of each agent.

        Returns:
            (N,) an upper bound on the team's best margin, and (N,) the team's present margin.
        """
        interior = _own(solver)
        return state.memory.bound * interior.units.psi, interior.least(state.inbox, margin)


def _own(solver: Solver) -> Interior:
    assert solver.interior is not None, "only for protocols that send one message per pair"
    return solver.interior


PROVES = 0.1
"""Level, in units of ψ, above which no proof of infeasibility is sent: the team is satisfied, or about to be."""
NEARLY, EXACTLY = 0.05, 1e-3
"""A margin is near the best if its gap to the bound is at most `NEARLY` times |bound|, or at most `EXACTLY` in units of ψ."""


def near(bound: Any, least: Any, unit: Any) -> Any:
    """Whether the margin `least` is proven to be near the best.

    Args:
        bound: upper bound on the best margin; +∞ without proof.
        least: the team's margin.
        unit: the team's unit of ψ.
    """
    gap = bound - least
    return (bound < jnp.inf) & ((gap <= NEARLY * abs(bound)) | (gap <= EXACTLY * unit))


def max_min() -> InteriorPoint:
    """`InteriorPoint` without a cap."""
    return InteriorPoint(cap=None, name="max-min")

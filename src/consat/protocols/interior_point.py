"""Max-min by an interior point whose Newton steps are passed along as quadratics, one hop a round (after Khoshfetrat Pakazad, Hansson,
Andersen, arXiv 1502.06384, who sweep the whole tree for each step).

    max t   subject to   ψ_ik(x) ≥ t

has strictly feasible points wherever the team is: lower t. Agent i holds copies y of the positions it needs, a level t_i, multipliers
λ_ik > 0 and a barrier μ_i. In each round, with s_k = ψ_k(y) − t_i > 0 and a_k = (∇ψ_k, −1),

    M   = Σ_k (λ_k/s_k) a_k a_kᵀ − Σ_k λ_k ∇²ψ_k + κ I,     g = −e_t − Σ_k (μ_i/s_k) a_k
    Δ   = −(M + A)⁻¹ (g + A y − b),                          A, b: the neighbours' last quadratics ½ zᵀLz − eᵀz, added up
    y⁺  = y + α Δ,   λ⁺ = λ + (μ/s − λ − (λ/s) aᵀΔ),         cut so that a part of every slack and multiplier is left
    μ⁺  = max(σ λ·s/m,  floor,  μ_j/3,  0.1 |t_j − t_i|)
    send j:  the quadratic of M + A − A_j, minimised over all variables not shared with j;  μ_i, t_i

A lost message leaves the last one in force; nothing has to be in step. Of ∇²ψ only the concave part counts. The level travels along a
spanning tree, and with it a proof: Σ λψ of everything behind the sender, maximised likewise. Own plus all that came is a bound on the best
margin of the whole team, whatever was lost, late or stale, since any multipliers give one. An agent whose bound is below zero knows that
the team cannot be satisfied.

With a cap the level is at most that: no more margin is asked for, and far parts of a team need not agree on t. `max-min` has none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.protocols.base import Known, Solver
from consat.protocols.local.interior import Gains, Interior, Mail, Memory
from consat.protocols.sending import single


class InteriorState(NamedTuple):
    """What an agent remembers.

    Attributes:
        memory: of its own problem, its estimates among it.
        inbox: what it last heard over each end of a link.
    """

    memory: Memory
    inbox: Mail

    @property
    def x(self) -> Array:
        """(rows, d) its estimates."""
        return self.memory.y


@dataclass(frozen=True)
class InteriorPoint:
    """See the module.

    Attributes:
        cap: of the level, in the team's unit of ψ; None for the exact max-min.
        inertia: κ at least, in units of ∇²ψ: keeps agents where they are that have what they need. Agents that swing raise theirs.
        centering: σ.
        boundary: the part of any slack or multiplier that a step may take.
        floor: of μ, relative to the level or in the team's unit of ψ.
        couple: μ_i is at least a neighbour's over this.
        apart: μ_i is at least this part of how far levels differ.
        drop: an agent comes down at once to the lowest level heard, if that is below by more than so many times its least slack.
        warm: rounds in which agents whose margins are below `far` at the start maximise the mean of these first, where all are quadratic.
        far: below minus this, in the team's unit of ψ.
        tolerance: where agents send what is news, by which part of its largest number a quadratic may differ from what the neighbour holds;
            levels may by μ, barriers by a factor of two, and a proof, while the level is below `PROVES` or without a cap, by this part,
            too.
        name: what ``--protocol`` calls it.
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
        "memory": {"y": "row", "multiplier": "constraint", **dict.fromkeys(Memory._fields[2:], "agent")},
        "inbox": "pair",
    }

    @property
    def gains(self) -> Gains:
        """What a step needs to know of them."""
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
        """Proofs stay as they are, since any rounding of theirs would have to be outward."""
        matrix, vector, barrier, level, margin = map(
            single, (message.matrix, message.vector, message.barrier, message.level, message.margin)
        )  # fmt: skip
        return Mail(matrix, vector, barrier, level, margin, message.changes, message.proof)

    def hear(self, state: InteriorState, message: Mail, arrived: Array, solver: Solver) -> InteriorState:
        def take(new: Array, old: Array) -> Array:
            return jnp.where(arrived.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return state._replace(inbox=jax.tree.map(take, message, state.inbox))

    def proven(self, state: InteriorState, solver: Solver, margin: Array) -> tuple[Array, Array]:
        """What each agent knows of the whole team: (N,) a bound on its best margin, and (N,) the margin it has; `margin`: (N,) own."""
        interior = _own(solver)
        return state.memory.bound * interior.units.psi, interior.least(state.inbox, margin)


def _own(solver: Solver) -> Interior:
    assert solver.interior is not None, "of a protocol that speaks to pairs"
    return solver.interior


PROVES = 0.1
"""In units of ψ: a team whose level is above is satisfied, or about to be, and asks for no proof that it cannot be."""
NEARLY, EXACTLY = 0.05, 1e-3
"""Near the best is within this part of the bound, or within `EXACTLY` in units of ψ."""


def near(bound: Any, least: Any, unit: Any) -> Any:
    """Whether a margin is proven to be near the best; bound: on the best, +∞ without proof; unit: of ψ."""
    gap = bound - least
    return (bound < jnp.inf) & ((gap <= NEARLY * abs(bound)) | (gap <= EXACTLY * unit))


def max_min() -> InteriorPoint:
    """The same without a cap."""
    return InteriorPoint(cap=None, name="max-min")

"""Margins, smooth margins and local objectives (paper, section IV-B to IV-D), computed in the log domain.

ᾱ_i = min_k ψ_ik                      agent margin
β̄   = min_i ᾱ_i                      margin of the team
α_i = −(1/ν_α) ln Σ_k e^{−ν_α ψ_ik}   smooth agent margin (eq. 7)
β   = −(1/ν_β) ln Σ_i e^{−ν_β α_i}    smooth margin (eq. 9)
f_i = e^{−ν_β α_i}                    local objective (eq. 15), stored as ln f_i = −ν_β α_i
p_ik = softmax_k(−ν_α ψ_ik)           weights, so that ∇f_i = −ν_β f_i Σ_k p_ik ∇ψ_ik (eq. 17)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from consat.errors import InvalidSettings, shown
from consat.numerics import Groups, float64, on_device, pick, softmax
from consat.problem.constraints.domain import HUGE, Extended, extended
from consat.problem.family import Family
from consat.problem.team import Team
from consat.settings import Ramp, Smoothing

STEEPEST = 600.0
"""Upper limit of ln f_i where f_i itself is computed. An overflow to infinity would give NaN when multiplied by a weight of 0."""


class Nu(NamedTuple):
    """The current smoothing ν_α, ν_β > 0, in units of 1/ψ."""

    alpha: Array | float
    beta: Array | float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SmoothingSchedule:
    """Smoothing over time: ν_α constant, ν_β(t) = min(start + rate·t, to), the paper's ramp (section IV-F). Constant if start = to.

    Attributes:
        nu_alpha: ν_α, in units of 1/ψ.
        start: ν_β(0), in units of 1/ψ.
        to: the final ν_β, in units of 1/ψ.
        rate: increase of ν_β per second.
    """

    nu_alpha: Array
    start: Array
    to: Array
    rate: Array

    @classmethod
    def of(cls, smoothing: Smoothing) -> SmoothingSchedule:
        """The schedule of the smoothing in the settings."""
        beta = smoothing.nu_beta
        start, to, rate = (beta.start, beta.to, beta.rate) if isinstance(beta, Ramp) else (beta, beta, 0.0)
        return cls(*(jnp.asarray(value, dtype=float) for value in (smoothing.nu_alpha, start, to, rate)))

    def at(self, time: Array | float) -> Nu:
        """ν at `time`, s, of a flow."""
        return Nu(self.nu_alpha, jnp.minimum(self.start + self.rate * time, self.to))

    @property
    def final(self) -> Nu:
        """ν after the ramp. Discrete protocols use it from the start."""
        return Nu(self.nu_alpha, self.to)

    @property
    def duration(self) -> float:
        """Duration of the ramp, s; 0 if ν_β is constant."""
        return float((self.to - self.start) / self.rate) if self.to > self.start else 0.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """A family of constraints on the device, with the rows of the state that its functions take.

    Attributes:
        rows: (M_f, arity) int32 row of the state for each argument of ψ.
        parameters: arrays with leading axis M_f.
        weight: (M_f,) positive factors on ψ.
        psi: the shared function; −∞ where ψ is not a finite number, see `consat.problem.constraints.domain`.
    """

    rows: Array
    parameters: Mapping[str, Array]
    weight: Array
    psi: Callable[..., Any] = field(metadata={"static": True})

    @property
    def partial(self) -> bool:
        """Whether ψ may be −∞ at some positions."""
        return isinstance(self.psi, Extended)

    def values(self, x: Array) -> Array:
        """(M_f,) weighted ψ at a state of shape (rows, d); −∞ where ψ is not a finite number."""
        return self.weight * self._of_all(lambda at, p: self.psi(*at, **p), x)

    def gradients(self, x: Array) -> tuple[Array, Array]:
        """(M_f,) values and (arity, d, M_f) gradients with respect to the arguments; 0 where ψ has no gradient."""
        values, gradients = self._of_all(jax.value_and_grad(lambda at, p: self.psi(*at, **p)), x)
        return self.weight * values, self.weight[None, None] * gradients

    def _of_all(self, function: Callable[..., Any], x: Array) -> Any:
        """Apply a function of the (arity, d) arguments and the parameters of one constraint to all M_f; their axis is the last."""
        parameters = {key: jnp.moveaxis(value, 0, -1) for key, value in self.parameters.items()}
        return jax.vmap(function, in_axes=-1, out_axes=-1)(jnp.moveaxis(pick(x, self.rows), 0, -1), parameters)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Objective:
    """The local objectives of a set of agents, as functions of a state of shape (rows, d).

    The set is the whole team, with all estimates as rows, or one agent with its own estimates.

    Attributes:
        batches: one batch per family.
        order: (M,) index of each constraint, in the team's order, in the concatenated batches; None if the two orders are equal.
        owners: groups the constraints, in the order of the concatenated batches, by agent.
        arguments: groups the arguments of all constraints, in the order of the concatenated batches, by row.
    """

    batches: tuple[Batch, ...]
    order: Array | None
    owners: Groups
    arguments: Groups

    @classmethod
    def of(cls, team: Team, rows: Callable[[Family], np.ndarray], count: int) -> Objective:
        """The objectives of all agents of a team.

        Args:
            team: the team.
            rows: function from a family to the (M_f, arity) rows of the state that its constraints take.
            count: number of rows of the state.
        """
        placed = [(family, rows(family)) for family in team.families]
        numbers = np.concatenate([np.zeros(0, dtype=np.int32), *(family.number for family in team.families)])
        in_order = np.array_equal(numbers, np.arange(len(numbers)))
        flat = np.concatenate([np.zeros(0, dtype=np.int32), *(place.ravel() for _, place in placed)])
        owner = np.concatenate([np.zeros(0, dtype=np.int32), *(family.owner for family in team.families)])
        return cls(
            batches=tuple(
                Batch(
                    jnp.asarray(place, dtype=jnp.int32),
                    {key: on_device(value) for key, value in family.parameters.items()},
                    on_device(family.weight),
                    extended(family.psi, family.arity, team.dimension, family.parameters),
                )
                for family, place in placed
            ),
            order=None if in_order else jnp.asarray(np.argsort(numbers), dtype=jnp.int32),
            owners=Groups.of(owner, team.count),
            arguments=Groups.of(flat, count),
        )

    @classmethod
    def at_positions(cls, team: Team) -> Objective:
        """The objectives at one shared (N, d) array of positions, for an observer of the whole team."""
        return cls.of(team, lambda family: family.agents, team.count)

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Objective:
        """The same objectives with new parameter values.

        Args:
            values: for each family, the parameters to replace, (M_f, …).
        """
        batches = tuple(replace(batch, parameters={**batch.parameters, **own}) for batch, own in zip(self.batches, values, strict=True))
        return replace(self, batches=batches)

    def _in_order(self, by_batch: Array) -> Array:
        return by_batch if self.order is None else by_batch[self.order]

    def _values(self, x: Array) -> Array:
        """(M,) all weighted ψ_ik, in the order of the concatenated batches."""
        return jnp.concatenate([jnp.zeros(0), *(batch.values(x) for batch in self.batches)])

    def psi(self, x: Array) -> Array:
        """(M,) all weighted ψ_ik, in the team's order."""
        return self._in_order(self._values(x))

    def agent_margins(self, x: Array) -> Array:
        """(N,) ᾱ_i, +∞ for an agent without constraints."""
        return -self.owners.max(-self._values(x))

    def log_objective(self, x: Array, nu: Nu) -> Array:
        """(N,) ln f_i = −ν_β α_i, −∞ for an agent without constraints."""
        return nu.beta / nu.alpha * self.owners.logsumexp(-nu.alpha * self._values(x))[0]

    def smooth_margin(self, x: Array, nu: Nu) -> Array:
        """β, the smooth margin of all agents together; scalar."""
        return -jax.nn.logsumexp(self.log_objective(x, nu)) / nu.beta

    def multipliers(self, x: Array, nu: Nu) -> Array:
        """(M,) multipliers λ_ik ∝ e^{−ν_β α_i} p_ik, which sum to 1 over all agents and constraints. Large where a constraint binds."""
        log_h, weights = self.owners.logsumexp(-nu.alpha * self._values(x))
        return self._in_order(self.owners.spread(softmax(nu.beta / nu.alpha * log_h)) * weights)

    def ascent(self, x: Array, nu: Nu) -> Array:
        """(rows, d) ∇α_i = Σ_k p_ik ∇ψ_ik: the ascent direction of each agent for its own constraints alone, summed by row."""
        return self._added_up(x, nu, lambda log_h, weights: weights)

    def gradient(self, x: Array, nu: Nu) -> Array:
        """(rows, d) ∇f_i = −ν_β f_i Σ_k p_ik ∇ψ_ik (eq. 17)."""

        def force(log_h: Array, weights: Array) -> Array:
            return -nu.beta * self.owners.spread(jnp.exp(jnp.minimum(nu.beta / nu.alpha * log_h, STEEPEST))) * weights

        return self._added_up(x, nu, force)

    def _added_up(self, x: Array, nu: Nu, weigh: Callable[[Array, Array], Array]) -> Array:
        """(rows, d) the weighted sum of all ∇ψ_ik.

        A constraint with ψ = −∞ has no usable gradient. It is left out, and the softmax runs over the other constraints of its agent.

        Args:
            x: state, (rows, d).
            nu: smoothing.
            weigh: function from ln Σ_k e^{−ν_α ψ_ik}, (N,), and p_ik, (M,), to the (M,) weights.
        """
        values, gradients = zip(*(batch.gradients(x) for batch in self.batches), strict=True) if self.batches else ((), ())
        usable = [
            value if not batch.partial else jnp.where(value >= -HUGE, value, jnp.inf)
            for batch, value in zip(self.batches, values, strict=True)
        ]
        weights = weigh(*self.owners.logsumexp(-nu.alpha * jnp.concatenate([jnp.zeros(0), *usable])))
        ends = np.cumsum([len(value) for value in values])[:-1]
        pieces = [w[None, None] * g for w, g in zip(jnp.split(weights, ends), gradients, strict=True)] if gradients else []
        flat = [jnp.moveaxis(piece, -1, 0).reshape(-1, x.shape[-1]) for piece in pieces]
        return self.arguments.sum(jnp.concatenate([jnp.zeros((0, x.shape[-1])), *flat]))


@jax.jit
def evaluate(observer: Objective, x: Array) -> Array:
    """(M,) all weighted ψ_ik at positions `x`, (N, d). Compiled as one program."""
    return observer.psi(x)


@jax.jit
def weigh(observer: Objective, x: Array, nu: Nu) -> tuple[Array, Array]:
    """(M,) all weighted ψ_ik and (M,) λ_ik at positions `x`, (N, d). Compiled as one program."""
    return observer.psi(x), observer.multipliers(x, nu)


def margin_bounds(team: Team, smooth_margin: float, nu: Nu) -> tuple[float, float]:
    """Bounds on the team's margin: β ≤ β̄ ≤ β + ln(N)/ν_β + ln(m̄)/ν_α (paper, eq. 11). N counts only agents that have constraints.

    Args:
        team: the team.
        smooth_margin: β at some positions.
        nu: the smoothing of β.
    """
    sizes = team.constraints_per_agent
    owners, most = max(int(np.count_nonzero(sizes)), 1), max(int(sizes.max()), 1)
    slack = math.log(owners) / float(nu.beta) + math.log(most) / float(nu.alpha)
    return smooth_margin, smooth_margin + slack


@float64
def margins(team: Team, positions: ArrayLike | Mapping[str, ArrayLike]) -> np.ndarray:
    """(N,) the margin ᾱ_i = min_k ψ_ik of each agent at given positions. It is positive if all constraints of the agent hold.

    +∞ for an agent without constraints. −∞ if one of its ψ is not a finite number, such as log(x) at x = −1.

    Args:
        team: the team.
        positions: (N, d) in the order of ``team.ids``, or a mapping from id to position; length.

    Raises:
        InvalidSettings: the positions do not fit the team.
    """
    x = _formation(team, positions)
    return np.array(_agent_margins(Objective.at_positions(team), on_device(x)))


@jax.jit
def _agent_margins(observer: Objective, x: Array) -> Array:
    return observer.agent_margins(x)


def _formation(team: Team, positions: ArrayLike | Mapping[str, ArrayLike]) -> np.ndarray:
    if not isinstance(team, Team):
        raise InvalidSettings(f"margins takes a team, but got {shown(team)}; of a scenario file, consat.load(FILE).team is one")
    if isinstance(positions, Mapping):
        known = set(team.ids)
        missing, unknown = [agent for agent in team.ids if agent not in positions], [agent for agent in positions if agent not in known]
        if missing or unknown:
            what = f"none of {missing[0]!r}" if missing else f"one of {unknown[0]!r}, who is not in the team"
            raise InvalidSettings(f"positions must hold one position for each of the {team.count} agents, but there is {what}")
        positions = [positions[agent] for agent in team.ids]  # type: ignore[assignment]
    wanted = f"numbers of shape ({team.count}, {team.dimension}): one row an agent, in the order of team.ids"
    try:
        x = np.asarray(positions, dtype=float)
    except (TypeError, ValueError):
        raise InvalidSettings(f"positions are {shown(positions)}, but must be {wanted}") from None
    if x.shape != (team.count, team.dimension):
        raise InvalidSettings(f"positions have shape {x.shape}, but must be {wanted}")
    if not np.isfinite(x).all():
        k = int(np.argmin(np.isfinite(x).all(axis=1)))
        raise InvalidSettings(f"the position of {team.ids[k]!r} is {x[k].tolist()}, but must be finite")
    return x

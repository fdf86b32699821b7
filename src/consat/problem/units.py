"""The natural scales of a team, computed from its constraints. They set ``smoothing: auto`` and the default box of start positions.

A quadratic constraint ψ = ½xᵀHx + b·x + c has the scale |ψ| at its stationary point, s = |c − ½ bᵀH⁺b| (r² for a disc of radius r), and
the length √(2s/‖H‖) (r). An affine constraint has the scale ‖∇ψ‖ times the length of the team. So a team in millimetres and the same
team in kilometres get the same ν·ψ and take the same number of rounds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from consat.numerics import float64, on_device, once
from consat.problem.constraints.curvature import expand
from consat.problem.constraints.domain import HUGE
from consat.problem.constraints.library import farthest
from consat.problem.family import Family
from consat.problem.team import Team
from consat.settings import Smoothing

SHARPNESS = 5.0
"""Product of ν and the scale of ψ, as in the paper (ν = 5, discs of radius 1)."""
MARGIN = 4.0
"""Half width of the start box around the centres of the constraints, in natural lengths (paper: ±4 for discs of radius 1)."""
STRAIGHT = 1e-6
"""Relative cutoff for the eigenvalues of the Hessian of a ψ that is not quadratic. Smaller ones count as 0."""
FLATTER = 0.5
"""A Newton step is taken to reach a stationary point of ψ if the gradient norm falls at least to this fraction."""
BENT = 0.1
"""And if the curvature there is at least this fraction of the one at the origin. A ψ that levels off is flat far away."""
RIM, ROOM = 0.1, 1.0
"""Widest distance outside the region, relative to its reach, at which distant initial estimates are placed; see `Region.nearby`. `RIM` is
for convex teams. `ROOM` is for others, where agents need space to move around one another."""


class Scale(NamedTuple):
    """The natural scales of a team.

    Attributes:
        psi: smallest scale of any ψ, in units of ψ.
        length: natural length of the positions; 1 if no constraint is curved.
        center: (d,) mean of the stationary points of the constraints that read one agent only, length.
        spread: largest distance of such a point from the centre on any axis, length.
        typical: median of the scales of all ψ, in units of ψ.
        extent: bound on how far the constraints may force agents apart, length: the sum of the distances that constraints between agents
            ask for, plus the largest distance from the centre that a constraint on one agent requires.
    """

    psi: float
    length: float
    center: np.ndarray
    spread: float
    typical: float
    extent: float = 0.0

    @property
    def reach(self) -> float:
        """Half width, on each axis, of the box around the centre in which the team is expected to end, length."""
        return MARGIN * self.length + self.spread


class Region(NamedTuple):
    """The box in which a team is expected to end. Every agent knows it.

    Attributes:
        center: (d,) centre of the box, length.
        reach: half width on each axis, length.
    """

    center: jax.Array
    reach: jax.Array

    @classmethod
    def of(cls, size: Scale) -> Region:
        return cls(on_device(size.center), on_device(size.reach))

    def nearby(self, x: jax.Array, convex: bool) -> jax.Array:
        """Move distant positions to the rim of the box.

        Positions inside stay. Others keep their direction from the centre and land between the rim and 1 + `RIM` (or `ROOM`) times the
        reach. The order of distances is kept, so distinct positions stay distinct.

        Args:
            x: (n, d) positions, length.
            convex: whether the team is convex; selects `RIM` or `ROOM`.
        """
        away = (x - self.center[None, :]) / self.reach
        far = jnp.maximum(jnp.max(jnp.abs(away), axis=1, keepdims=True), 1.0)
        return self.center[None, :] + self.reach * away * ((1.0 + (RIM if convex else ROOM) * (1.0 - 1.0 / far)) / far)


@functools.lru_cache(maxsize=16)
@float64
def scale(team: Team) -> Scale:
    """The natural scales of a team; 1 where no constraint gives one. A moving team is measured over all its `instants` together.

    Cached by team.
    """
    measured = [_measure(family, team.dimension) for each in team.instants for family in each.families]
    psi, bend, slope = (np.concatenate([np.zeros(0), *(m[k] for m in measured)]) for k in range(3))
    centers = np.concatenate([np.zeros((0, team.dimension)), *(m[3] for m in measured)])
    curved = np.isfinite(psi) & (psi > 0) & (bend > 0)
    length = float(np.median(np.sqrt(2 * psi[curved] / bend[curved]))) if curved.any() else 1.0
    flat = np.isfinite(slope) & (slope > 0) & ~curved
    sizes = np.concatenate([psi[curved], slope[flat] * length])
    center = centers.mean(axis=0) if len(centers) else np.zeros(team.dimension)
    spread = float(np.abs(centers - center).max(initial=0.0))
    apart = sum(float(m[4].sum()) for m in measured) / len(team.instants)
    asked = [farthest(family.psi, family.parameters, center) for each in team.instants for family in each.families if family.arity == 1]
    smallest, typical = (float(sizes.min()), float(np.median(sizes))) if len(sizes) else (1.0, 1.0)
    return Scale(smallest, length, center, spread, typical, apart + max(asked, default=0.0))


def automatic(size: Scale) -> Smoothing:
    """``smoothing: auto``: ν_α = ν_β = `SHARPNESS` divided by the smallest scale of ψ."""
    nu = SHARPNESS / size.psi
    return Smoothing(nu_alpha=nu, nu_beta=nu)


def start_box(size: Scale) -> tuple[np.ndarray, np.ndarray]:
    """(d,) lower and (d,) upper corner of the default box in which start positions are drawn, length."""
    return size.center - size.reach, size.center + size.reach


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _second_order(
    psi: Callable[..., Any], arity: int, dimension: int, parameters: dict[str, jax.Array], at: jax.Array
) -> tuple[jax.Array, ...]:
    """(M,) values, (M, n) gradients and (M, n, n) Hessians at (M, n) points, n = arity·d."""

    def flat(x: jax.Array, parameters: dict[str, jax.Array]) -> jax.Array:
        return psi(*x.reshape(arity, dimension), **parameters)

    def both(x: jax.Array, parameters: dict[str, jax.Array]) -> tuple[jax.Array, ...]:
        return (*jax.value_and_grad(flat)(x, parameters), jax.hessian(flat)(x, parameters))

    return jax.vmap(both)(at, parameters)


def _measure(family: Family, dimension: int) -> tuple[np.ndarray, ...]:
    """The scales of a family.

    Returns:
        (M,) |ψ| at the stationary point, (M,) ‖H‖, (M,) ‖∇ψ‖ at the origin, (K, d) stationary points of constraints that read one agent,
        and (M,) distances between the agents at the stationary point.
    """
    try:
        value, b, hessian = expand(family.psi, family.arity, dimension, family.parameters, family.size)
    except ValueError:
        return _measure_any(family, dimension)
    hessian = once(hessian)
    finite = np.isfinite(hessian).all(axis=(1, 2))
    usable = np.isfinite(value) & np.isfinite(b).all(axis=1) & finite
    hessian = np.where(np.asarray(finite)[:, None, None], hessian, 0.0)
    value, b = np.where(usable, value, 0.0), np.where(usable[:, None], b, 0.0)
    stationary = -np.matmul(np.linalg.pinv(hessian, hermitian=True), b[..., None])[..., 0]
    bend = np.where(usable, np.abs(np.linalg.eigvalsh(hessian)).max(axis=1, initial=0.0), 0.0)
    psi_there = np.abs(value + 0.5 * np.einsum("mi,mi->m", b, stationary)) * family.weight
    centers = stationary[(bend > 0)] if family.arity == 1 else np.zeros((0, dimension))
    return psi_there, bend * family.weight, np.linalg.norm(b, axis=1) * family.weight, centers, _between(stationary, family.arity)


def _between(stationary: np.ndarray, arity: int) -> np.ndarray:
    """(M,) largest distance from the first position to another one, in (M, arity·d) points; 0 if arity is 1."""
    x = stationary.reshape(len(stationary), arity, -1)
    return np.asarray(np.linalg.norm(x - x[:, :1], axis=2).max(axis=1, initial=0.0))


def _measure_any(family: Family, dimension: int) -> tuple[np.ndarray, ...]:
    """As `_measure`, for ψ that is not a quadratic: one Newton step from the origin.

    The step counts if the gradient norm falls to `FLATTER` of its value and the curvature does not fall below `BENT` of its value.
    Otherwise ψ is treated as affine, with its gradient at the origin.
    """

    def look(at: np.ndarray) -> tuple[np.ndarray, ...]:
        value, slope, hessian = (
            np.asarray(part) for part in _second_order(family.psi, family.arity, dimension, dict(family.parameters), on_device(at))
        )
        usable = (np.abs(value) <= HUGE) & (np.abs(slope) <= HUGE).all(axis=1) & (np.abs(hessian) <= HUGE).all(axis=(1, 2))
        return usable, *(np.where(usable.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0) for part in (value, slope, hessian))

    usable, _, slope, hessian = look(np.zeros((family.size, family.arity * dimension)))
    before = np.abs(np.linalg.eigvalsh(hessian)).max(axis=1, initial=0.0)
    stationary = -np.matmul(np.linalg.pinv(hessian, STRAIGHT, hermitian=True), slope[..., None])[..., 0]
    there, value, flatter, hessian = look(stationary)
    steep = np.linalg.norm(slope, axis=1)
    bend = np.abs(np.linalg.eigvalsh(hessian)).max(axis=1, initial=0.0)
    curved = usable & there & (np.linalg.norm(flatter, axis=1) <= FLATTER * steep) & (bend >= BENT * before)
    bend = np.where(curved, bend, 0.0)
    centers = stationary[bend > 0] if family.arity == 1 else np.zeros((0, dimension))
    between = np.where(curved, _between(stationary, family.arity), 0.0)
    return np.abs(value) * family.weight, bend * family.weight, steep * family.weight, centers, between

"""Second-order expansions of the constraints about a formation, as arrays. The exact tests, the optimum and the certificate use them.

    ψ_k(x₀ + y) = c_k + b_k·y + ½ yᵀH_k y,    c_k = ψ_k(x₀),  b_k = ∇ψ_k(x₀)

The expansion is exact for constraints of degree ≤ 2. A ψ that is −∞ at x₀, or has no finite gradient, is left out; see
`consat.problem.constraints.domain`. The expansion point is a formation near the solution. About the origin, the coefficients of a team far
away (a disc of radius 1 at 1e6) would lose their digits.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import sparse

from consat.numerics import float64, on_device, once
from consat.problem.constraints.curvature import Curvature, hessians, read_curvatures
from consat.problem.constraints.domain import HUGE, Extended
from consat.problem.family import Family
from consat.problem.team import Team

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Shape:
    """Proven properties of the constraints of a team.

    Attributes:
        curvature: (M,) of `Curvature`, in all positions jointly.
        strict_in_own: (M,) whether ψ is strictly concave in the owner's position, with the others fixed.
        quadratic: (M,) whether ψ is a polynomial of degree ≤ 2.
        concave: (M,) whether ψ is concave in all positions jointly.
        convex: (M,) whether ψ is convex in all positions jointly.
        hessians: for each family the (M_f, n, n) constant weighted Hessians, n = arity·d; None if its degree is above 2 or unknown.
    """

    curvature: NDArray[np.object_]
    strict_in_own: Bools
    quadratic: Bools
    concave: Bools
    convex: Bools
    hessians: tuple[Floats | None, ...]

    @property
    def wild(self) -> bool:
        """Whether some ψ is neither concave nor convex nor quadratic."""
        return not (self.concave | self.convex | self.quadratic).all()


@functools.lru_cache(maxsize=16)
def shape_of(team: Team) -> Shape:
    """The proven curvature of all constraints of a team. Cached by team."""
    count = len(team.owner)
    curvature = np.full(count, Curvature.UNKNOWN, dtype=object)
    strict, quadratic, concave, convex = np.zeros((4, count), dtype=bool)
    constant: list[Floats | None] = []
    for family in team.families:
        readings = read_curvatures(family.psi, family.arity, team.dimension, family.lasting, family.size)
        curvature[family.number] = once(readings.curvature)
        concave[family.number] = readings.concave
        convex[family.number] = readings.convex
        strict[family.number] = np.any(once(readings.strict_in) & (family.agents == family.owner[:, None]), axis=1)
        quadratic[family.number] = readings.degree is not None
        constant.append(None if readings.degree is None else _hessians(family, team.dimension))
    return Shape(curvature, strict, quadratic, concave, convex, tuple(constant))


def _hessians(family: Family, dimension: int) -> Floats:
    constant = hessians(family.psi, family.arity, dimension, family.lasting, family.size)
    return constant if (family.weight == 1.0).all() else constant * family.weight[:, None, None]


@dataclass(frozen=True)
class Block:
    """Expansions of m constraints of one family, each in its own coordinates y_local = y.ravel()[columns].

    Attributes:
        number: (m,) indices of the constraints in the team's order.
        columns: (m, n) coordinates that each reads, n = arity·d; coordinate d·i + k is axis k of agent i.
        gradient: (m, n) b.
        hessian: (m, n, n) H; read-only.
    """

    number: Ints
    columns: Ints
    gradient: Floats
    hessian: Floats

    def take(self, members: Bools) -> Block:
        """The block of a subset of the constraints, given by an (m,) mask."""
        if members.all():
            return self
        return Block(self.number[members], self.columns[members], self.gradient[members], self.hessian[members])


@dataclass(frozen=True)
class Expansion:
    """Second-order expansion of the constraints of a team about a formation.

    Attributes:
        at: (N, d) formation x₀, length.
        value: (M,) c, in the team's order; −∞ where ψ is not a finite number.
        blocks: one block per family, with the constraints that have an expansion.
    """

    at: Floats
    value: Floats
    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """Number of coordinates, N·d."""
        return self.at.size

    def keep(self, constraints: Bools) -> Expansion:
        """The expansion with only the constraints of an (M,) mask in its blocks. The others keep their entry in `value`."""
        blocks = (block.take(constraints[block.number]) for block in self.blocks)
        return Expansion(self.at, self.value, tuple(block for block in blocks if len(block.number)))

    @property
    def known(self) -> Bools:
        """(M,) which constraints have an expansion."""
        found = np.zeros(len(self.value), dtype=bool)
        for block in self.blocks:
            found[block.number] = True
        return found

    def inverse_bend(self) -> Floats:
        """(M,) 1/‖H_k‖, weights with which all curved constraints count alike; 0 for those that are affine or have no expansion."""
        weights = np.zeros(len(self.value))
        for block in self.blocks:
            norm = np.linalg.norm(block.hessian, axis=(1, 2))
            weights[block.number] = np.where(norm > 0, 1.0 / np.where(norm > 0, norm, 1.0), 0.0)
        return weights

    def values(self, y: Floats) -> Floats:
        """(M,) values of the expansion at x₀ + y, y of shape (N, d). Constraints without a block have the value c."""
        total, flat = self.value.copy(), y.ravel()
        for block in self.blocks:
            local = flat[block.columns]
            slope = block.gradient + 0.5 * np.matmul(block.hessian, local[..., None])[..., 0]
            total[block.number] += np.sum(slope * local, axis=1)
        return total

    def gradient(self, weights: Floats, y: Floats | None = None) -> Floats:
        """(N, d) gradient of Σ_k weights_k ψ_k at x₀ + y; at x₀ if y is None."""
        total = np.zeros(self.size)
        for block in self.blocks:
            slope = block.gradient
            if y is not None:
                slope = slope + np.matmul(block.hessian, y.ravel()[block.columns][..., None])[..., 0]
            weighted = weights[block.number][:, None] * slope
            total += np.bincount(block.columns.ravel(), weighted.ravel(), minlength=self.size)
        return total.reshape(self.at.shape)

    def jacobian(self) -> sparse.csr_array:
        """(M, N·d) sparse matrix with the rows b_k."""
        shape = (len(self.value), self.size)
        rows = _joined([np.repeat(block.number, block.columns.shape[1]) for block in self.blocks], int)
        columns = _joined([block.columns.ravel() for block in self.blocks], int)
        entries = _joined([block.gradient.ravel() for block in self.blocks], float)
        return sparse.csr_array((entries, (rows, columns)), shape=shape)

    def hessian(self, weights: Floats) -> sparse.csc_array:
        """(N·d, N·d) sparse Σ_k weights_k H_k."""
        rows, columns, entries = [], [], []
        for block in self.blocks:
            n = block.columns.shape[1]
            rows.append(np.repeat(block.columns, n, axis=1).ravel())
            columns.append(np.tile(block.columns, (1, n)).ravel())
            entries.append((weights[block.number][:, None, None] * block.hessian).ravel())
        where = (_joined(rows, int), _joined(columns, int))
        return sparse.csc_array((_joined(entries, float), where), shape=(self.size, self.size))


def _joined(parts: Sequence[NDArray[Any]], kind: type) -> NDArray[Any]:
    return np.concatenate([np.zeros(0, dtype=kind), *parts])


_Device = tuple[jax.tree_util.Partial, Array, dict[str, Array], Array]
"""A family on the device: ψ, agents, parameters, weight."""


@jax.jit
def _tangents(family: _Device, arguments: Array) -> tuple[Array, Array]:
    def member(arguments: Array, parameters: dict[str, Array], weight: Array) -> tuple[Array, Array]:
        value, slope = jax.value_and_grad(lambda at: weight * family[0](*at, **parameters))(arguments)
        usable = (jnp.abs(value) <= HUGE) & jnp.all(jnp.abs(slope) <= HUGE)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf), jnp.where(usable, slope, jnp.nan)

    return jax.vmap(member)(arguments, family[2], family[3])


@jax.jit
def _first_order(families: list[_Device], x: Array) -> list[tuple[Array, Array]]:
    return [_tangents(family, x[family[1]]) for family in families]


@jax.jit
def _second_order(psi: jax.tree_util.Partial, agents: Array, parameters: dict[str, Array], weight: Array, x: Array) -> Array:
    def member(flat: Array, parameters: dict[str, Array], weight: Array) -> Array:
        return weight * Extended(psi)(*flat.reshape(agents.shape[1], x.shape[1]), **parameters)

    return jax.vmap(jax.jacfwd(jax.grad(member)))(x[agents].reshape(agents.shape[0], -1), parameters, weight)


@functools.lru_cache(maxsize=16)
def _on_device(team: Team) -> list[_Device]:
    return [
        (
            jax.tree_util.Partial(family.psi),
            on_device(family.agents),
            {key: on_device(value) for key, value in family.parameters.items()},
            on_device(family.weight),
        )
        for family in team.families
    ]


@functools.lru_cache(maxsize=16)
def columns_of(team: Team) -> tuple[Ints, ...]:
    """For each family the (M_f, n) coordinates that its constraints read, as in `Block`. Cached by team."""
    axes = np.arange(team.dimension)
    return tuple(
        (family.agents.astype(np.intp)[:, :, None] * team.dimension + axes).reshape(family.size, family.arity * team.dimension)
        for family in team.families
    )


@float64
def values_and_gradients(team: Team, x: Floats) -> tuple[Floats, list[Floats]]:
    """Values and gradients of all constraints at (N, d) positions.

    Returns:
        (M,) weighted ψ, −∞ where ψ is not a finite number; and for each family its (M_f, arity, d) gradients, NaN where the value or the
        gradient is not finite or is beyond `HUGE`.
    """
    total, gradients = np.zeros(len(team.owner)), []
    for family, (value, gradient) in zip(team.families, _first_order(_on_device(team), on_device(x)), strict=True):
        total[family.number] = np.asarray(value)
        gradients.append(np.asarray(gradient))
    return total, gradients


@float64
def tangents(team: Team, family: int, arguments: Floats) -> tuple[Floats, Floats]:
    """(M_f,) weighted ψ and (M_f, arity, d) gradients of one family, with separate arguments for each constraint.

    Args:
        team: the team.
        family: index of the family.
        arguments: (M_f, arity, d) positions, length.

    Returns:
        as `values_and_gradients`.
    """
    value, gradient = _tangents(_on_device(team)[family], on_device(arguments))
    return np.asarray(value), np.asarray(gradient)


@float64
def expand(team: Team, at: Floats) -> Expansion:
    """The second-order expansion of all constraints of a team about the (N, d) formation `at`."""
    at = np.asarray(at, dtype=float)
    value, gradients = values_and_gradients(team, at)
    blocks = []
    for family, device, columns, gradient, constant in zip(
        team.families, _on_device(team), columns_of(team), gradients, shape_of(team).hessians, strict=True
    ):
        hessian = np.asarray(_second_order(*device, on_device(at))) if constant is None else constant
        whole = Block(family.number, columns, gradient.reshape(columns.shape), hessian)
        block = whole.take(np.asarray(np.isfinite(whole.gradient).all(axis=1)))
        if len(block.number) or not len(whole.number):
            blocks.append(block)
    return Expansion(at, value, tuple(blocks))

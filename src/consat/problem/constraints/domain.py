"""Functions ψ that are not finite everywhere, such as 1/‖p − q‖², log and sqrt(4 − ‖p‖²). Where ψ is not a finite number, it counts as −∞.

`Extended` returns this value, and derivatives that are always finite: 0 where ψ has no finite derivative. `jnp.where` on the result is not
enough: reverse-mode differentiation multiplies the NaN of the unused branch by 0, which is NaN. Therefore the derivatives are computed
separately, checked, and given to JAX as custom derivatives.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.problem.constraints.curvature import degree

Psi = Callable[..., Any]

HUGE: Final = 1e100
"""Largest usable size of ψ and its derivatives. Beyond it, squares may overflow; such a value is treated like −∞."""


@dataclass(frozen=True)
class Extended:
    """ψ extended by −∞ where it is not a finite number, with first and second derivatives of 0 where they are not finite.

    Two instances are equal if their ψ is, so compiled programs are shared. There are no derivatives with respect to the parameters.

    Attributes:
        psi: ``psi(*positions, **parameters) -> scalar``.
    """

    psi: Psi

    def __call__(self, *positions: Array, **parameters: Any) -> Array:
        value: Array = _value(self.psi, positions, parameters)
        return value


def extended(psi: Psi, arity: int, dimension: int, parameters: Mapping[str, np.ndarray]) -> Psi:
    """ψ itself if it is a polynomial of degree ≤ 2, which is finite everywhere; else `Extended`.

    Args:
        psi: as in `Extended`.
        arity: number of positions ψ takes.
        dimension: d, the length of each position.
        parameters: keyword arguments of ψ, with the members of the family along axis 0.
    """
    shapes = tuple((key, np.shape(value)[1:], np.asarray(value).dtype.str) for key, value in sorted(parameters.items()))
    return psi if _is_quadratic(psi, arity, dimension, shapes) else Extended(psi)


@functools.lru_cache(maxsize=256)
def _is_quadratic(psi: Psi, arity: int, dimension: int, shapes: tuple[tuple[str, tuple[int, ...], str], ...]) -> bool:
    return degree(psi, arity, dimension, {key: np.zeros(shape, dtype) for key, shape, dtype in shapes}) is not None


def _all_usable(arrays: Any) -> Array:
    return functools.reduce(jnp.logical_and, [jnp.all(jnp.abs(leaf) <= HUGE) for leaf in jax.tree.leaves(arrays)])


def _where(usable: Array, arrays: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.where(usable, leaf, jnp.zeros_like(leaf)), arrays)


def _dot(slopes: Any, moves: Any) -> Array:
    """The sum over all positions of slope · move."""
    return functools.reduce(jnp.add, [jnp.sum(slope * move) for slope, move in zip(slopes, moves, strict=True)])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _value(psi: Psi, positions: tuple[Array, ...], parameters: Mapping[str, Any]) -> Array:
    value = psi(*positions, **parameters)
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _value_and_slopes(psi: Psi, positions: tuple[Array, ...], parameters: Mapping[str, Any]) -> tuple[Array, tuple[Array, ...]]:
    value, slopes = jax.value_and_grad(lambda at: psi(*at, **parameters))(positions)
    value = jnp.where(jnp.isfinite(value), value, -jnp.inf)
    return value, _where(_all_usable((value, slopes)), slopes)


@_value.defjvp
def _first_order(psi: Psi, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    value, slopes = _value_and_slopes(psi, *primals)
    return value, _dot(slopes, tangents[0])


@_value_and_slopes.defjvp
def _second_order(psi: Psi, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    (positions, parameters), moves = primals, tangents[0]
    value, slopes = _value_and_slopes(psi, positions, parameters)
    bends = jax.hessian(lambda at: psi(*at, **parameters))(positions)
    bends = _where(_all_usable((value, slopes, bends)), bends)
    turns = tuple(functools.reduce(jnp.add, [block @ move for block, move in zip(row, moves, strict=True)]) for row in bends)
    return (value, slopes), (_dot(slopes, moves), turns)

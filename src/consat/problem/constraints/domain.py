"""ψ that end somewhere: 1/‖p − q‖², log, sqrt(4 − ‖p‖²), e^{…}. A ψ that is not a finite number at a point is −∞ there (design,
section 10).

`Extended` gives a ψ that value, and derivatives that are finite wherever they are asked for: 0 where ψ has none that are. A select after
the fact would not do: differentiated backwards it multiplies the NaN of the branch not taken by 0. So the derivatives are computed
apart, checked, and handed to JAX as those of the function.
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
"""A ψ below −HUGE, or a derivative beyond it, is of no use to arithmetic: its square overflows. It counts as a wall, as −∞ does."""


@dataclass(frozen=True)
class Extended:
    """ψ with −∞ where it is no finite number, and derivatives, up to the second, that are 0 where they are none.

    Equal to another if ψ is, so that a program compiled for one serves the other. Parameters have no derivatives here.

    Attributes:
        psi: ``psi(*positions, **parameters) -> scalar``.
    """

    psi: Psi

    def __call__(self, *positions: Array, **parameters: Any) -> Array:
        value: Array = _value(self.psi, positions, parameters)
        return value


def extended(psi: Psi, arity: int, dimension: int, parameters: Mapping[str, np.ndarray]) -> Psi:
    """ψ itself if it is a polynomial of degree ≤ 2, which is finite everywhere and pays nothing; else `Extended`.

    Args:
        psi: as in `Extended`.
        arity: number of positions it takes.
        dimension: d, the length of each.
        parameters: its keyword arguments, with the members of a family along their first axis.
    """
    shapes = tuple((key, np.shape(value)[1:], np.asarray(value).dtype.str) for key, value in sorted(parameters.items()))
    return psi if _is_quadratic(psi, arity, dimension, shapes) else Extended(psi)


@functools.lru_cache(maxsize=256)
def _is_quadratic(psi: Psi, arity: int, dimension: int, shapes: tuple[tuple[str, tuple[int, ...], str], ...]) -> bool:
    found = degree(psi, arity, dimension, {key: np.zeros(shape, dtype) for key, shape, dtype in shapes})
    return found is not None and found <= 2


def _all_usable(arrays: Any) -> Array:
    return functools.reduce(jnp.logical_and, [jnp.all(jnp.abs(leaf) <= HUGE) for leaf in jax.tree.leaves(arrays)])


def _where(usable: Array, arrays: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.where(usable, leaf, jnp.zeros_like(leaf)), arrays)


def _dot(slopes: Any, moves: Any) -> Array:
    """Σ over all positions."""
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

"""ln f of the agents of a batch, with its slope and curvature; the agents are the last axis of every array, the lanes.

    L = ν_β/ν_α [ln Σ_k e^{s ν_α v_k}/m]/s + …,    v_k = −ψ_k,    p = softmax(s ν_α v)
    ∇L  = ν_β ḡ,  ḡ = Σ_k p_k ∇v_k
    ∇²L = ν_β (Σ_k p_k ∇²v_k + s ν_α Σ_k p_k (∇v_k − ḡ)(∇v_k − ḡ)ᵀ)

Sums run in a fixed order, and no lane knows how many others there are: what an agent computes is the same alone and among a million.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.objective import Nu
from consat.prox.batches import Batch, Form, Kind

FEW = 24
"""Up to so many terms are added one by one."""
UNROLLED = 8
"""Systems of up to so many unknowns are eliminated by a program written out, …"""
LOOPED = 24
"""… of up to so many by a loop, and larger ones by LAPACK."""


def add_up(terms: Array | Sequence[Array]) -> Array:
    """Σ over the first axis, in order while there are few."""
    return functools.reduce(operator.add, list(terms)) if len(terms) <= FEW else jnp.sum(jnp.asarray(terms), axis=0)


def dot(a: Array, b: Array) -> Array:
    """(n, A), (n, A) → (A,)."""
    return add_up(a * b)


class Expanded(NamedTuple):
    """L to second order.

    Attributes:
        level: (A,) L.
        slope: (N, A) ∇L, N = n·d.
        bend: (N, N, A) ∇²L.
        safe: the same without what is not convex; None where that is not known apart.
    """

    level: Array
    slope: Array
    bend: Array
    safe: Array | None


@dataclass(frozen=True)
class Lanes:
    """The objectives of the agents of one chunk.

    Attributes:
        batch: what is known of them; its arrays are not used.
        kinds: their constraints, without the axis of chunks.
        nu: the smoothing.
        offset: (A,) added to L.
    """

    batch: Batch
    kinds: tuple[Kind, ...]
    nu: Nu
    offset: Array

    def violations(self, y: Array) -> Array:
        """(m, A) −ψ_k at y, (n, d, A); −∞ where padded."""
        return jnp.concatenate([_violations(form, kind, y) for form, kind in zip(self.batch.forms, self.kinds, strict=True)])

    def count(self, violations: Array) -> Array:
        """(A,) how many constraints each agent has."""
        return add_up((violations > -jnp.inf).astype(violations.dtype))

    def level(self, y: Array, sharpness: Array) -> Array:
        """(A,) L at y, (n, d, A), with a soft minimum of this sharpness in (0, 1], (A,): from the mean (0) to the true one (1)."""
        return self._soft(self.violations(y), sharpness)[0]

    def _soft(self, violations: Array, sharpness: Array) -> tuple[Array, Array]:
        """(A,) L and (m, A) the weights p."""
        if len(violations) == 1:  # nothing to be soft about
            return self.nu.beta * violations[0] + self.offset, jnp.ones_like(violations)
        count = jnp.log(self.count(violations))
        scaled = (sharpness * self.nu.alpha)[None] * violations
        top = jnp.max(scaled, axis=0)
        powers = jnp.exp(scaled - top[None])
        total = add_up(powers)
        blunt = top + jnp.log(total) - count
        return self.nu.beta / self.nu.alpha * (blunt / sharpness + count) + self.offset, powers / total[None]

    def expand(self, y: Array, sharpness: Array) -> Expanded:
        """L to second order at y, (n, d, A)."""
        if not self.batch.known:
            return self._expand_any(y, sharpness)
        n, d, lanes = y.shape
        values, gradients, bends, safes = [], [], [], []
        for form, kind in zip(self.batch.forms, self.kinds, strict=True):
            value, slope = _slopes(form, kind, y)
            values.append(value)
            assert form.slots is not None
            assert form.bend is not None
            for k, slots in enumerate(form.slots):
                gradients.append(_placed(slope[k], slots, n))
                bend, safe = _constant(form.bend, slots, n, d)
                weight = 1.0 if kind.weight is None else kind.weight[k]
                bends.append((bend, weight))
                safes.append((safe, weight))
        level, p = self._soft(jnp.concatenate(values), sharpness)
        mean = add_up([p[k][None] * g for k, g in enumerate(gradients)])
        spread: Array | float = 0.0
        if len(gradients) > 1:
            away = [g - mean for g in gradients]
            spread = (sharpness * self.nu.alpha)[None, None] * add_up([(p[k][None] * a)[:, None] * a[None] for k, a in enumerate(away)])

        def curvature(constant: list[tuple[np.ndarray, Array | float]]) -> Array:
            bent = [(jnp.asarray(matrix), p[k] * weight) for k, (matrix, weight) in enumerate(constant) if matrix.any()]
            terms = [matrix[:, :, None] * weight[None, None] for matrix, weight in bent]
            return self.nu.beta * ((add_up(terms) if terms else jnp.zeros((n * d, n * d, lanes))) + spread)

        return Expanded(level, self.nu.beta * mean, curvature(bends), None if self.batch.convex else curvature(safes))

    def _expand_any(self, y: Array, sharpness: Array) -> Expanded:
        """The same for any ψ and any pattern, by automatic differentiation, an agent at a time."""
        n, d, _ = y.shape

        def one(flat: Array, kinds: tuple[Kind, ...], offset: Array, sharpness: Array) -> tuple[Array, Array, Array]:
            alone = Lanes(self.batch, jax.tree.map(lambda leaf: leaf[..., None], kinds), self.nu, offset[None])

            def level(flat: Array) -> Array:
                return alone.level(flat.reshape(n, d, 1), sharpness[None])[0]

            bend, (value, slope) = jax.jacfwd(lambda at: _twice(level, at), has_aux=True)(flat)
            return value, slope, bend

        found = jax.vmap(one, in_axes=-1, out_axes=-1)(y.reshape(n * d, -1), self.kinds, self.offset, sharpness)
        return Expanded(*found, None)


def _twice(function: Callable[[Array], Array], y: Array) -> tuple[Array, tuple[Array, Array]]:
    value, slope = jax.value_and_grad(function)(y)
    return slope, (value, slope)


def _arguments(form: Form, kind: Kind, y: Array) -> Array:
    """(m, arity, d, A) the positions that each ψ takes."""
    if form.slots is not None:
        return jnp.stack([jnp.stack([y[slot] for slot in slots]) for slots in form.slots])
    assert kind.slots is not None
    m, arity, _ = kind.slots.shape
    flat = kind.slots.reshape(m * arity, 1, -1)
    return jnp.take_along_axis(y, flat, axis=0).reshape(m, arity, y.shape[1], -1)


def _along(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one constraint of one agent, for all of both."""
    return jax.vmap(jax.vmap(function, in_axes=-1, out_axes=-1))


def _masked(kind: Kind, values: Array) -> Array:
    weighted = values if kind.weight is None else kind.weight * values
    return weighted if kind.used is None else jnp.where(kind.used, weighted, -jnp.inf)


def _violations(form: Form, kind: Kind, y: Array) -> Array:
    return _masked(kind, _along(lambda x, p: -form.psi(*x, **p))(_arguments(form, kind, y), kind.parameters))


def _slopes(form: Form, kind: Kind, y: Array) -> tuple[Array, Array]:
    """(m, A) −ψ and (m, arity, d, A) its gradients."""
    function = jax.value_and_grad(lambda x, p: -form.psi(*x, **p))
    values, slopes = _along(function)(_arguments(form, kind, y), kind.parameters)
    if kind.weight is not None:
        slopes = kind.weight[:, None, None] * slopes
    return _masked(kind, values), slopes if kind.used is None else jnp.where(kind.used[:, None, None], slopes, 0.0)


def _placed(slope: Array, slots: tuple[int, ...], n: int) -> Array:
    """(arity, d, A) → (n·d, A): on the rows that the constraint reads."""
    nothing = jnp.zeros_like(slope[0])
    return jnp.concatenate([slope[slots.index(row)] if row in slots else nothing for row in range(n)])


@functools.cache
def _constant(bend: tuple[tuple[float, ...], ...], slots: tuple[int, ...], n: int, d: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, N) ∇²v on all rows, and its convex part."""
    matrix = np.array(bend)
    values, vectors = np.linalg.eigh(matrix)
    index = (np.array(slots)[:, None] * d + np.arange(d)).ravel()
    whole = np.zeros((2, n * d, n * d))
    whole[0][np.ix_(index, index)] = matrix
    whole[1][np.ix_(index, index)] = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return whole[0], whole[1]


def solve_symmetric(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Solve a system in every lane.

    Args:
        matrix: (N, N, A) symmetric.
        right: (N, r, A).

    Returns:
        (N, r, A) the solutions, and (A,) whether the matrix is positive definite.
    """
    size = len(matrix)
    if size > LOOPED:
        first = jnp.moveaxis(matrix, -1, 0)
        found = jnp.moveaxis(jnp.linalg.solve(first, jnp.moveaxis(right, -1, 0)), 0, -1)
        return found, jnp.linalg.eigvalsh(first)[:, 0] > 0 if size <= 4 * LOOPED else jnp.ones(matrix.shape[-1], bool)
    whole = jnp.concatenate([matrix, right], axis=1)
    return _looped(whole, size) if size > UNROLLED else _unrolled(whole, size)


def _unrolled(whole: Array, size: int) -> tuple[Array, Array]:
    """LDLᵀ. Each step goes into the array as it stands, which keeps the compiler from computing earlier steps over and over."""
    put = jax.lax.dynamic_update_slice
    for j in range(size - 1):
        factor = whole[j + 1 :, j] / whole[j, j][None]
        whole = put(whole, whole[j + 1 :, j + 1 :] - factor[:, None] * whole[j, j + 1 :][None], (j + 1, j + 1, 0))
    positive = functools.reduce(operator.and_, [whole[j, j] > 0 for j in range(size)])
    matrix, right = whole[:, :size], whole[:, size:]
    for j in reversed(range(size)):
        right = put(right, (right[j] / matrix[j, j][None])[None], (j, 0, 0))
        if j:
            right = put(right, right[:j] - matrix[:j, j][:, None] * right[j][None], (0, 0, 0))
    return right, positive


def _looped(whole: Array, size: int) -> tuple[Array, Array]:
    """Gauss and Jordan, without exchanges, which a positive definite matrix does not need."""

    def eliminate(j: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        whole, positive = at
        pivot = whole[j, j]
        row = whole[j] / pivot[None]
        factor = jnp.where(jnp.arange(size)[:, None] == j, 0.0, whole[:, j])
        return (whole - factor[:, None] * row[None]).at[j].set(row), positive & (pivot > 0)

    whole, positive = jax.lax.fori_loop(0, size, eliminate, (whole, jnp.ones(whole.shape[-1], bool)))
    return whole[:, size:], positive

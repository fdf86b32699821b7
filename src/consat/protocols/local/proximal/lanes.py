"""ln f of the agents of a batch, its gradient and its Hessian. The last axis of every array is the agent (the lane), size A.

    L = ν_β/ν_α [ln Σ_k e^{s ν_α v_k}/m]/s + …,    v_k = −ψ_k,    p = softmax(s ν_α v)
    ∇L  = ν_β ḡ,  ḡ = Σ_k p_k ∇v_k
    ∇²L = ν_β (Σ_k p_k ∇²v_k + s ν_α Σ_k p_k (∇v_k − ḡ)(∇v_k − ḡ)ᵀ)

Here v_k is the violation of constraint k, s the sharpness of the soft minimum in (0, 1], and m the number of constraints of the agent.

Sums have a fixed order, and no lane depends on the number of lanes: the result of an agent is the same alone and in a large team.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import add_up
from consat.problem.constraints.domain import HUGE
from consat.problem.objective import Nu
from consat.protocols.local.lanewise import along, arguments
from consat.protocols.local.proximal.batches import Batch, Form, Kind, Matrix
from consat.protocols.local.proximal.hessians import Alike, Dense


class Expanded(NamedTuple):
    """Second-order expansion of L; N = n·d.

    Attributes:
        level: (A,) L.
        slope: (N, A) ∇L.
        bend: ∇²L.
    """

    level: Array
    slope: Array
    bend: Dense | Alike


@dataclass(frozen=True)
class Lanes:
    """The objectives of the agents of one chunk.

    Attributes:
        batch: static properties of the agents; its arrays are not used.
        kinds: the constraints, without the axis of chunks.
        nu: the smoothing.
        offset: (A,) added to L.
    """

    batch: Batch
    kinds: tuple[Kind, ...]
    nu: Nu
    offset: Array

    def violations(self, y: Array) -> Array:
        """(m, A) −ψ_k at `y`, (n, d, A); −∞ where padded."""
        return jnp.concatenate([_violations(form, kind, y) for form, kind in zip(self.batch.forms, self.kinds, strict=True)])

    def count(self, violations: Array) -> Array:
        """(A,) number of constraints of each agent."""
        return add_up((violations > -jnp.inf).astype(violations.dtype))

    def level(self, y: Array, sharpness: Array) -> Array:
        """(A,) L at `y`, (n, d, A), with a soft minimum of the given sharpness, (A,): 1 is the soft minimum of the objective, towards 0 it
        becomes the mean."""
        return self._soft(self.violations(y), sharpness)[0]

    def _soft(self, violations: Array, sharpness: Array) -> tuple[Array, Array]:
        """(A,) L and (m, A) the weights p."""
        if self.batch.partial:
            return self._soft_within(violations, sharpness)
        if len(violations) == 1:  # the minimum of one constraint needs no smoothing
            return self.nu.beta * violations[0] + self.offset, jnp.ones_like(violations)
        count = jnp.log(self.count(violations))
        scaled = (sharpness * self.nu.alpha)[None] * violations
        top = jnp.max(scaled, axis=0)
        powers = jnp.exp(scaled - top[None])
        total = add_up(powers)
        blunt = top + jnp.log(total) - count
        return self.nu.beta / self.nu.alpha * (blunt / sharpness + count) + self.offset, powers / total[None]

    def _soft_within(self, violations: Array, sharpness: Array) -> tuple[Array, Array]:
        """`_soft` for ψ that may be −∞: L is +∞ there, and its derivatives are those of the other ψ alone. Intermediate values are finite,
        so that no derivative is NaN. The formula also works for a very small sharpness, which very steep ψ need."""
        inside, number = (violations > -jnp.inf) & (violations <= HUGE), self.count(violations)
        some = jnp.where(inside, violations, 0.0)
        top = jnp.max(jnp.where(inside, violations, -jnp.inf), axis=0)
        top = jnp.where(jnp.isfinite(top), top, 0.0)
        below = (sharpness * self.nu.alpha)[None] * jnp.where(inside, some - top[None], 0.0)
        powers = jnp.where(inside, jnp.exp(below), 0.0)
        total = add_up(powers)
        blunt = jnp.log1p(add_up(jnp.where(inside, jnp.expm1(below), 0.0)) / number) / sharpness
        level = self.nu.beta * top + self.nu.beta / self.nu.alpha * (blunt + jnp.log(number)) + self.offset
        return jnp.where(self.outside(violations), jnp.inf, level), powers / jnp.where(total > 0.0, total, 1.0)[None]

    def outside(self, violations: Array) -> Array:
        """(A,) whether some ψ is below −`HUGE`, which counts as −∞."""
        return jnp.any(violations > HUGE, axis=0)

    def bluntest(self, violations: Array) -> Array:
        """(A,) the sharpness at which the soft minimum is smooth over the spread between the constraints. `violations`: (m, A)."""
        used = violations > -jnp.inf
        spread = jnp.max(violations, axis=0) - add_up(jnp.where(used, violations, 0.0)) / self.count(violations)
        return 1.0 / jnp.maximum(self.nu.alpha * spread, 1.0)

    def expand(self, y: Array, sharpness: Array) -> Expanded:
        """Second-order expansion of L at `y`, (n, d, A)."""
        if not self.batch.known:
            return self._expand_any(y, sharpness)
        n, d, _ = y.shape
        values, gradients, places, weights = [], [], [], []
        for form, kind in zip(self.batch.forms, self.kinds, strict=True):
            value, slope = _slopes(form, kind, y)
            values.append(value)
            assert form.slots is not None
            for k, slots in enumerate(form.slots):
                gradients.append(_placed(slope[k], slots, n))
                places.append((form.bend, slots))
                weights.append(1.0 if kind.weight is None else kind.weight[k])
        level, p = self._soft(jnp.concatenate(values), sharpness)
        mean, away = variance(gradients, p)
        directions = [(self.nu.beta * self.nu.alpha * sharpness * share, a) for share, a in away]

        def constant(whole: Callable[..., np.ndarray]) -> Array:
            """Σ_k p_k w_k ∇²v_k, with ∇²v_k laid out by `whole`."""
            matrices = [whole(*place, n, d) for place in places]
            terms = [jnp.asarray(m)[:, :, None] * (p[k] * weights[k])[None, None] for k, m in enumerate(matrices) if m.any()]
            return self.nu.beta * add_up(terms) if terms else jnp.zeros((*matrices[0].shape, y.shape[-1]))

        bend: Dense | Alike
        if self.batch.convex and len(gradients) <= n * d and all(_alike(bend, d) is not None for bend, _ in places):
            bend = Alike(constant(_block), directions, d)
        else:
            spread = add_up([(share[None] * a)[:, None] * a[None] for share, a in directions]) if directions else 0.0
            convex = self.batch.convex
            bend = Dense(constant(_whole) + spread, None if convex else constant(_convex_part) + spread, convex)
        return Expanded(level, self.nu.beta * mean, bend)

    def _expand_any(self, y: Array, sharpness: Array) -> Expanded:
        """`expand` for any ψ and any pattern, by automatic differentiation, vectorised over the agents."""
        n, d, _ = y.shape

        def one(flat: Array, kinds: tuple[Kind, ...], offset: Array, sharpness: Array) -> tuple[Array, Array, Array]:
            alone = Lanes(self.batch, jax.tree.map(lambda leaf: leaf[..., None], kinds), self.nu, offset[None])

            def level(flat: Array) -> Array:
                return alone.level(flat.reshape(n, d, 1), sharpness[None])[0]

            bend, (value, slope) = jax.jacfwd(lambda at: _twice(level, at), has_aux=True)(flat)
            return value, slope, bend

        found = jax.vmap(one, in_axes=-1, out_axes=-1)(y.reshape(n * d, -1), self.kinds, self.offset, sharpness)
        value, slope, bend = found
        return Expanded(value, slope, Dense(bend, None, self.batch.convex))


def _twice(function: Callable[[Array], Array], y: Array) -> tuple[Array, tuple[Array, Array]]:
    value, slope = jax.value_and_grad(function)(y)
    return slope, (value, slope)


def _arguments(form: Form, kind: Kind, y: Array) -> list[Array]:
    """For each argument of ψ the positions, (m, d, A), that the constraints read."""
    if form.slots is not None:
        return [jnp.stack([y[slot] for slot in slots]) for slots in zip(*form.slots, strict=True)]
    assert kind.slots is not None
    found = arguments(y, kind.slots)
    return [found[:, k] for k in range(found.shape[1])]


def _masked(kind: Kind, values: Array) -> Array:
    weighted = values if kind.weight is None else kind.weight * values
    return weighted if kind.used is None else jnp.where(kind.used, weighted, -jnp.inf)


def _violations(form: Form, kind: Kind, y: Array) -> Array:
    return _masked(kind, along(lambda x, p: -form.psi(*x, **p))(_arguments(form, kind, y), kind.parameters))


def _slopes(form: Form, kind: Kind, y: Array) -> tuple[Array, Array]:
    """(m, A) −ψ, −∞ where padded, and (m, arity, d, A) its gradients, 0 where padded."""
    function = jax.value_and_grad(lambda x, p: -form.psi(*x, **p))
    values, found = along(function)(_arguments(form, kind, y), kind.parameters)
    slopes = jnp.stack(found, axis=1)
    if kind.weight is not None:
        slopes = kind.weight[:, None, None] * slopes
    return _masked(kind, values), slopes if kind.used is None else jnp.where(kind.used[:, None, None], slopes, 0.0)


def _placed(slope: Array, slots: tuple[int, ...], n: int) -> Array:
    """(arity, d, A) → (n·d, A): from the arguments of a constraint to the coordinates of the agent's rows."""
    nothing = jnp.zeros_like(slope[0])
    return jnp.concatenate([slope[slots.index(row)] if row in slots else nothing for row in range(n)])


def variance(gradients: list[Array], p: Array) -> tuple[Array, list[tuple[Array, Array]]]:
    """Weighted mean and covariance of gradients by West's recurrence.

    Args:
        gradients: m arrays g_k of shape (N, A).
        p: (m, A) weights.

    Returns:
        (N, A) the mean ḡ = Σ_k p_k g_k, and m − 1 pairs (w, a) with Σ w a aᵀ = Σ_k p_k (g_k − ḡ)(g_k − ḡ)ᵀ; w: (A,), a: (N, A).
    """
    mean, total, terms = gradients[0], p[0], []
    for g, share in zip(gradients[1:], p[1:], strict=True):
        away, before, total = g - mean, total, total + share
        part = share / jnp.maximum(total, jnp.finfo(total.dtype).tiny)
        terms.append((before * part, away))
        mean = mean + part[None] * away
    return mean, terms


@functools.cache
def _whole(bend: Matrix, slots: tuple[int, ...], n: int, d: int) -> np.ndarray:
    """(N, N) ∇²v in the coordinates of all n rows."""
    index, whole = (np.array(slots)[:, None] * d + np.arange(d)).ravel(), np.zeros((n * d, n * d))
    whole[np.ix_(index, index)] = bend
    return whole


@functools.cache
def _convex_part(bend: Matrix, slots: tuple[int, ...], n: int, d: int) -> np.ndarray:
    """(N, N) as `_whole`, with negative eigenvalues set to 0."""
    values, vectors = np.linalg.eigh(np.array(bend))
    return _whole(tuple(map(tuple, (vectors * np.maximum(values, 0.0)) @ vectors.T)), slots, n, d)


@functools.cache
def _alike(bend: Matrix, d: int) -> Matrix | None:
    """C where ∇²v = C ⊗ I, that is, where the curvature is the same along all d axes; else None."""
    block = np.array(bend)[::d, ::d]
    return tuple(map(tuple, block)) if np.array_equal(np.kron(block, np.eye(d)), bend) else None


def _block(bend: Matrix, slots: tuple[int, ...], n: int, d: int) -> np.ndarray:
    """(n, n) C of `_alike`, laid out on all n rows."""
    block = _alike(bend, d)
    assert block is not None
    return _whole(block, slots, n, 1)

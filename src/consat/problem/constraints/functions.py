"""Functions for use inside a constraint whose derivatives JAX would otherwise get wrong."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


@jax.custom_jvp
def safe_norm(v: Array) -> Array:
    """‖v‖, with gradient 0 at v = 0, where `jax.numpy.linalg.norm` has NaN.

    0 is a subgradient there, so gradient inequalities such as those behind a certificate keep holding. Second derivatives at 0 are
    finite, but arbitrary: the norm has none. `consat.problem.constraints.curvature` reads it as the convex function that it is.

    Args:
        v: shape (n,).
    """
    return jnp.sqrt(jnp.sum(v**2))


@safe_norm.defjvp
def _safe_norm_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (v,), (tangent,) = primals, tangents
    norm = safe_norm(v)
    return norm, jnp.dot(v, tangent) / jnp.where(norm > 0, norm, jnp.ones_like(norm))

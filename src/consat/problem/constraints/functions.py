"""Functions for use in constraints, with derivatives that stay finite where those of JAX are NaN."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


@jax.custom_jvp
def safe_norm(v: Array) -> Array:
    """‖v‖, with gradient 0 at v = 0, where `jax.numpy.linalg.norm` has NaN.

    0 is a subgradient at v = 0, so the gradient inequalities used by certificates hold. Second derivatives at 0 are finite but arbitrary:
    the norm has none there. `consat.problem.constraints.curvature` recognises the function as convex.

    Args:
        v: shape (n,).
    """
    return jnp.sqrt(jnp.sum(v**2))


@safe_norm.defjvp
def _safe_norm_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (v,), (tangent,) = primals, tangents
    norm = safe_norm(v)
    return norm, jnp.dot(v, tangent) / jnp.where(norm > 0, norm, jnp.ones_like(norm))

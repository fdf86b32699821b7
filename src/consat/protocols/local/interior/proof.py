"""The bound on the best margin of the team that the agents prove together. The last axis of every array is the agent (the lane), size A."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from consat.protocols.local.interior.algebra import gram, reduced, spread, times
from consat.protocols.local.interior.lanes import Here, Lanes, number
from consat.protocols.local.lanewise import solve

REGION = 10.0
"""Radius R of the region for which a proof holds, in multiples of the team's reach around its centre; `Units.extent` is added to it."""
SLACK = 3e-4
"""Largest increase of the bound by the restriction to that region, in units of ψ; a little more where agents without constraints relay."""
IDLE = 0.01
"""Weight that replaces Σ λ = 0 of an agent without constraints in that restriction."""


class Proof(NamedTuple):
    """Upper bound c + eᵀz − ½ zᵀLz on Σ λψ over all agents behind the sender, maximised over the variables not shared with the receiver.

    Attributes:
        matrix: (g, p, p) L; 0 for the level.
        vector: (g, p) e.
        constant: (g,) c.
        weight: (g,) Σ λ; negative where there is no proof.
        error: (g,) bound on the rounding error of c.
    """

    matrix: Array
    vector: Array
    constant: Array
    weight: Array
    error: Array


def prove(lanes: Lanes, shared: Array, held: Array, y: Array, *, here: Here, multiplier: Array, inbox: Proof) -> tuple[Proof, Array]:
    """The proof for each neighbour, and (A,) an upper bound on the best margin: max_x Σ λψ / Σ λ over all agents (design, section 9).

    A ψ that is not quadratic is replaced by its tangent, which is an upper bound on a concave ψ. To make every direction strictly concave,
    each agent adds ε w (R² − ‖x_i‖²) with w = Σ λ, or w = `IDLE` without constraints. This term is not negative within radius R of the
    team's centre, so that the bound holds for all formations in that region.

    Rounding is outward. Sums and eliminations of positive definite systems are backward stable: the computed result is exact for a matrix,
    a vector and a constant whose entries differ by at most `eps` times the terms summed in them (Higham, Accuracy and Stability of
    Numerical Algorithms, sections 10.1 and 14.4). This changes a quadratic at z by at most eps (|c| + |e|ᵀ|z| + ½ |z|ᵀ|L||z|). Every agent
    adds this error for its own terms and for every quadratic that it solves or forwards, with |z| at its estimates and at the maximiser;
    farther away the quadratic has decreased by more than the error. The error of ψ and ∇ψ is that of rounding a position, whose absolute
    value includes the team's centre. In addition, formations within R/2 have a reserve of at least ¾ `SLACK`.

    Args:
        lanes: the agents' constraints.
        shared: (g, p, A) indices of the variables shared with each neighbour.
        held: (n, A) false where copies are padded.
        y: (n, d, A) copies.
        here: constraints at `y`.
        multiplier: (m, A) λ, the cap last.
        inbox: the last proof of each neighbour.
    """
    n, d, count = y.shape
    size, (g, p, _) = n * d, shared.shape
    if not lanes.exact or not all(form.concave for form in lanes.batch.forms):
        zero = jnp.zeros((g, count))
        return Proof(jnp.zeros((g, p, p, count)), jnp.zeros((g, p, count)), zero, zero - 1.0, zero), jnp.full(count, jnp.inf)
    used, flat = lanes.used[:-1] & (here.psi[:-1] > -jnp.inf), y.reshape(size, count)
    psi, slopes, multiplier = jnp.where(used, here.psi[:-1], 0.0), here.slopes[:-1], jnp.where(used, multiplier[:-1], 0.0)
    which, (weights, vectors) = lanes.terms(quadratic=True), lanes.bends(y, quadratic=True)
    matrix = gram(weights * multiplier[which], vectors) if len(which) else jnp.zeros((size, size, count))
    weight, value, slope = jnp.sum(multiplier, axis=0), jnp.sum(multiplier * psi, axis=0), jnp.sum(multiplier[:, None] * slopes, axis=0)
    bent = times(matrix, flat)
    vector, constant = slope + bent, value - jnp.sum(slope * flat + 0.5 * flat * bent, axis=0)
    eps = 8.0 * size * jnp.finfo(y.dtype).eps
    steep, far = jnp.abs(slope), jnp.abs(flat) + jnp.tile(lanes.units.reach + jnp.abs(lanes.units.center) / lanes.units.length, n)[:, None]
    sizes = jnp.abs(multiplier * psi).sum(axis=0) + jnp.sum((steep + times(jnp.abs(matrix), jnp.abs(flat))) * far, axis=0)
    reach = REGION * lanes.units.reach + lanes.units.extent
    curve = SLACK / reach**2 * jnp.where(used.any(axis=0), weight, IDLE)
    own = (jnp.arange(size) < d)[:, None]
    absent = jnp.repeat(~held, d, axis=0, total_repeat_length=size)
    matrix = matrix + jnp.eye(size)[:, :, None] * (jnp.where(own, 2 * curve[None], 0.0) + absent.astype(float))[:, None]

    places = jnp.where(shared < size, shared, size)  # the level is not a variable of the proof
    outside, pull = spread(inbox.matrix, inbox.vector, places, size)
    neighbour, have = (shared <= size).any(axis=1), inbox.weight >= 0
    missing = number(neighbour & ~have)
    total, forces = matrix + outside, vector + pull
    height = constant + curve * reach**2 + jnp.sum(inbox.constant, axis=0)
    error = eps * sizes + jnp.sum(inbox.error, axis=0)
    mass = weight + jnp.sum(jnp.where(have, inbox.weight, 0.0), axis=0)
    found, fine = solve(total, forces[:, None])
    gain = 0.5 * jnp.sum(forces * found[:, 0], axis=0)
    away = jnp.abs(flat) + jnp.where(fine, jnp.abs(found[:, 0]), 0.0)
    error += eps * (jnp.abs(height) + jnp.sum(away * (jnp.abs(forces) + 0.5 * times(jnp.abs(total), away)), axis=0))
    bound = (height + gain + error) / jnp.where(mass > 0, mass, 1.0)
    bound = jnp.where(fine & (missing == 0) & (mass > 0) & jnp.isfinite(bound), bound, jnp.inf)

    left, e, gain, fine = reduced(total, forces, places)
    left, e, constant = left - inbox.matrix, e - inbox.vector, height[None] - inbox.constant + gain
    error = error[None] - inbox.error + eps * (jnp.abs(constant) + jnp.abs(gain))
    complete = missing[None] == (neighbour & ~have).astype(float)
    good = fine & complete & neighbour & jnp.isfinite(left).all(axis=(1, 2)) & jnp.isfinite(e).all(axis=1) & jnp.isfinite(constant)
    return Proof(
        jnp.where(good[:, None, None], left, 0.0),
        jnp.where(good[:, None], e, 0.0),
        jnp.where(good, constant, 0.0),
        jnp.where(good, mass[None] - jnp.where(have, inbox.weight, 0.0), -1.0),
        jnp.where(good, error, 0.0),
    ), bound

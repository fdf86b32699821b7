"""ψ of the agents of a batch, its gradient and its curvature. The last axis of every array is the agent (the lane), size A.

Units: positions are relative to the centre of the team's region, in the team's unit of length; ψ is in the team's unit of ψ. So a team in
millimetres and the same team in kilometres take the same number of rounds. The last constraint of every agent is the cap: the level is at
most `cap`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import on_device
from consat.problem.units import Scale
from consat.protocols.local.interior.batches import Batch, Form, Kind
from consat.protocols.local.lanewise import along, arguments, eigen


class Units(NamedTuple):
    """Units and region of the team; common knowledge. Scalars have shape ().

    Attributes:
        center: (d,) centre of the team's region, in the scenario's length.
        length: the team's unit of length.
        psi: the team's unit of ψ.
        reach: half width of the region on each axis, in units of `length`.
        extent: distance beyond the region to which constraints may lead, in units of `length`.
    """

    center: Array
    length: Array
    psi: Array
    reach: Array
    extent: Array

    @classmethod
    def of(cls, size: Scale) -> Units:
        """From the natural scale of a team."""
        values: Any = (size.center, size.length, size.typical, size.reach / size.length, size.extent / size.length)
        return cls(*map(on_device, values))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lanes:
    """The constraints of the agents of one batch; m below includes the cap.

    Attributes:
        batch: the agents and their constraints.
        units: see `Units`.
        cap: upper bound on the level, in units of ψ; None without a cap.
        shape: (n, d, A).
        exact: whether bounds can be proven; see `Plan.exact`.
    """

    batch: Batch
    units: Units
    cap: float | None = field(metadata={"static": True})
    shape: tuple[int, int, int] = field(metadata={"static": True})
    exact: bool = field(metadata={"static": True})

    @property
    def any_moves(self) -> bool:
        """Whether any constraint moves with time."""
        return any(form.moves for form in self.batch.forms)

    @property
    def moves(self) -> Array:
        """(A,) whether an agent has constraints that move with time."""
        return self._any(lambda form: form.moves)

    @property
    def quadratic(self) -> Array:
        """(A,) whether all ψ of an agent are quadratic."""
        return ~self._any(lambda form: not form.quadratic)

    @property
    def convex(self) -> bool:
        """Whether all ψ of all agents are concave."""
        return all(form.concave for form in self.batch.forms)

    @property
    def concave(self) -> Array:
        """(A,) whether all ψ of an agent are concave."""
        return ~self._any(lambda form: not form.concave)

    @property
    def bent(self) -> Array:
        """(m, A) which ψ are neither concave nor quadratic: a model of second order holds only near the point where it was made."""
        own = [kind.used & (not form.concave and not form.quadratic) for form, kind in self._each()]
        return jnp.concatenate([jnp.zeros((0, self.shape[2]), bool), *own, jnp.zeros((1, self.shape[2]), bool)])

    @property
    def used(self) -> Array:
        """(m, A) false where padded."""
        own = jnp.concatenate([jnp.zeros((0, self.shape[2]), bool), *(kind.used for kind in self.batch.kinds)])
        return jnp.concatenate([own, own.any(axis=0, keepdims=True) & (self.cap is not None)])

    @jax.jit
    def psi(self, y: Array) -> Array:
        """(m, A) ψ at the copies `y`, (n, d, A), the cap last; −∞ outside the domain of ψ, +∞ where padded."""
        own = [self._masked(kind, along(_at(form.psi))(self._arguments(kind, y), kind.parameters)) for form, kind in self._each()]
        return self._with_cap(own)

    def slopes(self, y: Array) -> tuple[Array, Array]:
        """(m, A) ψ and (m, n·d, A) ∇ψ at the copies `y`, (n, d, A); entries of ∇ψ that are not finite are 0."""
        values, gradients = [], []
        for form, kind in self._each():
            value, found = along(jax.value_and_grad(_at(form.psi)))(self._arguments(kind, y), kind.parameters)
            slope = found * (kind.weight * self.units.length / self.units.psi)[:, None, None]
            values.append(self._masked(kind, value))
            gradients.append(self._placed(kind, jnp.where(jnp.isfinite(slope) & kind.used[:, None, None], slope, 0.0)))
        n, d, count = self.shape
        return self._with_cap(values), jnp.concatenate([*gradients, jnp.zeros((1, n * d, count))])

    def terms(self, *, quadratic: bool = False) -> np.ndarray:
        """(r,) the constraint of each term of `bends`."""
        found, done = [], 0
        for form, kind in self._each():
            m, arity, _ = kind.slots.shape
            found += [done + k for k in range(m) for _ in range(self._rank(form, arity, quadratic))]
            done += m
        return np.array(found, dtype=int)

    def bends(self, y: Array, *, quadratic: bool = False) -> tuple[Array, Array]:
        """Curvature of the constraints as r rank-one terms: Σ w λ v vᵀ is the convex part of −Σ_k λ_k ∇²ψ_k, with the λ_k of `terms`.

        Args:
            y: (n, d, A) copies.
            quadratic: whether to include only quadratic ψ, whose curvature is the same everywhere.

        Returns:
            (r, A) weights w, and (r, n·d, A) vectors v.
        """
        n, d, count = self.shape
        weights, vectors = [jnp.zeros((0, count))], [jnp.zeros((0, n * d, count))]
        for form, kind in self._each():
            m, arity, _ = kind.slots.shape
            rank = self._rank(form, arity, quadratic)
            if not rank:
                continue
            if form.curvature is not None:
                values = jnp.ones((m, rank, count))
                found = jnp.broadcast_to(jnp.asarray(form.curvature).reshape(rank, arity, d, 1), (m, rank, arity, d, count))
            else:
                minus = along(_minus_hessian(form.psi, arity, d))(self._arguments(kind, y), kind.parameters)  # (m, N, N, A)
                eigenvalues, eigenvectors = eigen(jnp.moveaxis(minus, 0, -2).reshape(rank, rank, m * count))
                values = jnp.moveaxis(jnp.maximum(eigenvalues, 0.0).reshape(rank, m, count), 1, 0)
                found = eigenvectors.T.reshape(m, count, rank, arity, d).transpose(0, 2, 3, 4, 1)
            scale = jnp.where(kind.used, kind.weight * self.units.length**2 / self.units.psi, 0.0)
            rows = jnp.repeat(kind.slots, rank, axis=0, total_repeat_length=m * rank)
            weights.append((scale[:, None] * values).reshape(m * rank, count))
            vectors.append(self._placed(kind._replace(slots=rows), found.reshape(m * rank, arity, d, count)))
        return jnp.concatenate(weights), jnp.concatenate(vectors)

    def _rank(self, form: Form, arity: int, quadratic: bool) -> int:
        """Number of terms of a constraint in `bends`."""
        if form.curvature is not None:
            return len(form.curvature)
        return 0 if quadratic and not form.quadratic else arity * self.shape[1]

    def _any(self, which: Callable[[Form], bool]) -> Array:
        """(A,) whether an agent has a constraint of such a form."""
        found = [kind.used.any(axis=0) for form, kind in self._each() if which(form)]
        return jnp.any(jnp.stack([jnp.zeros(self.shape[2], bool), *found]), axis=0)

    def _each(self) -> Any:
        return zip(self.batch.forms, self.batch.kinds, strict=True)

    def _with_cap(self, own: list[Array]) -> Array:
        return jnp.concatenate([*own, jnp.full((1, self.shape[2]), jnp.inf if self.cap is None else self.cap)])

    def _masked(self, kind: Kind, value: Array) -> Array:
        value = jnp.where(jnp.isfinite(value), kind.weight * value / self.units.psi, -jnp.inf)
        return jnp.where(kind.used, value, jnp.inf)

    def _arguments(self, kind: Kind, y: Array) -> Array:
        """(m, arity, d, A) the arguments of each ψ, in the scenario's units."""
        return arguments(self.units.center[None, :, None] + self.units.length * y, kind.slots)

    def _placed(self, kind: Kind, slope: Array) -> Array:
        """(m, arity, d, A) → (m, n·d, A): from the arguments of each constraint to the agent's coordinates."""
        n, d, count = self.shape
        where = jnp.arange(n, dtype=jnp.int32)[None, None, :, None] == kind.slots[:, :, None]  # (m, arity, n, A)
        return jnp.sum(jnp.where(where[:, :, :, None], slope[:, :, None], 0.0), axis=1).reshape(len(slope), n * d, count)


class Here(NamedTuple):
    """Values and derivatives of the constraints at the copies.

    Attributes:
        psi: (m, A) ψ.
        slopes: (m, n·d, A) ∇ψ.
        bends: see `Lanes.bends`.
    """

    psi: Array
    slopes: Array
    bends: tuple[Array, Array]

    @classmethod
    def of(cls, lanes: Lanes, y: Array) -> Here:
        """At the copies `y`, (n, d, A)."""
        return _here(lanes, y)


@jax.jit  # so that it is traced once, although a round needs it twice
def _here(lanes: Lanes, y: Array) -> Here:
    return Here(*lanes.slopes(y), lanes.bends(y))


def _at(psi: Any) -> Any:
    """ψ as a function of an array of positions, (arity, d), and a dictionary of parameters."""
    return lambda x, p: psi(*x, **p)


def _minus_hessian(psi: Any, arity: int, d: int) -> Any:
    """Function of positions, (arity, d), and parameters that returns −∇²ψ, (arity·d, arity·d); 0 where it is not finite."""

    def one(x: Array, p: dict[str, Array]) -> Array:
        hessian = -jax.hessian(_at(psi))(x, p).reshape(arity * d, arity * d)
        return jnp.where(jnp.isfinite(hessian).all(), 0.5 * (hessian + hessian.T), 0.0)

    return one


def number(mask: Array) -> Array:
    """(k, A) → (A,) number of true entries."""
    return jnp.sum(mask.astype(float), axis=0)

"""The curvature of a constraint function, read off its trace.

ψ is traced to a jaxpr, and every intermediate of that jaxpr is described by a `Node`: what kind of function of the positions it is.
Three things are tried in turn, and only what is proven is said.

1. **Degree.** A polynomial of degree ≤ 2 is carried along exactly, coefficients and all. Its Hessian is a constant matrix, whose
   eigenvalues decide.
2. **Composition.** Otherwise the rules of disciplined convex programming (Grant, Boyd, Ye 2006, "Disciplined convex programming",
   section 6; Boyd, Vandenberghe 2004, "Convex optimization", sections 3.2 and 3.5) go from node to node: sign, curvature, monotonicity.
   √q with q quadratic is convex iff q is ‖affine‖², i.e. iff [[A, b], [bᵀ, 2c]] is positive semidefinite; logarithms of sums of
   exponentials are known, shifted by their maximum (`jax.nn.logsumexp`) or not.
3. **Refutation.** Otherwise a segment is sought on which ψ dips below its chord: that is a proof of not-concave.

As is the convention there, a function counts as concave if it is concave where it is defined: log(x) is, its domain being convex.

Every `Node` describes a whole family at once: the leading axis of its arrays, of length M or 1, runs over the members.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from numpy.typing import ArrayLike, NDArray

from consat.numerics import once, stacked
from consat.problem.constraints.composition import arranged, highest
from consat.problem.constraints.node import Node, block, constant, opaque, position, signs
from consat.problem.constraints.tracing import CALLS, describe, evaluate, interpret

Array = NDArray[Any]
Psi = Callable[..., Any]

EPSILON: Final = float(np.finfo(np.float64).eps)
NUDGE: Final = 1e-7
DOUBT: Final = 1e3
"""How far a chord must run above ψ, as a multiple of what rounding is estimated to do, to be beyond doubt."""
BLOCK: Final = 1 << 12
CHUNK: Final = 1 << 22
"""Members are read in chunks of about this many matrix entries."""
PROBES: Final = 1 << 14
"""Points tried per family to refute concavity, but at least 4 and at most 512 per member."""


class Curvature(enum.StrEnum):
    """What is known of ψ in all its positions jointly."""

    STRICTLY_CONCAVE = "strictly-concave"
    CONCAVE = "concave"
    UNKNOWN = "unknown"
    NOT_CONCAVE = "not-concave"


_LABELS: Final = np.array(list(Curvature), dtype=object)
_STRICTLY, _CONCAVE, _UNKNOWN, _NOT = range(4)


@dataclass(frozen=True)
class Reading:
    """What is proven of one ψ.

    Attributes:
        curvature: in all positions jointly.
        strict_in: for each position, whether ψ is strictly concave in that one alone, the others held.
        degree: at most this as a polynomial in the positions (0, 1 or 2); None if more, if none, or if unknown.
    """

    curvature: Curvature
    strict_in: tuple[bool, ...]
    degree: int | None


@dataclass(frozen=True)
class Readings:
    """What is proven of a family of M functions; `readings[m]` is one `Reading`.

    Attributes:
        curvature: (M,), of `Curvature`.
        strict_in: (M, arity), bool.
        degree: of them all.
    """

    curvature: Array
    strict_in: NDArray[np.bool_]
    degree: int | None

    def __len__(self) -> int:
        return len(self.curvature)

    def __getitem__(self, member: int) -> Reading:
        return Reading(self.curvature[member], tuple(map(bool, self.strict_in[member])), self.degree)


class Quadratics(NamedTuple):
    """ψ_m(x) = c_m + b_m·x + ½ xᵀH_m x, x the arity * d entries of all positions. Read-only: members may share memory."""

    constant: Array
    gradient: Array
    hessian: Array


def read_curvature(psi: Psi, arity: int, dimension: int, parameters: Mapping[str, ArrayLike]) -> Reading:
    """The curvature of one ψ.

    Args:
        psi: ``psi(*positions, **parameters) -> scalar``, traceable by JAX.
        arity: number of positions it takes.
        dimension: d, the length of each.
        parameters: its keyword arguments.
    """
    return read_curvatures(psi, arity, dimension, {key: np.asarray(value)[None] for key, value in parameters.items()})[0]


def read_curvatures(
    psi: Psi, arity: int, dimension: int, stacked_parameters: Mapping[str, ArrayLike], members: int | None = None
) -> Readings:
    """The curvature of every member of a family; see `read_curvature`.

    Args:
        psi: as there.
        arity: as there.
        dimension: as there.
        stacked_parameters: the keyword arguments, members along axis 0. What is proven holds whatever value stands where one is NaN.
        members: M; may be left out if there is a parameter.
    """
    family = _Family.of(psi, arity, dimension, stacked_parameters, members)
    nodes = family.nodes()
    parts = [_classify(node, arity, count, moving=family.moving) for count, node in nodes]
    code, strict_in = (stacked(part) for part in zip(*parts, strict=True))
    undecided = np.flatnonzero(code == _UNKNOWN)
    if undecided.size:
        code = np.array(code)
        code[undecided[_refuted(family, undecided)]] = _NOT
    degrees = [None if node.terms is None else node.degree for _, node in nodes]
    labels = _repeated(_LABELS[once(code)], len(code))
    return Readings(labels, strict_in, highest(degrees))


def degree(psi: Psi, arity: int, dimension: int, example_parameters: Mapping[str, ArrayLike]) -> int | None:
    """A bound (0, 1 or 2) on the polynomial degree of ψ in the positions, whatever the values of its parameters; None if there is none.

    Args:
        psi: as in `read_curvature`.
        arity: as there.
        dimension: as there.
        example_parameters: keyword arguments of the right shape and type.
    """
    family = _Family.of(psi, arity, dimension, {key: np.asarray(value)[None] for key, value in example_parameters.items()})
    return family.read({key: opaque(value.shape[1:]) for key, value in family.parameters.items()}).degree


def expand(psi: Psi, arity: int, dimension: int, stacked_parameters: Mapping[str, ArrayLike], members: int | None = None) -> Quadratics:
    """The coefficients of every member of a family of degree ≤ 2.

    Raises:
        ValueError: ψ is not proven to be of degree ≤ 2.
    """
    family = _Family.of(psi, arity, dimension, stacked_parameters, members)
    n, chunks = arity * dimension, []
    for count, node in family.nodes():
        if node.terms is None:
            raise ValueError(
                f"Argument psi must be a polynomial of degree 0, 1 or 2 in the positions, but {psi!r} is none that could be read."
            )
        flat = [part.reshape(len(part), *(n,) * order) for order, part in enumerate(node.terms)]
        shapes = [(count, *(n,) * order) for order in range(3)]
        chunks.append([np.broadcast_to(part, shape) for part, shape in zip_longest(flat, shapes, fillvalue=np.zeros(()))])
    return Quadratics(*(stacked(part) for part in zip(*chunks, strict=True)))


def hessians(psi: Psi, arity: int, dimension: int, stacked_parameters: Mapping[str, ArrayLike], members: int | None = None) -> Array:
    """The constant Hessians, (M, arity * d, arity * d), of a family of degree ≤ 2; see `expand`."""
    return expand(psi, arity, dimension, stacked_parameters, members).hessian


@dataclass(frozen=True)
class _Family:
    """ψ traced, with the parameters of all its members."""

    psi: Psi
    arity: int
    dimension: int
    parameters: dict[str, Array]
    members: int
    trace: core.ClosedJaxpr

    @classmethod
    def of(cls, psi: Psi, arity: int, dimension: int, stacked: Mapping[str, ArrayLike], members: int | None = None) -> _Family:
        parameters = {key: np.asarray(value) for key, value in stacked.items()}
        if members is None:
            members = len(next(iter(parameters.values()), (None,)))
        with jax.enable_x64(True):
            one = jax.ShapeDtypeStruct((dimension,), np.float64)
            shapes = {key: jax.ShapeDtypeStruct(value.shape[1:], value.dtype) for key, value in parameters.items()}
            trace = jax.make_jaxpr(lambda positions, keywords: psi(*positions, **keywords))([one] * arity, shapes)
        if [var.aval.size for var in trace.jaxpr.outvars] != [1]:
            raise ValueError(f"Argument psi must return one number, but {psi!r} returns {[str(var.aval) for var in trace.jaxpr.outvars]}.")
        return cls(psi, arity, dimension, parameters, members, trace)

    @property
    def moving(self) -> bool:
        """Whether some parameters may take any value."""
        return any(value.dtype.kind == "f" and bool(np.isnan(value).any()) for value in self.parameters.values())

    def nodes(self) -> list[tuple[int, Node]]:
        """What ψ is, chunk by chunk, with the number of members in the chunk."""
        size = max(1, CHUNK // (self.arity * self.dimension + 1) ** 2)
        return [
            (
                min(size, self.members - start),
                self.read({key: constant(value[start : start + size]) for key, value in self.parameters.items()}),
            )
            for start in range(0, self.members, size)
        ]

    def read(self, parameters: Mapping[str, Node]) -> Node:
        """What ψ is, given what its parameters are."""
        positions = [position(slot, self.arity, self.dimension) for slot in range(self.arity)]
        arguments = [*positions, *(parameters[key] for key in sorted(parameters))]
        with np.errstate(all="ignore"), jax.enable_x64(True):
            (node,) = interpret(self.trace, arguments, lambda value: constant(np.asarray(value)[None]), describe)
            return arranged([node], np.zeros((), int))


@np.errstate(all="ignore")
def _classify(node: Node, arity: int, members: int, *, moving: bool = False) -> tuple[Array, Array]:
    """Codes (M,) and `strict_in` (M, arity) of a scalar node; moving: whether terms that are NaN are those of parameters that move."""
    if node.terms is None:
        bend = node.bend
        strict = np.broadcast_to(bend.strict, (*bend.strict.shape[:-1], arity + 2))
        code = np.select([bend.concave & strict[:, 0], bend.concave, bend.convex & strict[:, -1]], [_STRICTLY, _CONCAVE, _NOT], _UNKNOWN)
        return _repeated(code, members), _repeated(bend.concave[:, None] & strict[:, 1:-1], members)
    code, strict_in = np.array([_CONCAVE]), np.zeros((1, arity), bool)
    if node.degree == 2:
        largest = [signs(block(node.terms[2], slot), block(node.sizes[2], slot))[1] for slot in (None, *range(arity))]
        code, strict_in = np.choose(largest[0].astype(int) + 1, [_STRICTLY, _CONCAVE, _NOT]), np.stack(largest[1:], axis=-1) < 0
    finite = np.ones(1, bool)
    for order, part in enumerate(node.sizes):
        good = ~np.isinf(part) if moving and order < 2 else np.isfinite(part)
        finite = finite & good.all(tuple(range(1, part.ndim)))
    return _repeated(np.where(finite, code, _UNKNOWN), members), _repeated(strict_in & finite[:, None], members)


def _repeated(array: Array, members: int) -> Array:
    """One row, or as many as there are members, as so many."""
    return np.broadcast_to(array, (members, *array.shape[1:]))


def _refuted(family: _Family, members: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which of these members have a segment on which ψ dips below its chord, by more than rounding explains.

    Points are drawn about the origin and about the numbers among the parameters, at several scales; segments run through them along
    the direction in which ψ is most convex at that scale, and along a random one.
    """
    numbers = [value[members].reshape(len(members), -1) for value in family.parameters.values() if value.dtype.kind in "iuf"]
    table = np.concatenate([np.zeros((len(members), 1)), *numbers], axis=1)
    rows, first, back = np.unique(table, axis=0, return_index=True, return_inverse=True)
    count = int(np.clip(PROBES // len(rows), 4, 512))
    evaluated = _evaluator(family)
    found = np.zeros(len(rows), bool)
    for chunk in np.array_split(np.arange(len(rows)), math.ceil(len(rows) * count / PROBES)):
        points, reach = _probes(rows[chunk], count, family.arity, family.dimension)
        values = partial(evaluated, members[first[chunk]])
        found[chunk] = _dips(values, points, reach).any(axis=1)
    return found[back]


def _probes(rows: Array, count: int, arity: int, d: int) -> tuple[Array, Array]:
    """Points (members, count, arity * d) and scales (members, count, 1) at which to look, given the numbers of every member."""
    rng = np.random.default_rng(0)
    start = rng.integers(rows.shape[1], size=(count, arity, 1)) + np.arange(d)
    about = rows[:, start % rows.shape[1]] * (rng.random((count, 1, 1)) < 0.5)
    unit = np.where(rng.random((count, 1, 1)) < 0.5, 1, np.abs(rows[:, rng.integers(rows.shape[1], size=(count, 1, 1))]))
    common, own = (unit * 10.0 ** rng.uniform(-2, 2, (count, 1, 1)) for _ in range(2))
    common = common * (rng.random((count, 1, 1)) < 0.5)
    points = about + common * rng.normal(size=(count, 1, d)) + own * rng.normal(size=(count, arity, d))
    return points.reshape(len(rows), count, arity * d), np.broadcast_to(own[..., 0], (len(rows), count, 1))


@np.errstate(all="ignore")
def _dips(values: Callable[[Array], tuple[Array, Array]], points: Array, reach: Array) -> NDArray[np.bool_]:
    """Whether ψ dips below its chord about each of these points."""
    n = points.shape[-1]
    unit = np.eye(n)
    row, column = np.triu_indices(n)
    corners, _ = values(points[..., None, :] + reach[..., None] * np.concatenate([0 * unit[:1], unit, unit[row] + unit[column]]))
    ends = corners[..., 1 : n + 1] - corners[..., :1]
    hessian = np.zeros((*points.shape, n))  # by differences, so that it sees the kinks within reach; the scale does not matter
    hessian[..., column, row] = corners[..., n + 1 :] - corners[..., :1] - ends[..., row] - ends[..., column]
    steepest = np.linalg.eigh(np.where(np.isfinite(hessian), hessian, 0))[1][..., -1]
    random = np.random.default_rng(1).normal(size=points.shape) / np.sqrt(n)
    offsets = np.concatenate([step * reach[..., None] * np.stack([steepest, random], axis=-2) for step in (0.01, 0.1, 1.0, 10.0)], axis=-2)
    (left, middle, right), noise = (
        np.moveaxis(each, -1, 0) for each in values(points[..., None, None, :] + np.array([[-1.0], [0.0], [1.0]]) * offsets[..., None, :])
    )
    return np.any(np.isfinite(noise.sum(0)) & ((left + right) / 2 - middle > DOUBT * noise.sum(0)), axis=-1)


def _evaluator(family: _Family) -> Callable[[Array, Array], tuple[Array, Array]]:
    """From members (m,) and points (m, …, n) to ψ there, and to what rounding may have done to it.

    That is estimated as in Monte Carlo arithmetic (Parker 1997): every number computed on the way is nudged at random, relative to its
    own size, and the outcome compared.
    """
    n, rng = family.arity * family.dimension, np.random.default_rng(2)
    shapes = [(n,), *(aval.shape for aval in _computed(family.trace) if np.issubdtype(aval.dtype, np.floating))]
    nudges = [NUDGE * np.concatenate([np.zeros((1, *shape)), rng.normal(size=(3, *shape))]) for shape in shapes]

    def nudged(parameters: Mapping[str, jax.Array], x: jax.Array, nudges: Sequence[jax.Array]) -> jax.Array:
        of_x, *others = nudges
        left = iter(others)

        def step(eqn: core.JaxprEqn, inputs: Sequence[Any]) -> Sequence[Any] | None:
            if eqn.primitive.name in CALLS:
                return None
            return [out * (1 + next(left)) if jnp.issubdtype(out.dtype, jnp.floating) else out for out in evaluate(eqn, *inputs)]

        x = (x * (1 + of_x)).reshape(family.arity, family.dimension)
        (value,) = interpret(family.trace, [*x, *(parameters[key] for key in sorted(parameters))], jnp.asarray, step)
        return value.reshape(())

    compiled = jax.jit(jax.vmap(jax.vmap(nudged, (None, None, 0)), (0, 0, None)))

    def evaluated(members: Array, points: Array) -> tuple[Array, Array]:
        flat, whose = points.reshape(-1, n), np.repeat(members, points[0, ..., 0].size)
        parts = []
        for start in range(0, len(flat), BLOCK):  # of one size, so that all is compiled once
            some = np.arange(start, start + BLOCK) % len(flat)
            with jax.enable_x64(True):
                block = compiled({key: value[whose[some]] for key, value in family.parameters.items()}, flat[some], nudges)
            parts.append(np.asarray(block))
        values = np.concatenate(parts)[: len(flat)].reshape(*points.shape[:-1], -1)
        noise = EPSILON * (np.abs(values[..., :1]) + np.abs(values[..., 1:] - values[..., :1]) / NUDGE).max(-1)
        return values[..., 0], noise

    return evaluated


def _computed(trace: core.ClosedJaxpr) -> list[Any]:
    """Shapes and types of all that is computed, in order."""
    avals: list[Any] = []

    def step(eqn: core.JaxprEqn, _: Sequence[None]) -> Sequence[None] | None:
        if eqn.primitive.name in CALLS:
            return None
        avals.extend(var.aval for var in eqn.outvars)
        return [None] * len(eqn.outvars)

    interpret(trace, [None] * len(trace.jaxpr.invars), lambda _: None, step)
    return avals

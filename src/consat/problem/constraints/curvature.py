"""Proof of the curvature of a constraint function from its JAX trace.

ψ is traced to a jaxpr. A `Node` describes each intermediate value of the jaxpr as a function of the positions. Three methods are tried in
turn; only proven results are reported.

1. **Degree.** A polynomial of degree ≤ 2 keeps its exact coefficients. Its Hessian is a constant matrix, and the eigenvalues decide.
2. **Composition.** Otherwise the rules of disciplined convex programming (Grant, Boyd, Ye 2006, "Disciplined convex programming",
   section 6; Boyd, Vandenberghe 2004, "Convex optimization", sections 3.2 and 3.5) derive sign, curvature and monotonicity from node to
   node. √q with q quadratic is convex iff q ≥ 0 everywhere, i.e. iff [[H, b], [bᵀ, 2c]] is positive semidefinite. The logarithm of a sum
   of exponentials is recognised, with or without the shift by the maximum that `jax.nn.logsumexp` applies.
3. **Refutation.** Otherwise a line segment is searched on which ψ lies below its chord. Such a segment proves that ψ is not concave.

By the convention of disciplined convex programming, a function is concave if it is concave on its domain: log(x) is concave.

Each `Node` describes a whole family: the leading axis of its arrays, of length M or 1, runs over the members.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from consat.numerics import once, stacked
from consat.problem.constraints.composition import arranged, highest
from consat.problem.constraints.node import Node, block, constant, opaque, position, signs
from consat.problem.constraints.tracing import CALLS, describe, evaluate, interpret

if TYPE_CHECKING:
    from jax.extend import core

Array = NDArray[Any]
Psi = Callable[..., Any]

EPSILON: Final = float(np.finfo(np.float64).eps)
NUDGE: Final = 1e-7
"""Relative size of the random perturbations that estimate the rounding error; see `_evaluator`."""
DOUBT: Final = 1e3
"""Required gap between a chord and ψ, as a multiple of the estimated rounding error, to prove that ψ is not concave."""
BLOCK: Final = 1 << 12
"""Number of points evaluated by one call of a compiled program."""
CHUNK: Final = 1 << 22
"""Members are processed in chunks of about this many matrix entries."""
PROBES: Final = 1 << 14
"""Number of points per family tried to refute concavity; at least 4 and at most 512 per member."""


class Curvature(enum.StrEnum):
    """The proven curvature of ψ as a function of all its positions jointly."""

    STRICTLY_CONCAVE = "strictly-concave"
    CONCAVE = "concave"
    UNKNOWN = "unknown"
    NOT_CONCAVE = "not-concave"


_LABELS: Final = np.array(list(Curvature), dtype=object)
_STRICTLY, _CONCAVE, _UNKNOWN, _NOT = range(4)


@dataclass(frozen=True)
class Readings:
    """The proven properties of a family of M functions.

    Attributes:
        curvature: (M,) of `Curvature`, in all positions jointly.
        convex: (M,) bool: whether ψ is convex in all positions jointly.
        strict_in: (M, arity) bool: whether ψ is strictly concave in one position alone, with the others fixed.
        degree: upper bound (0, 1 or 2) on the degree of every ψ as a polynomial in the positions; None if no such bound is proven.
    """

    curvature: Array
    convex: NDArray[np.bool_]
    strict_in: NDArray[np.bool_]
    degree: int | None

    @property
    def concave(self) -> NDArray[np.bool_]:
        """(M,) bool; (1,) if all members are known to be alike."""
        found = once(self.curvature)
        return (found == Curvature.CONCAVE) | (found == Curvature.STRICTLY_CONCAVE)


class Quadratics(NamedTuple):
    """Coefficients of ψ_m(x) = c_m + b_m·x + ½ xᵀH_m x, where x holds the n = arity * d entries of all positions.

    Read-only: members may share memory.

    Attributes:
        constant: c, (M,).
        gradient: b, (M, n).
        hessian: H, (M, n, n).
    """

    constant: Array
    gradient: Array
    hessian: Array


def read_curvatures(
    psi: Psi, arity: int, dimension: int, stacked_parameters: Mapping[str, ArrayLike], members: int | None = None
) -> Readings:
    """The curvature of every member of a family.

    Args:
        psi: ``psi(*positions, **parameters) -> scalar``, traceable by JAX.
        arity: number of positions ψ takes.
        dimension: d, the length of each position.
        stacked_parameters: keyword arguments of ψ, members along axis 0. NaN stands for any value: the result holds for all of them.
        members: M; required only if ψ has no parameters.
    """
    family = _Family.of(psi, arity, dimension, stacked_parameters, members)
    nodes = family.nodes()
    parts = [_classify(node, arity, count, moving=family.moving) for count, node in nodes]
    code, convex, strict_in = (stacked(part) for part in zip(*parts, strict=True))
    undecided = np.flatnonzero(code == _UNKNOWN)
    if undecided.size:
        code = np.array(code)
        code[undecided[_refuted(family, undecided)]] = _NOT
    degrees = [None if node.terms is None else node.degree for _, node in nodes]
    labels = _repeated(_LABELS[once(code)], len(code))
    return Readings(labels, convex, strict_in, highest(degrees))


def degree(psi: Psi, arity: int, dimension: int, example_parameters: Mapping[str, ArrayLike]) -> int | None:
    """An upper bound (0, 1 or 2) on the polynomial degree of ψ in the positions, for all parameter values; None if none is proven.

    Args:
        psi: ``psi(*positions, **parameters) -> scalar``, traceable by JAX.
        arity: number of positions ψ takes.
        dimension: d, the length of each position.
        example_parameters: keyword arguments with the right shapes and types; their values do not matter.
    """
    family = _Family.of(psi, arity, dimension, {key: np.asarray(value)[None] for key, value in example_parameters.items()})
    return family.read({key: opaque(value.shape[1:]) for key, value in family.parameters.items()}).degree


def expand(psi: Psi, arity: int, dimension: int, stacked_parameters: Mapping[str, ArrayLike], members: int | None = None) -> Quadratics:
    """The coefficients of each member of a family of degree ≤ 2; arguments as in `read_curvatures`.

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
    """A traced ψ with the stacked parameters of all members."""

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
        """Whether some parameter is NaN, which stands for any value (it moves with time)."""
        return any(value.dtype.kind == "f" and bool(np.isnan(value).any()) for value in self.parameters.values())

    def nodes(self) -> list[tuple[int, Node]]:
        """(number of members, node of ψ) for each chunk of members."""
        size = max(1, CHUNK // (self.arity * self.dimension + 1) ** 2)
        return [
            (
                min(size, self.members - start),
                self.read({key: constant(value[start : start + size]) for key, value in self.parameters.items()}),
            )
            for start in range(0, self.members, size)
        ]

    def read(self, parameters: Mapping[str, Node]) -> Node:
        """The node of ψ, given the nodes of its parameters."""
        positions = [position(slot, self.arity, self.dimension) for slot in range(self.arity)]
        arguments = [*positions, *(parameters[key] for key in sorted(parameters))]
        with np.errstate(all="ignore"), jax.enable_x64(True):
            (node,) = interpret(self.trace.jaxpr, self.trace.consts, arguments, lambda value: constant(np.asarray(value)[None]), describe)
            return arranged([node], np.zeros((), int))


@np.errstate(all="ignore")
def _classify(node: Node, arity: int, members: int, *, moving: bool) -> tuple[Array, Array, Array]:
    """The curvature of ψ from its node.

    Args:
        node: a scalar node.
        arity: number of positions ψ takes.
        members: M.
        moving: whether NaN in the constant and linear terms comes from moving parameters and is therefore allowed.

    Returns:
        (M,) indices into `_LABELS`, (M,) `convex` and (M, arity) `strict_in`.
    """
    if node.terms is None:
        bend = node.bend
        strict = np.broadcast_to(bend.strict, (*bend.strict.shape[:-1], arity + 2))
        code = np.select([bend.concave & strict[:, 0], bend.concave, bend.convex & strict[:, -1]], [_STRICTLY, _CONCAVE, _NOT], _UNKNOWN)
        strict_in = bend.concave[:, None] & strict[:, 1:-1]
        return _repeated(code, members), _repeated(bend.convex, members), _repeated(strict_in, members)
    code, convex, strict_in = np.array([_CONCAVE]), np.ones(1, bool), np.zeros((1, arity), bool)
    if node.degree == 2:
        smallest, largest = zip(
            *(signs(block(node.terms[2], slot), block(node.sizes[2], slot)) for slot in (None, *range(arity))), strict=True
        )
        code, convex = np.choose(largest[0].astype(int) + 1, [_STRICTLY, _CONCAVE, _NOT]), smallest[0] >= 0
        strict_in = np.stack(largest[1:], axis=-1) < 0
    finite = np.ones(1, bool)
    for order, part in enumerate(node.sizes):
        good = ~np.isinf(part) if moving and order < 2 else np.isfinite(part)
        finite = finite & good.all(tuple(range(1, part.ndim)))
    found = np.where(finite, code, _UNKNOWN), convex & finite, strict_in & finite[:, None]
    return _repeated(found[0], members), _repeated(found[1], members), _repeated(found[2], members)


def _repeated(array: Array, members: int) -> Array:
    """An array with one row, or one row per member, broadcast to one row per member."""
    return np.broadcast_to(array, (members, *array.shape[1:]))


def _refuted(family: _Family, members: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which of the members have a segment on which ψ lies below its chord by more than rounding explains.

    Points are drawn around the origin and around numbers taken from the parameters, at several scales. Segments run through each point
    along the direction in which ψ is most convex at that scale, and along a random direction.
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
    """Points (members, count, arity * d) and length scales (members, count, 1) to test, drawn from a fixed seed.

    Args:
        rows: (members, K) numbers among the parameters of each member, and 0.
        count: number of points per member.
        arity: number of positions ψ takes.
        d: length of each position.
    """
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
    """Whether ψ lies below a chord through each point.

    Args:
        values: function from (…, n) points to ψ and its estimated rounding error.
        points: (members, count, n).
        reach: (members, count, 1) length scales.
    """
    n = points.shape[-1]
    unit = np.eye(n)
    row, column = np.triu_indices(n)
    corners, _ = values(points[..., None, :] + reach[..., None] * np.concatenate([0 * unit[:1], unit, unit[row] + unit[column]]))
    ends = corners[..., 1 : n + 1] - corners[..., :1]
    hessian = np.zeros((*points.shape, n))  # by finite differences, which also see kinks within reach; only its eigenvectors are used
    hessian[..., column, row] = corners[..., n + 1 :] - corners[..., :1] - ends[..., row] - ends[..., column]
    hessian = np.where(np.isfinite(hessian), hessian, 0)
    largest = np.abs(hessian).max(axis=(-2, -1), keepdims=True)  # LAPACK does not converge near the largest number
    steepest = np.linalg.eigh(hessian / np.where(largest > 0, largest, 1))[1][..., -1]
    random = np.random.default_rng(1).normal(size=points.shape) / np.sqrt(n)
    offsets = np.concatenate([step * reach[..., None] * np.stack([steepest, random], axis=-2) for step in (0.01, 0.1, 1.0, 10.0)], axis=-2)
    (left, middle, right), noise = (
        np.moveaxis(each, -1, 0) for each in values(points[..., None, None, :] + np.array([[-1.0], [0.0], [1.0]]) * offsets[..., None, :])
    )
    return np.any(np.isfinite(noise.sum(0)) & ((left + right) / 2 - middle > DOUBT * noise.sum(0)), axis=-1)


def _evaluator(family: _Family) -> Callable[[Array, Array], tuple[Array, Array]]:
    """A function from members (m,) and points (m, …, n) to the values of ψ and an estimate of their rounding errors.

    The estimate uses Monte Carlo arithmetic (Parker 1997): each intermediate result is perturbed at random, relative to its size, and the
    results are compared.
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
        (value,) = interpret(
            family.trace.jaxpr, family.trace.consts, [*x, *(parameters[key] for key in sorted(parameters))], jnp.asarray, step
        )
        return value.reshape(())

    compiled = jax.jit(jax.vmap(jax.vmap(nudged, (None, None, 0)), (0, 0, None)))

    def evaluated(members: Array, points: Array) -> tuple[Array, Array]:
        flat, whose = points.reshape(-1, n), np.repeat(members, points[0, ..., 0].size)
        parts = []
        for start in range(0, len(flat), BLOCK):  # blocks of one size, so that the program is compiled once
            some = np.arange(start, start + BLOCK) % len(flat)
            with jax.enable_x64(True):
                block = compiled({key: value[whose[some]] for key, value in family.parameters.items()}, flat[some], nudges)
            parts.append(np.asarray(block))
        values = np.concatenate(parts)[: len(flat)].reshape(*points.shape[:-1], -1)
        noise = EPSILON * (np.abs(values[..., :1]) + np.abs(values[..., 1:] - values[..., :1]) / NUDGE).max(-1)
        return values[..., 0], noise

    return evaluated


def _computed(trace: core.ClosedJaxpr) -> list[Any]:
    """Shapes and types of all intermediate results of a trace, in order of computation."""
    avals: list[Any] = []

    def step(eqn: core.JaxprEqn, _: Sequence[None]) -> Sequence[None] | None:
        if eqn.primitive.name in CALLS:
            return None
        avals.extend(var.aval for var in eqn.outvars)
        return [None] * len(eqn.outvars)

    interpret(trace.jaxpr, trace.consts, [None] * len(trace.jaxpr.invars), lambda _: None, step)
    return avals

"""The calculus of curvature: what sums, products and functions of functions are, given what their parts are.

The rules are those of disciplined convex programming (Grant, Boyd, Ye 2006, "Disciplined convex programming", section 6; Boyd,
Vandenberghe 2004, "Convex optimization", sections 3.2 and 3.5), with two additions: polynomials of degree ≤ 2 are carried along exactly,
coefficients and all, and sums of exponentials are known to be log-convex.

A `Node` describes an array, element by element, and a whole family of functions at once. The axes of its arrays are
(members, *shape, *more); any of them may have length 1 and then stands for equal entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import zip_longest
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

ROUNDING: Final = 1e-12
"""An eigenvalue below this, per row of its matrix, is zero, once every coordinate is scaled such that the terms summed into the matrix
are at most 1. That is some thousand roundings, more than any constraint makes."""


def signs(matrix: Array, size: Array, rounding: float = ROUNDING) -> tuple[Array, Array]:
    """Signs of the smallest and the largest eigenvalue of symmetric matrices; −1 and 1 if not finite.

    By Sylvester's law of inertia a congruence keeps them, so each coordinate is first scaled to a unit of its own, such that no row of
    `size`, which bounds the terms that were added up to `matrix`, exceeds 1. What then lies below `rounding`, per row, counts as 0.
    """
    matrix, size = np.broadcast_arrays(matrix, size)
    finite = np.asarray(np.isfinite(size + matrix).all((-1, -2)))
    matrix, size = (np.where(finite[..., None, None], each, 0) for each in (matrix, size))
    scale = np.ones(size.shape[:-1])
    for _ in range(8):  # Ruiz equilibration
        row = np.max(size * scale[..., :, None] * scale[..., None, :], axis=-1)
        if np.all((row == 0) | (np.abs(row - 1) < 0.5)):
            break
        scale /= np.sqrt(np.where(row > 0, row, 1))
    eigenvalues = np.linalg.eigvalsh(matrix * scale[..., :, None] * scale[..., None, :])
    eigenvalues[np.abs(eigenvalues) <= rounding * matrix.shape[-1]] = 0
    return np.where(finite, np.sign(eigenvalues[..., 0]), -1), np.where(finite, np.sign(eigenvalues[..., -1]), 1)


def block(matrix: Array, slot: int | None) -> Array:
    """Of a Hessian (…, arity, d, arity, d) the (d, d) block of one position, or if None all of it as a square matrix."""
    n = math.prod(matrix.shape[-2:])
    return matrix.reshape(*matrix.shape[:-4], n, n) if slot is None else matrix[..., slot, :, slot, :]


# ----------------------------------------------------------------------------------------------------------------- the node


class Bend(NamedTuple):
    """How a function bends, proven element by element. Affine is both convex and concave.

    Attributes:
        convex: bool.
        concave: bool.
        logconvex: bool; positive, with a convex logarithm (hence convex).
        strict: bool, with one more axis of length arity + 2. Given that the element is convex or concave, whether it is
            strictly so: jointly, in each position alone, and (last) in the weakest sense, not affine.
    """

    convex: Array
    concave: Array
    logconvex: Array
    strict: Array


@dataclass(frozen=True, eq=False)
class Node:
    """What an intermediate array is as a function of the positions.

    Attributes:
        shape: of the array.
        degree: bound on the polynomial degree, if proven to be ≤ 2.
        low: lower bound, where the function is defined.
        high: upper bound, likewise.
        terms: (c, b, H) of c + b·x + ½ xᵀHx up to the degree, if known: b has two more axes (arity, d), H four.
        sizes: the same sums with every term positive: what rounding errors are relative to.
        rule: how it bends, for lack of terms.
        made: by which rule and of what, for rules that look further back than one step.
    """

    shape: tuple[int, ...]
    degree: int | None
    low: Array
    high: Array
    terms: tuple[Array, ...] | None = None
    sizes: tuple[Array, ...] = ()
    rule: Bend | None = None
    made: tuple[str, tuple[Node, ...]] = ("", ())

    @property
    def value(self) -> Array | None:
        """The value of a known constant."""
        return self.terms[0] if self.terms is not None and self.degree == 0 else None

    @cached_property
    def bend(self) -> Bend:
        """How it bends; of a quadratic by its eigenvalues."""
        one, more = (1,) * (len(self.shape) + 1), (1,)
        no, yes, none = np.zeros(one, bool), np.ones(one, bool), np.zeros(one + more, bool)
        if self.value is not None:
            finite = np.isfinite(self.value)
            return Bend(finite, finite, finite & (self.value > 0), none)
        if self.degree in {0, 1}:
            return Bend(yes, yes, no, none)
        if self.terms is None:
            return self.rule or Bend(no, no, no, none)
        hessian, size = self.terms[2], self.sizes[2]
        slots = (None, *range(hessian.shape[-2]))
        least, largest = np.stack([signs(block(hessian, slot), block(size, slot)) for slot in slots], axis=-1)
        convex, concave = least[..., 0] >= 0, largest[..., 0] <= 0
        strict = np.concatenate([np.where(convex[..., None], least > 0, largest < 0), ~(convex & concave)[..., None]], axis=-1)
        return Bend(convex, concave, no, strict)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """`low` and `high`, sharpened by the sign of a quadratic, if it is clear."""
        if self.degree != 2 or self.terms is None:
            return self.low, self.high
        above, below = _nonnegative(self, 1e-9), _nonnegative(negative(self), 1e-9)
        return np.where(above, np.maximum(self.low, 0), self.low), np.where(below, np.minimum(self.high, 0), self.high)


def _nonnegative(q: Node, margin: float, rounding: float = ROUNDING) -> Array:
    """Whether a quadratic is ≥ 0 everywhere, even if its constant term were less by `margin`: iff [[H, b], [bᵀ, 2c]] is so definite."""
    matrix, size = _lifted(q.terms or ()), _lifted(q.sizes)
    matrix[..., -1, -1] -= margin * size[..., -1, -1]
    return signs(matrix, size, rounding)[0] >= 0


def _lifted(terms: tuple[Array, ...]) -> Array:
    """[[H, b], [bᵀ, 2c]]."""
    c, b, hessian = terms
    H = block(hessian, None)
    n = H.shape[-1]
    b = b.reshape(*b.shape[:-2], n)
    matrix = np.empty((*np.broadcast_shapes(c.shape, b.shape[:-1], H.shape[:-2]), n + 1, n + 1))
    matrix[..., :n, :n], matrix[..., :n, n], matrix[..., n, :n], matrix[..., n, n] = H, b, b, 2 * c
    return matrix


def constant(value: Any) -> Node:
    """A known constant; its first axis runs over the members."""
    value = np.asarray(value)
    if value.dtype.kind not in "biuf":
        return opaque(value.shape[1:])
    value = value.astype(np.float64)
    return Node(value.shape[1:], 0, value, value, (value,), (np.abs(value),))


def opaque(shape: tuple[int, ...]) -> Node:
    """A constant of unknown value."""
    return unknown(shape, 0)


def unknown(shape: tuple[int, ...], degree: int | None = None) -> Node:
    """A function of which nothing else is known."""
    infinite = np.full((1,) * (len(shape) + 1), np.inf)
    return Node(shape, degree, -infinite, infinite)


def position(slot: int, arity: int, dimension: int) -> Node:
    """The position in one of the slots of ψ."""
    gradient = np.zeros((1, dimension, arity, dimension))
    gradient[0, :, slot, :] = np.eye(dimension)
    return replace(unknown((dimension,), 1), terms=(np.zeros((1, dimension)), gradient), sizes=(np.zeros((1, dimension)), gradient))


# ------------------------------------------------------------------------------------------------------------ the operators


def arranged(nodes: Sequence[Node], index: Array) -> Node:
    """The array whose entries are those numbered by `index` among the entries of all `nodes`, one after another."""

    def pool(*parts: Array) -> Array:
        extra = np.broadcast_shapes(*(part.shape[1 + len(node.shape) :] for node, part in zip(nodes, parts, strict=True)))
        members = max(len(part) for part in parts)
        flat = [
            np.broadcast_to(part, (members, *node.shape, *extra)).reshape(members, math.prod(node.shape), *extra)
            for node, part in zip(nodes, parts, strict=True)
        ]
        together = flat[0] if len(flat) == 1 else np.concatenate(flat, axis=1)
        return np.take(together, index, axis=1) if index.ndim else together[:, int(index)]

    degree = highest(node.degree for node in nodes)
    low, high = pool(*(node.low for node in nodes)), pool(*(node.high for node in nodes))
    made = ("arranged", tuple(nodes))
    known = [node.terms for node in nodes if node.terms is not None]
    if len(known) == len(nodes) and degree is not None:
        terms, sizes = (
            tuple(pool(*(_term(node, each, order) for node, each in zip(nodes, parts, strict=True))) for order in range(degree + 1))
            for parts in (known, [node.sizes for node in nodes])
        )
        return Node(index.shape, degree, low, high, terms, sizes, made=made)
    rule = Bend(*(pool(*parts) for parts in zip(*(node.bend for node in nodes), strict=True)))
    return Node(index.shape, degree, low, high, rule=rule, made=made)


def _term(node: Node, terms: tuple[Array, ...], order: int) -> Array:
    return terms[order] if order < len(terms) else np.zeros((1,) * (1 + len(node.shape) + 2 * order))


def highest(degrees: Iterable[int | None]) -> int | None:
    """The largest, or None if one is unknown."""
    given = list(degrees)
    known = [degree for degree in given if degree is not None]
    return max(known) if len(known) == len(given) else None


def _aligned(*nodes: Node) -> list[Node]:
    """All of one shape: entries along axes of length 1 are repeated, as are scalars."""
    shape = np.broadcast_shapes(*(node.shape for node in nodes))
    numbers = (np.arange(math.prod(node.shape)).reshape(node.shape) for node in nodes)
    return [node if node.shape == shape else arranged([node], np.broadcast_to(n, shape)) for node, n in zip(nodes, numbers, strict=True)]


def plus(a: Node, b: Node) -> Node:
    """Curvatures add if they agree."""
    a, b = _aligned(a, b)
    for logarithm, shift in ((a, b), (b, a)):
        exponents = _shifted_exponents(logarithm, shift)
        if exponents is not None:
            return atom("log", fold(plus, atom("exp", exponents)))
    degree, low, high = highest((a.degree, b.degree)), a.low + b.low, a.high + b.high
    if a.terms is not None and b.terms is not None:
        return Node(a.shape, degree, low, high, _sum(a.terms, b.terms), _sum(a.sizes, b.sizes))
    one, two = a.bend, b.bend
    logconvex = one.logconvex & two.logconvex
    return Node(
        a.shape, degree, low, high, rule=Bend(one.convex & two.convex, one.concave & two.concave, logconvex, one.strict | two.strict)
    )


def _sum(left: tuple[Array, ...], right: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(p + q if p is not None and q is not None else q if p is None else p for p, q in zip_longest(left, right))


def _shifted_exponents(logarithm: Node, shift: Node) -> Node | None:
    """If this is log Σ exp(u − m) and m, then u: their sum is log Σ exp(u) whatever m is. `jax.nn.logsumexp` computes it so."""
    node: Node | None = _stripped(logarithm)
    for name in ("log", "reduce_sum", "exp"):
        node = _stripped(node.made[1][0]) if node is not None and node.made[0] == name else None
    if node is None or node.made[0] != "sub":
        return None
    exponents, subtrahend = node.made[1]
    return exponents if _stripped(subtrahend) is _stripped(shift) else None


def _stripped(node: Node) -> Node:
    """The node before its only entry was reshaped or repeated."""
    while node.made[0] == "arranged" and len(node.made[1]) == 1 and math.prod(node.made[1][0].shape) == 1:
        (node,) = node.made[1]
    return node


def minus(a: Node, b: Node) -> Node:
    """As a sum."""
    a, b = _aligned(a, b)
    return replace(plus(a, negative(b)), made=("sub", (a, b)))


def negative(a: Node) -> Node:
    """Turns convex into concave."""
    return times(a, constant(-np.ones((1,) * (len(a.shape) + 1))))


def times(a: Node, b: Node) -> Node:
    """By a constant, whose sign decides; degrees add; products of log-convex functions are log-convex."""
    if a is b:
        return power(a, np.array(2.0))
    a, b = _aligned(a, b)
    if a.degree == 0:
        a, b = b, a
    degree = None if a.degree is None or b.degree is None or a.degree + b.degree > 2 else a.degree + b.degree
    corners = [np.where((p == 0) | (q == 0), 0, p * q) for p in (a.low, a.high) for q in (b.low, b.high)]
    node = Node(a.shape, degree, reduce(np.minimum, corners), reduce(np.maximum, corners))
    if degree is not None and a.terms is not None and b.terms is not None:
        return replace(node, terms=_product(a.terms, b.terms), sizes=_product(a.sizes, b.sizes))
    bend = a.bend
    if b.value is None:
        logconvex = bend.logconvex & b.bend.logconvex
        return replace(node, rule=Bend(logconvex, np.zeros_like(logconvex), logconvex, np.zeros((*logconvex.shape, 1), bool)))
    k, finite = b.value, np.isfinite(b.value)
    convex = ((k >= 0) & bend.convex) | ((k <= 0) & bend.concave)
    concave = ((k >= 0) & bend.concave) | ((k <= 0) & bend.convex)
    return replace(node, rule=Bend(convex & finite, concave & finite, bend.logconvex & (k > 0), bend.strict & (k != 0)[..., None]))


def _product(left: tuple[Array, ...], right: tuple[Array, ...]) -> tuple[Array, ...]:
    """Of two polynomials whose degrees add up to at most 2: (p·x)(q·x) = ½ xᵀ(pqᵀ + qpᵀ)x."""

    def one(i: int, p: Array, j: int, q: Array) -> Array:
        if i == j == 1:
            outer = p[..., :, :, None, None] * q[..., None, None, :, :]
            return outer + np.moveaxis(outer, (-4, -3), (-2, -1))
        return p.reshape(*p.shape, *(1,) * 2 * j) * q if i == 0 else p * q.reshape(*q.shape, *(1,) * 2 * i)

    orders = [(i, p, j, q) for i, p in enumerate(left) for j, q in enumerate(right)]
    return tuple(
        reduce(np.add, [one(i, p, j, q) for i, p, j, q in orders if i + j == total]) for total in range(len(left) + len(right) - 1)
    )


def larger(a: Node, b: Node) -> Node:
    """The maximum of convex functions is convex."""
    a, b = _aligned(a, b)
    for one, two in ((a, b), (b, a)):
        if two.value is not None and np.all(one.bounds[0] >= two.value):
            return one
    low, high = np.maximum(a.bounds[0], b.bounds[0]), np.maximum(a.bounds[1], b.bounds[1])
    if a.degree == b.degree == 0:
        return opaque(a.shape) if a.value is None or b.value is None else constant(low)
    p, q = a.bend, b.bend
    concave = np.zeros((1,) * (len(a.shape) + 1), bool)
    return Node(a.shape, None, low, high, rule=Bend(p.convex & q.convex, concave, p.logconvex & q.logconvex, p.strict & q.strict))


def smaller(a: Node, b: Node) -> Node:
    """The minimum of concave functions is concave."""
    return negative(larger(negative(a), negative(b)))


def fold(operator: Callable[[Node, Node], Node], node: Node, axes: Sequence[int] | None = None) -> Node:
    """An associative operator over the entries along `axes`, all of them by default."""
    axes = range(len(node.shape)) if axes is None else axes
    index = np.arange(math.prod(node.shape)).reshape(node.shape)
    columns = np.moveaxis(index, tuple(axes), range(len(axes))).reshape(-1, *(n for axis, n in enumerate(node.shape) if axis not in axes))
    folded = reduce(operator, (arranged([node], column) for column in columns))
    return replace(folded, made=("reduce_sum", (node,))) if operator is plus and folded.shape == () else folded


def dot(a: Node, b: Node, dimension_numbers: Any) -> Node:
    """Products of all pairs of rows, summed."""
    ((contract_a, contract_b), (batch_a, batch_b)) = dimension_numbers

    def rows(node: Node, contract: Sequence[int], batch: Sequence[int]) -> Array:
        free = [axis for axis in range(len(node.shape)) if axis not in (*contract, *batch)]
        index = np.arange(math.prod(node.shape)).reshape(node.shape).transpose(*batch, *free, *contract)
        sizes = [[node.shape[axis] for axis in axes] for axes in (batch, free, contract)]
        return index.reshape(*sizes[0], math.prod(sizes[1]), math.prod(sizes[2]))

    left, right = rows(a, contract_a, batch_a), rows(b, contract_b, batch_b)
    left, right = np.broadcast_arrays(left[..., :, None, :], right[..., None, :, :])
    one = arranged([a], left)
    two = one if a is b and np.array_equal(left, right) else arranged([b], right)
    return fold(plus, times(one, two), [left.ndim - 1])


# ---------------------------------------------------------------------------------------------------- functions of one number


class Facts(NamedTuple):
    """A function h of one real number, on an interval.

    Attributes:
        convex: bool.
        concave: bool.
        rising: bool; if h is defined on part of the line only, then also once extended by +∞ if convex and −∞ if concave.
        falling: bool; likewise.
        low: least value.
        high: largest value.
    """

    convex: Any
    concave: Any
    rising: Any
    falling: Any
    low: Array
    high: Array


Atom = Callable[[Array, Array], Facts]


def _rising(h: Callable[[Array], Array], convex: str, domain: float = -np.inf) -> Atom:
    """A rising function that is convex: always, never, from 0 up, or up to 0; elsewhere it is concave."""

    def facts(low: Array, high: Array) -> Facts:
        holds = {"always": (True, False), "never": (False, True), "from 0": (low >= 0, high <= 0), "to 0": (high <= 0, low >= 0)}
        return Facts(*holds[convex], True, False, np.where(high < domain, np.nan, h(np.maximum(low, domain))), h(high))

    return facts


def _even(h: Callable[[Array], Array]) -> Atom:
    """A convex function of the absolute value."""

    def facts(low: Array, high: Array) -> Facts:
        ends = h(low), h(high)
        return Facts(
            True, False, low >= 0, high <= 0, np.where((low < 0) & (high > 0), h(np.zeros(())), np.minimum(*ends)), np.maximum(*ends)
        )

    return facts


def _wave(h: Callable[[Array], Array]) -> Atom:
    return lambda low, high: Facts(False, False, False, False, *(np.where(low == high, h(low), end) for end in (-1.0, 1.0)))


ATOMS: Final[Mapping[str, Atom]] = {
    "exp": _rising(np.exp, "always"),
    "exp2": _rising(np.exp2, "always"),
    "expm1": _rising(np.expm1, "always"),
    "log": _rising(np.log, "never", 0.0),
    "log1p": _rising(np.log1p, "never", -1.0),
    "sqrt": _rising(np.sqrt, "never", 0.0),
    "cbrt": _rising(np.cbrt, "to 0"),
    "logistic": _rising(lambda x: 1 / (1 + np.exp(-x)), "to 0"),
    "tanh": _rising(np.tanh, "to 0"),
    "atan": _rising(np.arctan, "to 0"),
    "asinh": _rising(np.arcsinh, "to 0"),
    "sinh": _rising(np.sinh, "from 0"),
    "cosh": _even(np.cosh),
    "abs": _even(np.abs),
    "sin": _wave(np.sin),
    "cos": _wave(np.cos),
}


def _power(p: Array) -> Atom:
    """x^p; with p no integer it is defined for x ≥ 0 only."""

    def facts(low: Array, high: Array) -> Facts:
        even, odd = p % 2 == 0, p % 2 == 1
        whole = even | odd
        positive, negative = low >= 0, high <= 0
        convex = np.where(p >= 0, np.where(whole, even | positive, p > 1), np.where(whole, positive | (even & negative), True))
        concave = np.where(p >= 0, np.where(whole, (odd & negative) | (p == 0), p < 1), odd & negative)
        rising = np.where(p >= 0, np.where(whole, odd | positive, (p < 1) | positive), even & negative)
        falling = np.where(p >= 0, even & negative, np.where(even, positive, np.where(odd, positive | negative, True)))
        start, end = (np.where(whole, side, np.maximum(side, 0)) + 0.0 for side in (low, high))  # + 0.0 makes 0 of −0
        ends = start**p, end**p
        spans_zero, least, most = (start < 0) & (end > 0), np.minimum(*ends), np.maximum(*ends)
        least = np.where(even & (p > 0) & spans_zero, 0, np.where((p < 0) & ~(start >= 0), np.where(even, 0, -np.inf), least))
        most = np.where((p < 0) & ~(start >= 0), np.where(odd & negative, 0, np.inf), most)
        return Facts(convex, concave, rising, falling, least, most)

    return facts


def atom(name: str, a: Node) -> Node:
    """A function of one number from `ATOMS`."""
    low, high = a.bounds
    if name == "abs" and np.all(low >= 0):
        return a
    if name == "abs" and np.all(high <= 0):
        return negative(a)
    node = replace(_composed(ATOMS[name], a), made=(name, (a,)))
    if name == "exp" and node.rule is not None:
        return replace(node, rule=node.rule._replace(logconvex=node.rule.convex))
    if name == "log" and node.rule is not None:
        # By log-convexity alone nothing is known about strictness.
        rule, known = node.rule, a.bend.logconvex
        return replace(node, rule=rule._replace(convex=rule.convex | known, strict=rule.strict & ~known[..., None]))
    if name == "sqrt" and a.degree == 2 and a.terms is not None:
        return replace(node, rule=_cone(a, node.bend))
    return node


def _composed(facts: Atom, a: Node) -> Node:
    """The composition rule: h(u) is convex if h is, and u is affine, or convex where h rises, or concave where h falls."""
    h = facts(*a.bounds)
    if a.degree == 0:
        return opaque(a.shape) if a.value is None else constant(h.low)
    u = a.bend
    affine = u.convex & u.concave
    convex = h.convex & (affine | (h.rising & u.convex) | (h.falling & u.concave))
    concave = h.concave & (affine | (h.rising & u.concave) | (h.falling & u.convex))
    strict = u.strict & ~affine[..., None]
    if a.degree == 1 and a.terms is not None:  # all of `ATOMS` bend a line
        varies = np.any(np.abs(a.terms[1]) > ROUNDING * a.sizes[1], axis=(-2, -1))
        strict = np.stack([np.zeros_like(varies)] * (a.terms[1].shape[-2] + 1) + [varies], axis=-1)
    return Node(a.shape, None, h.low, h.high, rule=Bend(convex, concave, np.zeros_like(convex), strict))


def _cone(q: Node, bend: Bend) -> Bend:
    """√q for a quadratic q: convex iff q ≥ 0 everywhere, so that q = ‖affine‖² + constant; if the constant is positive, then strictly so
    wherever q is. Sums of squares show it by their bounds; for others the constant 0 must be recognised in spite of rounding."""
    cone = (q.low >= 0) | _nonnegative(q, 0.0, 4e-15)
    smooth = _nonnegative(q, 1e-6) & (q.sizes[0] > 0)
    kind = np.arange(q.bend.strict.shape[-1]) < q.bend.strict.shape[-1] - 1
    strict = q.bend.strict & (smooth[..., None] | ~kind)
    return bend._replace(convex=bend.convex | cone, strict=np.where(cone[..., None], strict, bend.strict))


def power(a: Node, p: Array) -> Node:
    """a^p for known p."""
    if np.all(p == 0):
        return constant(np.ones((1,) * (len(a.shape) + 1)))
    if np.all(p == 1):
        return a
    if a.degree == 0:
        return opaque(a.shape) if a.value is None else constant(a.value**p)
    if np.all(p == 2):
        return square(a)
    if np.all(p == 0.5):
        return atom("sqrt", a)
    node = _composed(_power(p), a)
    curved, bend = (p != 0) & (p != 1), node.bend
    return replace(node, rule=bend._replace(strict=bend.strict & curved[..., None], logconvex=a.bend.logconvex & (p > 0)))


def square(a: Node) -> Node:
    """a², of a function that varies: a quadratic if a is affine or the root of one."""
    if a.made[0] == "sqrt" and np.all(a.made[1][0].bounds[0] >= 0):
        return a.made[1][0]
    node = _composed(_power(np.array(2.0)), a)
    if a.degree != 1:
        return node
    return replace(node, degree=2, terms=a.terms and _product(a.terms, a.terms), sizes=a.sizes and _product(a.sizes, a.sizes))


def raised(base: Node, exponent: Node) -> Node:
    """Of nodes, either of them a known constant: k^u = exp(u log k)."""
    base, exponent = _aligned(base, exponent)
    if exponent.value is not None:
        return power(base, exponent.value)
    if base.value is not None and np.all(base.value > 0):
        return atom("exp", times(exponent, constant(np.log(base.value))))
    return unknown(base.shape, 0 if base.degree == exponent.degree == 0 else None)

"""The calculus of curvature: `Node`s of sums, products and compositions, computed from the nodes of their operands.

The rules are those of disciplined convex programming (Grant, Boyd, Ye 2006, "Disciplined convex programming", section 6; Boyd,
Vandenberghe 2004, "Convex optimization", sections 3.2 and 3.5), with two additions: polynomials of degree ≤ 2 keep their exact
coefficients, and log-convexity is tracked for sums of exponentials.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import reduce
from itertools import zip_longest
from typing import Any

import numpy as np

from consat.problem.constraints.atoms import ATOMS, Atom, powers
from consat.problem.constraints.node import ROUNDING, Array, Bend, Node, constant, opaque, unknown


def arranged(nodes: Sequence[Node], index: Array) -> Node:
    """The node of an array made of entries of other nodes.

    Args:
        nodes: the source nodes; their entries are numbered consecutively.
        index: for each entry of the new array, the number of its source entry.
    """

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
    """The largest degree; None if any is unknown."""
    given = list(degrees)
    known = [degree for degree in given if degree is not None]
    return max(known) if len(known) == len(given) else None


def _aligned(*nodes: Node) -> list[Node]:
    """The nodes broadcast to a common shape."""
    shape = np.broadcast_shapes(*(node.shape for node in nodes))
    numbers = (np.arange(math.prod(node.shape)).reshape(node.shape) for node in nodes)
    return [node if node.shape == shape else arranged([node], np.broadcast_to(n, shape)) for node, n in zip(nodes, numbers, strict=True)]


def plus(a: Node, b: Node) -> Node:
    """The node of a + b. The sum is convex (concave) if both terms are."""
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
    """u, if the operands are log Σ exp(u − m) and m; else None.

    Their sum is log Σ exp(u) for any m. `jax.nn.logsumexp` computes it in this form.
    """
    node: Node | None = _stripped(logarithm)
    for name in ("log", "reduce_sum", "exp"):
        node = _stripped(node.made[1][0]) if node is not None and node.made[0] == name else None
    if node is None or node.made[0] != "sub":
        return None
    exponents, subtrahend = node.made[1]
    return exponents if _stripped(subtrahend) is _stripped(shift) else None


def _stripped(node: Node) -> Node:
    """The scalar node behind any reshaping or repetition of its single entry."""
    while node.made[0] == "arranged" and len(node.made[1]) == 1 and math.prod(node.made[1][0].shape) == 1:
        (node,) = node.made[1]
    return node


def minus(a: Node, b: Node) -> Node:
    """The node of a − b."""
    a, b = _aligned(a, b)
    return replace(plus(a, negative(b)), made=("sub", (a, b)))


def negative(a: Node) -> Node:
    """The node of −a: convex becomes concave and vice versa."""
    return times(a, constant(-np.ones((1,) * (len(a.shape) + 1))))


def times(a: Node, b: Node) -> Node:
    """The node of a · b.

    The sign of a constant factor decides the curvature. Degrees add. A product of log-convex functions is log-convex.
    """
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
    """Coefficients of the product of two polynomials whose degrees add up to at most 2: (p·x)(q·x) = ½ xᵀ(pqᵀ + qpᵀ)x."""

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
    """The node of max(a, b): convex if both operands are."""
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
    """The node of min(a, b): concave if both operands are."""
    return negative(larger(negative(a), negative(b)))


def fold(operator: Callable[[Node, Node], Node], node: Node, axes: Sequence[int] | None = None) -> Node:
    """The node of a reduction: an associative operator over the entries along `axes`; over all entries if None."""
    axes = range(len(node.shape)) if axes is None else axes
    index = np.arange(math.prod(node.shape)).reshape(node.shape)
    columns = np.moveaxis(index, tuple(axes), range(len(axes))).reshape(-1, *(n for axis, n in enumerate(node.shape) if axis not in axes))
    folded = reduce(operator, (arranged([node], column) for column in columns))
    return replace(folded, made=("reduce_sum", (node,))) if operator is plus and folded.shape == () else folded


def dot(a: Node, b: Node, dimension_numbers: Any) -> Node:
    """The node of a `dot_general` of a and b.

    Args:
        a: left operand.
        b: right operand.
        dimension_numbers: contracted and batch axes, as JAX gives them.
    """
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


def atom(name: str, a: Node) -> Node:
    """The node of h(a), where h is the function `name` of `ATOMS`."""
    low, high = a.bounds
    if name == "abs" and np.all(low >= 0):
        return a
    if name == "abs" and np.all(high <= 0):
        return negative(a)
    node = replace(_composed(ATOMS[name], a), made=(name, (a,)))
    if name == "exp" and node.rule is not None:
        return replace(node, rule=node.rule._replace(logconvex=node.rule.convex))
    if name == "log" and node.rule is not None:
        # Log-convexity proves that the logarithm is convex, but not that it is strictly so.
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
    if a.degree == 1 and a.terms is not None:  # no function of `ATOMS` is affine on the whole line
        varies = np.any(np.abs(a.terms[1]) > ROUNDING * a.sizes[1], axis=(-2, -1))
        strict = np.stack([np.zeros_like(varies)] * (a.terms[1].shape[-2] + 1) + [varies], axis=-1)
    return Node(a.shape, None, h.low, h.high, rule=Bend(convex, concave, np.zeros_like(convex), strict))


def _cone(q: Node, bend: Bend) -> Bend:
    """The curvature of √q for a quadratic q.

    It is convex iff q ≥ 0 everywhere, so that q = ‖affine‖² + constant. If the constant is positive, √q is strictly convex where q is.
    For a sum of squares the bounds prove q ≥ 0. For other q a tolerance is needed, because rounding may make a constant of 0 negative.
    """
    cone = (q.low >= 0) | q.nonnegative(0.0, 4e-15)
    smooth = q.nonnegative(1e-6) & (q.sizes[0] > 0)
    kind = np.arange(q.bend.strict.shape[-1]) < q.bend.strict.shape[-1] - 1
    strict = q.bend.strict & (smooth[..., None] | ~kind)
    return bend._replace(convex=bend.convex | cone, strict=np.where(cone[..., None], strict, bend.strict))


def power(a: Node, p: Array) -> Node:
    """The node of a^p for known exponents p."""
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
    node = _composed(powers(p), a)
    curved, bend = (p != 0) & (p != 1), node.bend
    return replace(node, rule=bend._replace(strict=bend.strict & curved[..., None], logconvex=a.bend.logconvex & (p > 0)))


def square(a: Node) -> Node:
    """The node of a² for a function a that is not constant. It is a quadratic if a is affine or the square root of a quadratic."""
    if a.made[0] == "sqrt" and np.all(a.made[1][0].bounds[0] >= 0):
        return a.made[1][0]
    node = _composed(powers(np.array(2.0)), a)
    if a.degree != 1:
        return node
    return replace(node, degree=2, terms=a.terms and _product(a.terms, a.terms), sizes=a.sizes and _product(a.sizes, a.sizes))


def raised(base: Node, exponent: Node) -> Node:
    """The node of base^exponent, if one of the two is a known constant: k^u = exp(u log k). Else an unknown node."""
    base, exponent = _aligned(base, exponent)
    if exponent.value is not None:
        return power(base, exponent.value)
    if base.value is not None and np.all(base.value > 0):
        return atom("exp", times(exponent, constant(np.log(base.value))))
    return unknown(base.shape, 0 if base.degree == exponent.degree == 0 else None)

"""What is known of an intermediate array as a function of the positions, element by element, of a whole family at once.

The axes of a node's arrays are (members, *shape, *more); any of them may have length 1 and then stands for equal entries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
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
        opposite = replace(self, terms=tuple(-term for term in self.terms))
        above, below = self.nonnegative(1e-9), opposite.nonnegative(1e-9)
        return np.where(above, np.maximum(self.low, 0), self.low), np.where(below, np.minimum(self.high, 0), self.high)

    def nonnegative(self, margin: float, rounding: float = ROUNDING) -> Array:
        """Whether a quadratic is ≥ 0 everywhere, even if its constant term were less by `margin`: iff [[H, b], [bᵀ, 2c]] is so definite."""
        matrix, size = _lifted(self.terms or ()), _lifted(self.sizes)
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

"""`Node`: proven properties of an intermediate array of ψ as a function of the positions, for each element and each member of a family.

The axes of a node's arrays are (members, *shape, *more). An axis of length 1 stands for equal entries.
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
"""Tolerance for eigenvalues, per row of the matrix: smaller ones count as 0. It applies after scaling each coordinate so that the terms
summed into the matrix are at most 1. It allows some thousand rounding errors, more than any constraint makes."""


def signs(matrix: Array, size: Array, rounding: float = ROUNDING) -> tuple[Array, Array]:
    """Signs of the smallest and the largest eigenvalue of symmetric matrices; −1 and 1 if a matrix is not finite.

    Each coordinate is first scaled so that the entries of `size` are at most about 1. By Sylvester's law of inertia this keeps the signs.

    Args:
        matrix: (…, n, n) symmetric matrices.
        size: (…, n, n) bounds on the sums of absolute terms that were added up to `matrix`.
        rounding: scaled eigenvalues up to n times this count as 0.
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
    """The (d, d) block of one position in a Hessian (…, arity, d, arity, d). If `slot` is None, the whole Hessian as a square matrix."""
    n = math.prod(matrix.shape[-2:])
    return matrix.reshape(*matrix.shape[:-4], n, n) if slot is None else matrix[..., slot, :, slot, :]


class Bend(NamedTuple):
    """The proven curvature of a function, for each element. An affine function is both convex and concave.

    Attributes:
        convex: bool.
        concave: bool.
        logconvex: bool; positive with a convex logarithm, hence convex.
        strict: bool, with one more axis of length arity + 2: if the element is convex or concave, whether it is strictly so jointly
            (entry 0), strictly so in each position alone (entries 1 to arity), and not affine (last entry).
    """

    convex: Array
    concave: Array
    logconvex: Array
    strict: Array


@dataclass(frozen=True, eq=False)
class Node:
    """Proven properties of an intermediate array as a function of the positions.

    Attributes:
        shape: shape of the array, for one member.
        degree: upper bound on the polynomial degree, if proven to be ≤ 2; else None.
        low: lower bound on the values, where the function is defined.
        high: upper bound on the values, where the function is defined.
        terms: coefficients (c, b, H) of c + b·x + ½ xᵀHx, up to the degree; None if unknown. b has two more axes (arity, d), H has four.
        sizes: the same sums over absolute values: the scale of the rounding errors in `terms`.
        rule: curvature, if `terms` is None.
        made: name of the operation and its operands, for rules that look back more than one step.
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
        """The curvature; from the eigenvalues of the Hessian if the function is a quadratic."""
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
        """`low` and `high`, tightened to 0 where a quadratic is clearly ≥ 0 or ≤ 0 everywhere."""
        if self.degree != 2 or self.terms is None:
            return self.low, self.high
        opposite = replace(self, terms=tuple(-term for term in self.terms))
        above, below = self.nonnegative(1e-9), opposite.nonnegative(1e-9)
        return np.where(above, np.maximum(self.low, 0), self.low), np.where(below, np.minimum(self.high, 0), self.high)

    def nonnegative(self, margin: float, rounding: float = ROUNDING) -> Array:
        """Whether a quadratic is ≥ 0 everywhere: iff [[H, b], [bᵀ, 2c]] is positive semidefinite.

        Args:
            margin: the last diagonal entry of the matrix, 2c, is first reduced by this fraction of its size.
            rounding: as in `signs`.
        """
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
    """The node of a known constant. The first axis of `value` runs over the members."""
    value = np.asarray(value)
    if value.dtype.kind not in "biuf":
        return opaque(value.shape[1:])
    value = value.astype(np.float64)
    return Node(value.shape[1:], 0, value, value, (value,), (np.abs(value),))


def opaque(shape: tuple[int, ...]) -> Node:
    """The node of a constant with unknown value."""
    return unknown(shape, 0)


def unknown(shape: tuple[int, ...], degree: int | None) -> Node:
    """The node of a function of which only the shape and perhaps the degree are known."""
    infinite = np.full((1,) * (len(shape) + 1), np.inf)
    return Node(shape, degree, -infinite, infinite)


def position(slot: int, arity: int, dimension: int) -> Node:
    """The node of the position that is argument number `slot` of ψ."""
    gradient = np.zeros((1, dimension, arity, dimension))
    gradient[0, :, slot, :] = np.eye(dimension)
    return replace(unknown((dimension,), 1), terms=(np.zeros((1, dimension)), gradient), sizes=(np.zeros((1, dimension)), gradient))

"""Scalar functions of one real number: their convexity, monotonicity and range on an interval."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Facts(NamedTuple):
    """Proven properties of a function h on an interval. Each field has the shape of the interval's bounds.

    Attributes:
        convex: whether h is convex.
        concave: whether h is concave.
        rising: whether h is nondecreasing. If h is defined on part of the line only, this holds for its extension by +∞ (convex h) or −∞
            (concave h).
        falling: whether h is nonincreasing; likewise.
        low: smallest value of h, or a lower bound.
        high: largest value of h, or an upper bound.
    """

    convex: Any
    concave: Any
    rising: Any
    falling: Any
    low: Array
    high: Array


Atom = Callable[[Array, Array], Facts]
"""From the bounds (low, high) of the argument to the properties of h on that interval."""


def _rising(h: Callable[[Array], Array], convex: str, domain: float = -np.inf) -> Atom:
    """The atom of an increasing function.

    Args:
        h: the function.
        convex: where h is convex: ``always``, ``never``, ``from 0`` upwards, or up ``to 0``. Elsewhere it is concave.
        domain: smallest argument at which h is defined.
    """

    def facts(low: Array, high: Array) -> Facts:
        holds = {"always": (True, False), "never": (False, True), "from 0": (low >= 0, high <= 0), "to 0": (high <= 0, low >= 0)}
        return Facts(*holds[convex], True, False, np.where(high < domain, np.nan, h(np.maximum(low, domain))), h(high))

    return facts


def _even(h: Callable[[Array], Array]) -> Atom:
    """The atom of an even, convex function h, such as cosh."""

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


def powers(p: Array) -> Atom:
    """The atom of x^p. If p is not an integer, it is defined for x ≥ 0 only."""

    def facts(low: Array, high: Array) -> Facts:
        even, odd = p % 2 == 0, p % 2 == 1
        whole = even | odd
        positive, negative = low >= 0, high <= 0
        convex = np.where(p >= 0, np.where(whole, even | positive, p > 1), np.where(whole, positive | (even & negative), True))
        concave = np.where(p >= 0, np.where(whole, (odd & negative) | (p == 0), p < 1), odd & negative)
        rising = np.where(p >= 0, np.where(whole, odd | positive, (p < 1) | positive), even & negative)
        falling = np.where(p >= 0, even & negative, np.where(even, positive, np.where(odd, positive | negative, True)))
        start, end = (np.where(whole, side, np.maximum(side, 0)) + 0.0 for side in (low, high))  # + 0.0 turns −0 into 0
        ends = start**p, end**p
        spans_zero, least, most = (start < 0) & (end > 0), np.minimum(*ends), np.maximum(*ends)
        least = np.where(even & (p > 0) & spans_zero, 0, np.where((p < 0) & ~(start >= 0), np.where(even, 0, -np.inf), least))
        most = np.where((p < 0) & ~(start >= 0), np.where(odd & negative, 0, np.inf), most)
        return Facts(convex, concave, rising, falling, least, most)

    return facts

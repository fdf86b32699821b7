"""How numbers are held: float64 for the duration of a call, and groups of unequal size as arrays of equal rows."""

from __future__ import annotations

import functools
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, ParamSpec, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat import forks

P = ParamSpec("P")
T = TypeVar("T")

PADDING_LIMIT = 4
"""Groups are padded to the largest while that costs at most this many times the elements; beyond, and where most groups are empty, they
are scattered."""
UNROLLED = 16
"""Groups of up to so many are folded element by element, which needs no room for all."""


def float64(function: Callable[P, T]) -> Callable[P, T]:
    """Run `function` with JAX in double precision, and leave the caller's own JAX settings as they were.

    It raises a `consat.ConsatError` in a process in which JAX cannot compute; see `consat.forks`.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        forks.refuse()
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return wrapped


def on_host(function: Callable[..., Any], shapes: Any, *arguments: Any) -> Any:
    """Call a pure function of NumPy arrays from a compiled program.

    JAX calls it in a thread of its own, which does not know that `float64` holds, and would round; numbers travel as pairs of uint32.

    Args:
        function: takes trees of float64 and boolean arrays, and returns one.
        shapes: `jax.ShapeDtypeStruct` of what it returns.
        arguments: of the function.
    """

    def packed(array: Any) -> Any:
        return array if array.dtype == bool else jax.lax.bitcast_convert_type(array, jnp.uint32)

    def called(*packs: Any) -> Any:
        values = jax.tree.map(lambda pack: np.asarray(pack) if pack.dtype == bool else np.asarray(pack).view(np.float64)[..., 0], packs)
        found = jax.tree.map(np.ascontiguousarray, function(*values))
        return jax.tree.map(lambda array: array if array.dtype == bool else array.view(np.uint32).reshape(*array.shape, 2), found)

    travelling = jax.tree.map(lambda each: each if each.dtype == bool else jax.ShapeDtypeStruct((*each.shape, 2), jnp.uint32), shapes)
    answer = jax.pure_callback(called, travelling, *jax.tree.map(packed, arguments))
    return jax.tree.map(lambda pack: pack if pack.dtype == bool else jax.lax.bitcast_convert_type(pack, jnp.float64), answer)


def once(rows: np.ndarray) -> np.ndarray:
    """(M, …) → (1, …) where all rows are known to be one row in memory, so that what is computed of a million equal rows is computed once;
    else as it is."""
    return rows[:1] if len(rows) > 1 and rows.strides[0] == 0 else rows


def stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays one after the other; where all rows are equal and each part holds one row in memory, so does the whole."""
    rows = [once(part) for part in parts]
    if all(len(row) == 1 for row in rows) and all(np.array_equal(rows[0], row) for row in rows[1:]):
        return np.broadcast_to(rows[0], (sum(map(len, parts)), *rows[0].shape[1:]))
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def quick_compilation() -> dict[str, bool | int] | None:
    """Options for programs that take longer to compile than to run: on a CPU they halve the former at no measurable cost to the latter."""
    return {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1} if jax.default_backend() == "cpu" else None


def thorough_compilation() -> dict[str, bool | int | str] | None:
    """Options for programs that run longer than they compile: on a CPU, so that what does not wait for one another is on all cores at once
    (by default memory is shared between such parts, which makes them wait), and so that short sums, over the axes of space, are fused with
    what is around them, not handed to a library."""
    if jax.default_backend() != "cpu":
        return None
    return {"xla_cpu_enable_concurrency_optimized_scheduler": True, "xla_cpu_experimental_ynn_fusion_type": ""}


FEW = 24
"""Up to so many terms are added one by one: compilers fuse that with what is around it, but not a sum over an axis."""


def add_up(terms: Array | Sequence[Array]) -> Array:
    """Σ over the first axis, in order while there are few."""
    return functools.reduce(operator.add, list(terms)) if 0 < len(terms) <= FEW else jnp.sum(jnp.asarray(terms), axis=0)


def pick(elements: Array, index: Array) -> Array:
    """``elements[index]``, for an index that is known to be in 0 … len − 1: nothing is spent on negative ones."""
    return elements.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def taken(elements: Array, index: Array, empty: float) -> Array:
    """The elements, along their first axis, at an index that is padded with their number; `empty` there."""
    last = len(elements) - 1
    there = (index <= last).reshape(*index.shape, *[1] * (elements.ndim - 1))
    return jnp.where(there, pick(elements, jnp.minimum(index, last)), empty)  # a copy with a filler behind it would cost as much again


def laid_out(values: Mapping[str, Array], members: Array) -> dict[str, Array]:
    """Parameters of a family, (M_f, …) each, as a batch holds them: (chunks, m, …, A) for members (chunks, m, A)."""
    return {key: jnp.moveaxis(pick(jnp.asarray(array), members), 2, -1) for key, array in values.items()}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Groups:
    """Elements that belong to groups: constraints to agents, gradients to rows, links to rows.

    Sums and maxima over the groups are a reshape where all groups are alike, else a gather through a padded index, else,
    for very uneven groups such as the hub of a star, a sorted scatter.

    Attributes:
        group: (E,) the group of each element.
        index: (width, G) the elements of each group, padded with E; or (E,) elements in the order of their groups; or None when
            the elements lie in order and all groups have the same size.
        count: G.
        width: size of the largest group.
        padded: whether `index` is the padded form.
    """

    group: Array
    index: Array | None
    count: int = field(metadata={"static": True})
    width: int = field(metadata={"static": True})
    padded: bool = field(metadata={"static": True})

    @classmethod
    def of(cls, group: np.ndarray, count: int) -> Groups:
        """Args: group: (E,) int, the group of each element; count: how many groups there are."""
        group = np.asarray(group, dtype=np.int32)
        device = jnp.asarray(group)
        sizes = np.bincount(group, minlength=count)
        width = int(sizes.max(initial=0))
        rising = bool(np.all(group[1:] >= group[:-1]))
        if rising and count * width == len(group):
            return cls(device, None, count, width, padded=True)
        order = (np.arange(len(group)) if rising else np.argsort(group, kind="stable")).astype(np.int32)
        if count * width > PADDING_LIMIT * max(len(group), count) or len(group) * PADDING_LIMIT < count:
            return cls(device, jnp.asarray(order), count, width, padded=False)
        index = np.full((width, count), len(group), dtype=np.int32)
        ranked = group if rising else group[order]
        index[np.arange(len(group)) - (np.cumsum(sizes) - sizes)[ranked], ranked] = order
        return cls(device, jnp.asarray(index), count, width, padded=True)

    def spread(self, values: Array) -> Array:
        """(G, …) → (E, …): to each element the value of its group."""
        if self.index is None:
            return values if self.width == 1 else jnp.repeat(values, self.width, axis=0, total_repeat_length=self.count * self.width)
        return pick(values, self.group)

    def sum(self, elements: Array) -> Array:
        """(E, …) → (G, …): the sum over each group, 0 for an empty one."""
        return self._folded(elements, _SUM)

    def max(self, elements: Array) -> Array:
        """(E, …) → (G, …): the maximum over each group, −∞ for an empty one."""
        return self._folded(elements, _MAX)

    def _folded(self, elements: Array, fold: _Fold) -> Array:
        if not self.padded:
            assert self.index is not None
            return fold.sorted(pick(elements, self.index), pick(self.group, self.index), self.count, indices_are_sorted=True)
        if self.width == 0 or self.count == 0:
            return jnp.full((self.count, *elements.shape[1:]), fold.empty, elements.dtype)
        if self.index is None:
            parts = jnp.moveaxis(elements.reshape(self.count, self.width, *elements.shape[1:]), 1, 0)
        elif self.width > UNROLLED:
            parts = taken(elements, self.index, fold.empty)
        else:
            return functools.reduce(fold.two, [taken(elements, index, fold.empty) for index in self.index])
        return functools.reduce(fold.two, list(parts)) if self.width <= UNROLLED else fold.axis(parts, axis=0)

    def logsumexp(self, elements: Array) -> tuple[Array, Array]:
        """(E,) → (G,) and (E,): log Σ exp over each group, −∞ for an empty one, and the softmax weights within the group. Where elements
        are +∞, so is the sum, and they share the weight."""
        if self.width <= 1 and self.padded:
            return self.max(elements), jnp.ones_like(elements)
        top = jax.lax.stop_gradient(self.max(elements))
        shift = jnp.where(jnp.isfinite(top), top, 0.0)
        powers = _powers(elements, self.spread(shift), self.spread(top))
        total = self.sum(powers)
        weights = powers / self.spread(jnp.where(total > 0.0, total, 1.0))
        log = jnp.where(total > 0.0, jnp.log(jnp.where(total > 0.0, total, 1.0)) + shift, -jnp.inf)
        return jnp.where(top == jnp.inf, jnp.inf, log), weights


def softmax(elements: Array) -> Array:
    """(E,) weights that sum to 1, as `jax.nn.softmax`; elements that are +∞ share them."""
    top = jnp.max(elements, initial=-jnp.inf)
    powers = _powers(elements, jnp.where(jnp.isfinite(top), top, 0.0), top)
    total = jnp.sum(powers)
    return powers / jnp.where(total > 0.0, total, 1.0)


def _powers(elements: Array, shift: Array, top: Array) -> Array:
    """e^(elements − shift); where the largest, `top`, is +∞, 1 for those that are it and 0 for the others."""
    unlimited = top == jnp.inf
    return jnp.where(unlimited, (elements == jnp.inf).astype(elements.dtype), jnp.exp(jnp.where(unlimited, 0.0, elements - shift)))


class _Fold(NamedTuple):
    """What two elements, an axis of them, and sorted groups of them fold to, and what none do."""

    two: Callable[[Any, Any], Any]
    axis: Callable[..., Array]
    sorted: Callable[..., Array]
    empty: float


_SUM = _Fold(operator.add, jnp.sum, jax.ops.segment_sum, 0.0)
_MAX = _Fold(jnp.maximum, jnp.max, jax.ops.segment_max, -jnp.inf)


class CompileClock:
    """Tells, within a `with` block, the seconds that JAX spent tracing and compiling from those spent running."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []
        self._begin = 0.0
        self.seconds: dict[str, float] = {"compile": 0.0, "run": 0.0}

    def __enter__(self) -> Self:
        self._begin = time.perf_counter()
        jax.monitoring.register_event_time_span_listener(self._hear)
        return self

    def _hear(self, event: str, start_time: float, end_time: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self._spans.append((start_time, end_time))

    def __exit__(self, *_: object) -> None:
        jax.monitoring.unregister_event_time_span_listener(self._hear)
        total = time.perf_counter() - self._begin
        compile_, reached = 0.0, -np.inf
        for start, end in sorted(self._spans):  # traces nest, so their spans overlap
            compile_ += max(0.0, end - max(start, reached))
            reached = max(reached, end)
        self.seconds.update(compile=compile_, run=max(total - compile_, 0.0))

"""Numerical helpers: double precision for the duration of a call, reductions over groups of unequal size, and timing of compilation."""

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
from jax.typing import ArrayLike

from consat import forks

P = ParamSpec("P")
T = TypeVar("T")

PADDING_LIMIT = 4
"""Groups are padded to the size of the largest if that needs at most this many times the elements. Otherwise, and if most groups are
empty, a scatter is used."""
UNROLLED = 16
"""Groups of up to this many elements are reduced element by element, which avoids a padded array of all elements."""


def float64(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: run `function` with JAX in double precision. The caller's JAX settings are restored afterwards.

    The function raises a `consat.ConsatError` in a process in which JAX cannot compute; see `consat.forks`.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        forks.refuse()
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return wrapped


def number(value: Any) -> float | None:
    """A float for JSON; None (null) where it is not finite."""
    return float(value) if np.isfinite(value) else None


def on_device(value: ArrayLike) -> Array:
    """The value as a JAX array with separate memory.

    `jnp.asarray` does the same, but compiles a program for each new shape of a numpy array: 20 to 30 ms each on a CPU, dozens at a start.
    """
    return jax.device_put(np.array(value) if isinstance(value, np.ndarray) else value)


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
    """(M, …) → (1, …) if all rows are the same memory (stride 0); else the array itself. Equal rows are then processed only once."""
    return rows[:1] if len(rows) > 1 and rows.strides[0] == 0 else rows


def stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenation along axis 0. If each part is one repeated row and these rows are equal, the result is a broadcast of that row."""
    rows = [once(part) for part in parts]
    if all(len(row) == 1 for row in rows) and all(np.array_equal(rows[0], row) for row in rows[1:]):
        return np.broadcast_to(rows[0], (sum(map(len, parts)), *rows[0].shape[1:]))
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def distinct(keys: np.ndarray) -> np.ndarray:
    """The distinct integers, sorted. For millions of keys several times as fast as `numpy.unique`.

    Args:
        keys: (K,) integers.
    """
    rising = np.all(keys[1:] >= keys[:-1])
    ordered = keys if rising else np.sort(keys)
    new = np.ones(len(ordered), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    return ordered if new.all() else ordered[new]


def quick_compilation() -> dict[str, bool | int] | None:
    """Compiler options for programs that compile longer than they run; None if the backend is not the CPU.

    They halve the compilation time without a measurable effect on the run time.
    """
    return {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1} if jax.default_backend() == "cpu" else None


def quickly_compiled(*static: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorator: compile a function with `quick_compilation`, at its first call, because importing it must not start a backend. The
    compiled function is ``function.program()``.

    Args:
        *static: names of arguments for each value of which the function is compiled anew.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        program = functools.cache(lambda: jax.jit(function, static_argnames=static, compiler_options=quick_compilation()))

        @functools.wraps(function)
        def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
            return program()(*args, **kwargs)

        wrapped.program = program  # type: ignore[attr-defined]
        return wrapped

    return decorate


def thorough_compilation() -> dict[str, bool | int | str] | None:
    """Compiler options for programs that run longer than they compile; None if the backend is not the CPU.

    The scheduler runs independent operations concurrently; by default they share memory and wait for each other. Short sums, such as those
    over the axes of space, are fused with the surrounding operations instead of being passed to a library.
    """
    if jax.default_backend() != "cpu":
        return None
    return {"xla_cpu_enable_concurrency_optimized_scheduler": True, "xla_cpu_experimental_ynn_fusion_type": ""}


FEW = 24
"""Up to this many terms are added one by one. Compilers fuse additions with the surrounding operations, but not a sum over an axis."""


def add_up(terms: Array | Sequence[Array]) -> Array:
    """The sum over axis 0; in order, one term after the other, if there are at most `FEW`."""
    return functools.reduce(operator.add, list(terms)) if 0 < len(terms) <= FEW else jnp.sum(jnp.asarray(terms), axis=0)


def pick(elements: Array, index: Array) -> Array:
    """``elements[index]`` without bounds checks. All indices must be in 0 … len − 1."""
    return elements.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def taken(elements: Array, index: Array, empty: float) -> Array:
    """``elements[index]`` along axis 0. Where the index is ``len(elements)``, which marks padding, the result is `empty`."""
    last = len(elements) - 1
    there = (index <= last).reshape(*index.shape, *[1] * (elements.ndim - 1))
    return jnp.where(there, pick(elements, jnp.minimum(index, last)), empty)  # appending a filler element would copy all elements


def laid_out(values: Mapping[str, Array], members: Array) -> dict[str, Array]:
    """Parameters of a family in the layout of a batch.

    Args:
        values: parameters, each (M_f, …).
        members: (…, A) indices of the constraints.

    Returns:
        parameters, each (…, A), with the axes of the parameter before A.
    """
    return {key: jnp.moveaxis(pick(jnp.asarray(array), members), members.ndim - 1, -1) for key, array in values.items()}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Groups:
    """Assignment of elements to groups (constraints to agents, gradients to rows, links to rows), with reductions over the groups.

    The reductions use a reshape if all groups have the same size and the elements are in order. Otherwise they gather through a padded
    index. For very uneven groups, such as the hub of a star, they use a sorted scatter.

    Attributes:
        group: (E,) group of each element.
        index: (width, G) elements of each group, padded with E; or (E,) elements sorted by group, if `padded` is false; or None if the
            elements are in order and all groups have the same size.
        count: G, the number of groups.
        width: size of the largest group.
        padded: false if `index` holds the elements sorted by group.
    """

    group: Array
    index: Array | None
    count: int = field(metadata={"static": True})
    width: int = field(metadata={"static": True})
    padded: bool = field(metadata={"static": True})

    @classmethod
    def of(cls, group: np.ndarray, count: int) -> Groups:
        """Choose the representation.

        Args:
            group: (E,) int, group of each element.
            count: G, the number of groups.
        """
        group = np.asarray(group, dtype=np.int32)
        device = on_device(group)
        sizes = np.bincount(group, minlength=count)
        width = int(sizes.max(initial=0))
        rising = bool(np.all(group[1:] >= group[:-1]))
        if rising and count * width == len(group):
            return cls(device, None, count, width, padded=True)
        order = (np.arange(len(group)) if rising else np.argsort(group, kind="stable")).astype(np.int32)
        if count * width > PADDING_LIMIT * max(len(group), count) or len(group) * PADDING_LIMIT < count:
            return cls(device, on_device(order), count, width, padded=False)
        index = np.full((width, count), len(group), dtype=np.int32)
        ranked = group if rising else group[order]
        index[np.arange(len(group)) - (np.cumsum(sizes) - sizes)[ranked], ranked] = order
        return cls(device, on_device(index), count, width, padded=True)

    def spread(self, values: Array) -> Array:
        """(G, …) → (E, …): for each element the value of its group."""
        if self.index is None:
            return values if self.width == 1 else jnp.repeat(values, self.width, axis=0, total_repeat_length=self.count * self.width)
        return pick(values, self.group)

    def sum(self, elements: Array) -> Array:
        """(E, …) → (G, …): sum over each group; 0 for an empty group."""
        return self._folded(elements, _SUM)

    def max(self, elements: Array) -> Array:
        """(E, …) → (G, …): maximum over each group; −∞ for an empty group."""
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
        """(E,) → (G,) log Σ exp over each group, −∞ for an empty group; and (E,) softmax weights within each group.

        If elements of a group are +∞, so is its sum, and they share the weight equally.
        """
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
    """(E,) weights that sum to 1, as `jax.nn.softmax`. Elements that are +∞ share the weight equally."""
    top = jnp.max(elements, initial=-jnp.inf)
    powers = _powers(elements, jnp.where(jnp.isfinite(top), top, 0.0), top)
    total = jnp.sum(powers)
    return powers / jnp.where(total > 0.0, total, 1.0)


def _powers(elements: Array, shift: Array, top: Array) -> Array:
    """e^(elements − shift). If the largest element, `top`, is +∞: 1 for infinite elements and 0 for the others."""
    unlimited = top == jnp.inf
    return jnp.where(unlimited, (elements == jnp.inf).astype(elements.dtype), jnp.exp(jnp.where(unlimited, 0.0, elements - shift)))


class _Fold(NamedTuple):
    """One reduction in several forms.

    Attributes:
        two: reduces two arrays element by element.
        axis: reduces along an axis.
        sorted: reduces segments of elements that are sorted by group.
        empty: result for an empty group.
    """

    two: Callable[[Any, Any], Any]
    axis: Callable[..., Array]
    sorted: Callable[..., Array]
    empty: float


_SUM = _Fold(operator.add, jnp.sum, jax.ops.segment_sum, 0.0)
_MAX = _Fold(jnp.maximum, jnp.max, jax.ops.segment_max, -jnp.inf)


class CompileClock:
    """Context manager that measures the time of its block, s, and separates JAX tracing and compilation from the rest.

    Attributes:
        seconds: ``compile`` and ``run``, set when the block ends.
    """

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
        for start, end in sorted(self._spans):  # traces may be nested, so their spans overlap
            compile_ += max(0.0, end - max(start, reached))
            reached = max(reached, end)
        self.seconds.update(compile=compile_, run=max(total - compile_, 0.0))

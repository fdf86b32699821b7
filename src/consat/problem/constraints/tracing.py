"""Abstract interpretation of traces: `interpret` evaluates a jaxpr on any kind of value, `describe` applies one primitive to `Node`s.

A primitive without a rule yields an unknown function, never a guess.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from consat.problem.constraints.atoms import ATOMS
from consat.problem.constraints.composition import arranged, atom, dot, fold, larger, minus, negative, plus, power, raised, smaller, times
from consat.problem.constraints.node import Node, constant, unknown

if TYPE_CHECKING:  # the import loads Pallas, too
    from jax.extend import core

Array = NDArray[Any]
T = TypeVar("T")

CALLS: Final = frozenset({"jit", "pjit", "closed_call", "core_call", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call"})
"""Primitives that call an inner jaxpr and return its value."""


def interpret(
    jaxpr: core.Jaxpr,
    constants: Sequence[Any],
    arguments: Sequence[T],
    constant: Callable[[Any], T],
    step: Callable[[core.JaxprEqn, Sequence[T]], Sequence[T] | None],
) -> list[T]:
    """Evaluate a jaxpr on values of any kind.

    Args:
        jaxpr: the jaxpr.
        constants: the arrays that it refers to.
        arguments: values of its inputs.
        constant: converts a number or array to such a value.
        step: evaluates one equation. It may return None for one of `CALLS`; then the inner jaxpr is evaluated.

    Returns:
        the values of its outputs.
    """
    env: dict[Any, T] = dict(zip(jaxpr.invars, arguments, strict=True))
    env.update(zip(jaxpr.constvars, map(constant, constants), strict=True))

    def read(atom: Any) -> T:
        literal = hasattr(atom, "val")
        return constant(np.asarray(atom.val, getattr(atom.aval, "dtype", None))) if literal else env[atom]

    for eqn in jaxpr.eqns:
        inputs = [read(atom) for atom in eqn.invars]
        outputs = step(eqn, inputs)
        env.update(zip(eqn.outvars, interpret(*body(eqn), inputs, constant, step) if outputs is None else outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def body(eqn: core.JaxprEqn) -> tuple[core.Jaxpr, Sequence[Any]]:
    """The inner jaxpr, and its constants, of an equation whose primitive is one of `CALLS`."""
    inner = next(eqn.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in eqn.params)
    return getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())


def evaluate(eqn: core.JaxprEqn, *inputs: Any) -> list[Any]:
    """Evaluates one equation on arrays. Its primitive must not be one of `CALLS`."""
    out = eqn.primitive.bind(*inputs, **eqn.params)
    return list(out) if eqn.primitive.multiple_results else [out]


Rule = Callable[..., Node]

RULES: Final[Mapping[str, Rule]] = {
    "add": lambda a, b, **_: plus(a, b),
    "add_any": lambda a, b, **_: plus(a, b),
    "sub": lambda a, b, **_: minus(a, b),
    "neg": lambda a, **_: negative(a),
    "mul": lambda a, b, **_: times(a, b),
    "div": lambda a, b, **_: times(a, power(b, np.array(-1.0))),
    "max": lambda a, b, **_: larger(a, b),
    "min": lambda a, b, **_: smaller(a, b),
    "clamp": lambda low, a, high, **_: smaller(larger(a, low), high),
    "square": lambda a, **_: power(a, np.array(2.0)),
    "integer_pow": lambda a, *, y, **_: power(a, np.array(float(y))),
    "rsqrt": lambda a, **_: power(a, np.array(-0.5)),
    "pow": lambda a, b, **_: raised(a, b),
    "reduce_sum": lambda a, *, axes, **_: fold(plus, a, axes),
    "reduce_prod": lambda a, *, axes, **_: fold(times, a, axes),
    "reduce_max": lambda a, *, axes, **_: fold(larger, a, axes),
    "reduce_min": lambda a, *, axes, **_: fold(smaller, a, axes),
    "dot_general": lambda a, b, *, dimension_numbers, **_: dot(a, b, dimension_numbers),
    "logaddexp": lambda a, b: atom("log", plus(atom("exp", a), atom("exp", b))),
    **{name: (lambda a, name=name, **_: atom(name, a)) for name in ATOMS},
}
"""Rules for primitives: from the nodes of the operands to the node of the result."""

MOVERS: Final[Mapping[str, Callable[..., Any] | None]] = {
    "copy": lambda _into, a, **_: a,
    "convert_element_type": lambda _into, a, **_: a,
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), lambda into, a, **_: a.reshape(into)),
    "broadcast_in_dim": lambda into, a, *, broadcast_dimensions, **_: np.broadcast_to(
        a.reshape([dict(zip(broadcast_dimensions, a.shape, strict=True)).get(axis, 1) for axis in range(len(into))]), into
    ),
    "transpose": lambda _into, a, *, permutation, **_: a.transpose(permutation),
    "rev": lambda _into, a, *, dimensions, **_: np.flip(a, dimensions),
    "slice": lambda _into, a, *, start_indices, limit_indices, strides, **_: a[
        tuple(map(slice, start_indices, limit_indices, strides or (1,) * a.ndim))
    ],
    "split": lambda _into, a, *, sizes, axis, **_: np.split(a, np.cumsum(sizes)[:-1], axis),
    "concatenate": lambda _into, *parts, dimension, **_: np.concatenate(parts, dimension),
    "stack": lambda _into, *parts, axis, **_: np.stack(parts, axis),
    "select_n": lambda _into, which, *cases, **_: np.choose(which.astype(int), cases),
    **dict.fromkeys(("pad", "gather", "dynamic_slice", "dynamic_update_slice", "scatter"), None),
}
"""Primitives that only rearrange entries, as functions on arrays of entry numbers. None: JAX evaluates the primitive itself."""

SELECTORS: Final[Mapping[str, slice]] = {
    "select_n": slice(0, 1),
    "gather": slice(1, 2),
    "dynamic_slice": slice(1, None),
    "dynamic_update_slice": slice(2, None),
    "scatter": slice(1, 2),
}
"""Operands of `MOVERS` that are indices. Their values must be known and equal for all members."""


def _avals(variables: Sequence[Any]) -> list[Any]:
    """Shapes and types of variables of a jaxpr."""
    return [variable.aval for variable in variables]


def describe(eqn: core.JaxprEqn, inputs: Sequence[Node]) -> Sequence[Node] | None:
    """The nodes of the outputs of an equation, given those of its inputs. The `step` of `interpret` for nodes."""
    name, outputs = eqn.primitive.name, _avals(eqn.outvars)
    if name in CALLS:
        return [RULES["logaddexp"](*inputs)] if _is_logaddexp(eqn) else None
    if all(math.prod(each.shape) for each in (*inputs, *outputs)):
        if name in RULES and np.issubdtype(outputs[0].dtype, np.floating):
            node = RULES[name](*inputs, **eqn.params)
            return [
                node if node.shape == outputs[0].shape else arranged([node], np.arange(math.prod(node.shape)).reshape(outputs[0].shape))
            ]
        moved = _moved(eqn, inputs) if name in MOVERS else None
        if moved is not None:
            return moved
    values = [node.value for node in inputs if node.value is not None]
    if len(values) == len(inputs):
        return [constant(value) for value in _evaluated(eqn, values)]
    return [unknown(each.shape, 0 if all(node.degree == 0 for node in inputs) else None) for each in outputs]


def _is_logaddexp(eqn: core.JaxprEqn) -> bool:
    """Whether a call is `jax.numpy.logaddexp`: its inner jaxpr is compared, not its name."""
    if eqn.primitive.name != "custom_jvp_call" or len(eqn.invars) != 2:
        return False
    operands = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in _avals(eqn.invars)]
    (reference,) = jax.make_jaxpr(jnp.logaddexp)(*operands).eqns
    return str(body(reference)[0]) == str(body(eqn)[0])


def _moved(eqn: core.JaxprEqn, inputs: Sequence[Node]) -> list[Node] | None:
    """The nodes of the outputs of a primitive that rearranges entries; None if it cannot be determined.

    The primitive is applied to the numbers of the entries, which shows where each entry goes.
    """
    name, outputs = eqn.primitive.name, _avals(eqn.outvars)
    if not np.issubdtype(outputs[0].dtype, np.floating):
        return None
    selectors = range(len(inputs))[SELECTORS.get(name, slice(0))]
    entries = [node for k, node in enumerate(inputs) if k not in selectors]
    numbers = iter(
        np.split(np.arange(total := sum(math.prod(node.shape) for node in entries)), np.cumsum([math.prod(n.shape) for n in entries]))
    )
    operands = []
    for k, (node, aval) in enumerate(zip(inputs, _avals(eqn.invars), strict=True)):
        if k not in selectors:
            operands.append(next(numbers).reshape(node.shape))
        elif node.value is not None and len(node.value) == 1:
            operands.append(np.broadcast_to(node.value[0], node.shape).astype(aval.dtype))
        else:
            return None
    act = MOVERS[name]
    moved = evaluate(eqn, *operands) if act is None else act(outputs[0].shape, *operands, **eqn.params)
    indices = [np.asarray(index) for index in (moved if isinstance(moved, list) else [moved])]
    inside = all(np.all((index >= 0) & (index < total)) for index in indices)  # a gather with indices out of bounds inserts fill values
    return [arranged(entries, index) for index in indices] if inside else None


def _evaluated(eqn: core.JaxprEqn, values: Sequence[Array]) -> list[Array]:
    """The outputs of a primitive applied to known constants, whose first axis runs over the members."""
    typed = [np.broadcast_to(v, (len(v), *aval.shape)).astype(aval.dtype) for v, aval in zip(values, _avals(eqn.invars), strict=True)]
    if all(len(value) == 1 for value in typed):
        return [np.asarray(out)[None] for out in evaluate(eqn, *(value[0] for value in typed))]
    shared = [None if len(value) == 1 else 0 for value in typed]
    return list(map(np.asarray, jax.vmap(partial(evaluate, eqn), shared)(*(value[0] if len(value) == 1 else value for value in typed))))

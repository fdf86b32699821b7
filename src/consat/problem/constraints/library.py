"""The library kinds of constraints. Each kind is a pure function ψ and a factory with its parameters; `KINDS` lists the factories.

To add a kind, write these two functions and add the factory to `KINDS`. Scenario files can then use it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeAlias

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from consat.problem.constraints.expression import Expression, Formula
from consat.problem.constraints.record import OWNER, Constraint, Fixed, Number, Parameter, Vector
from consat.problem.schedule import CLOCK, Schedule

Other: TypeAlias = "str | int | Sequence[int] | Mapping[str, int] | np.ndarray"
"""The agent that a constraint reads besides its owner: an id, or in a group a relation; see `consat.problem.groups`."""


def _within(x: Array, *, center: Array, radius: Array) -> Array:
    return radius**2 - jnp.sum((x - center) ** 2)


def within(center: ArrayLike, radius: float, *, name: str | None = None, weight: float = 1.0) -> Constraint:
    """Stay in a ball: ψ = r² − ‖x_i − c‖² (paper, case A). Strictly concave.

    Args:
        center: c, shape (d,), length.
        radius: r > 0, length.
        name: what reports call it.
        weight: positive factor on ψ.
    """
    return Constraint("within", _within, (OWNER,), {"center": Vector(center), "radius": Number(radius, positive=True)}, name, weight)


def _outside(x: Array, *, center: Array, radius: Array) -> Array:
    return jnp.sum((x - center) ** 2) - radius**2


def outside(center: ArrayLike, radius: float, *, name: str | None = None, weight: float = 1.0) -> Constraint:
    """Stay out of a ball: ψ = ‖x_i − c‖² − r². Not concave.

    Args:
        center: c, shape (d,), length.
        radius: r > 0, length.
        name: what reports call it.
        weight: positive factor on ψ.
    """
    return Constraint("outside", _outside, (OWNER,), {"center": Vector(center), "radius": Number(radius, positive=True)}, name, weight)


def _near(x: Array, y: Array, *, radius: Array) -> Array:
    return radius**2 - jnp.sum((x - y) ** 2)


def near(agent: Other, radius: float, *, name: str | None = None, weight: float = 1.0) -> Constraint:
    """Stay near a teammate: ψ = r² − ‖x_i − x_j‖² (paper, case A). Concave.

    Args:
        agent: id of j; in a group also a relation, see `consat.problem.groups`.
        radius: r > 0, length.
        name: what reports call it.
        weight: positive factor on ψ.
    """
    return Constraint("near", _near, (OWNER, agent), {"radius": Number(radius, positive=True)}, name, weight)


def _apart(x: Array, y: Array, *, radius: Array) -> Array:
    return jnp.sum((x - y) ** 2) - radius**2


def apart(agent: Other, radius: float, *, name: str | None = None, weight: float = 1.0) -> Constraint:
    """Keep a distance from a teammate: ψ = ‖x_i − x_j‖² − r² (paper, case E). Not concave.

    Args:
        agent: id of j; in a group also a relation, see `consat.problem.groups`.
        radius: r > 0, length.
        name: what reports call it.
        weight: positive factor on ψ.
    """
    return Constraint("apart", _apart, (OWNER, agent), {"radius": Number(radius, positive=True)}, name, weight)


def _displacement(x: Array, y: Array, *, vector: Array, radius: Array) -> Array:
    return radius**2 - jnp.sum((x - y - vector) ** 2)


def displacement(agent: Other, vector: ArrayLike, radius: float, *, name: str | None = None, weight: float = 1.0) -> Constraint:
    """Hold a position relative to a teammate: ψ = r² − ‖x_i − x_j − v‖². Concave.

    Args:
        agent: id of j; in a group also a relation, see `consat.problem.groups`.
        vector: v, shape (d,), length: desired position of i relative to j.
        radius: r > 0, length.
        name: what reports call it.
        weight: positive factor on ψ.
    """
    parameters: dict[str, Parameter] = {"vector": Vector(vector), "radius": Number(radius, positive=True)}
    return Constraint("displacement", _displacement, (OWNER, agent), parameters, name, weight)


def _halfspace(x: Array, *, normal: Array, offset: Array) -> Array:
    return offset - jnp.dot(normal, x)


def halfspace(normal: ArrayLike, offset: float, *, name: str | None = None, weight: float = 1.0) -> Constraint:
    """Stay on one side of a wall: ψ = b − n·x_i. Affine.

    Args:
        normal: n ≠ 0, shape (d,); points to the forbidden side.
        offset: b, in the units of n·x.
        name: what reports call it.
        weight: positive factor on ψ.
    """
    return Constraint("halfspace", _halfspace, (OWNER,), {"normal": Vector(normal, nonzero=True), "offset": Number(offset)}, name, weight)


def _above(x: Array, *, low: Array, axis: Array) -> Array:
    return jnp.dot(axis, x - low)


def _below(x: Array, *, high: Array, axis: Array) -> Array:
    return jnp.dot(axis, high - x)


def box(low: ArrayLike, high: ArrayLike, *, name: str | None = None, weight: float = 1.0) -> list[Constraint]:
    """Stay in an axis-aligned box: on each axis k, ψ = x_ik − low_k and ψ = high_k − x_ik. Affine, 2d constraints.

    Args:
        low: shape (d,), length.
        high: shape (d,), length, above `low` on every axis.
        name: what reports call it; each side gets a suffix such as ``.low[0]``.
        weight: positive factor on every ψ.
    """
    label = "box" if name is None else name
    first = low.values if isinstance(low, Schedule) else low.get("values") if isinstance(low, Mapping) else [low]
    side = first[0] if isinstance(first, list | tuple | np.ndarray) and len(first) else low
    size = len(side) if isinstance(side, list | tuple) else np.size(side)
    axes = np.eye(min(max(size, 1), 64))  # the team reports a size that is not its dimension
    lows = [
        Constraint("box", _above, (OWNER,), {"low": Vector(low), "axis": Fixed(axis)}, f"{label}.low[{k}]", weight)
        for k, axis in enumerate(axes)
    ]
    highs = [
        Constraint("box", _below, (OWNER,), {"high": Vector(high, above=low), "axis": Fixed(axis)}, f"{label}.high[{k}]", weight)
        for k, axis in enumerate(axes)
    ]
    return lows + highs


def expr(psi: str, *, name: str | None = None, weight: float = 1.0) -> Constraint:
    """A constraint with ψ given as text, e.g. ``"2**2 - norm2(a2 - a3)"``. The text names the agents that ψ reads.

    Args:
        psi: the expression; see `consat.problem.constraints.expression` for the language. It must read the position of its owner.
        name: what reports call it.
        weight: positive factor on ψ.

    Raises:
        InvalidExpression: the text is not in the language. The message says where, and what would be right.
    """
    parsed = Expression.parse(psi)
    parameters: dict[str, Parameter] = {"numbers": Fixed(parsed.numbers)}
    if parsed.moves:
        parameters["t"] = Fixed(CLOCK)
    return Constraint("expr", parsed.function, parsed.reads, parameters, name, weight, psi)


def constraint(
    psi: Callable[..., Any], reads: Sequence[str], *, name: str | None = None, weight: float = 1.0, **parameters: ArrayLike
) -> Constraint:
    """A constraint with ψ given as a Python function of positions. JAX traces and differentiates it.

    Args:
        psi: ``psi(*positions, **parameters) -> scalar``, written with `jax.numpy`; each position is a (d,) array.
            Constraints that share one function are evaluated together, so define it once and vary `parameters`.
        reads: ids of the agents whose positions `psi` takes, in order; the owner must be among them.
        name: what reports call it.
        weight: positive factor on ψ.
        parameters: keyword arguments of `psi`: arrays, or schedules of arrays. If `psi` has an argument ``t`` that is not given here, it
            receives the time, s.
    """
    kind = getattr(psi, "__name__", "constraint").strip("<>")
    given: dict[str, Any] = {"t": CLOCK} if "t" not in parameters and _reads_time(psi, len(reads)) else {}
    return Constraint(kind, psi, tuple(reads), {key: Fixed(value) for key, value in (parameters | given).items()}, name, weight)


def _reads_time(psi: Callable[..., Any], positions: int) -> bool:
    """Whether a function has an argument named ``t`` after its `positions` positional arguments, or by keyword only."""
    try:
        arguments = list(inspect.signature(psi).parameters.values())
    except (TypeError, ValueError):
        return False
    return any(each.name == "t" and (k >= positions or each.kind is each.KEYWORD_ONLY) for k, each in enumerate(arguments))


_POINT, _LENGTH = Vector(None), Number(None, positive=True)
ADJUSTABLE: Final[Mapping[Callable[..., Any], Mapping[str, Parameter]]] = {
    _within: {"center": _POINT, "radius": _LENGTH},
    _outside: {"center": _POINT, "radius": _LENGTH},
    _near: {"radius": _LENGTH},
    _apart: {"radius": _LENGTH},
    _displacement: {"vector": _POINT, "radius": _LENGTH},
    _halfspace: {"normal": Vector(None, nonzero=True), "offset": Number(None)},
    _above: {"low": _POINT},
    _below: {"high": _POINT},
}
"""Parameters of each library function that can be changed while a team runs, and what their values must satisfy. None of them changes the
curvature."""


def farthest(psi: Callable[..., Any], parameters: Mapping[str, np.ndarray], center: np.ndarray) -> float:
    """The largest distance from `center` that any constraint of a family requires of a position, length.

    For `displacement`, the largest distance that it requires between two agents. 0 if nothing is required, or for functions that are not
    listed here.

    Args:
        psi: the function of the family.
        parameters: arrays with leading axis M.
        center: (d,) reference position, length.
    """
    p = {key: np.asarray(value, dtype=float) for key, value in parameters.items()}
    if psi is _within:
        away = np.linalg.norm(p["center"] - center, axis=1) - p["radius"]
    elif psi is _displacement:
        away = np.linalg.norm(p["vector"], axis=1) - p["radius"]
    elif psi is _halfspace:
        away = (p["normal"] @ center - p["offset"]) / np.linalg.norm(p["normal"], axis=1)
    elif psi is _above:
        away = np.sum(p["axis"] * (p["low"] - center), axis=1)
    elif psi is _below:
        away = np.sum(p["axis"] * (center - p["high"]), axis=1)
    else:
        return 0.0
    return float(away.max(initial=0.0))


def adjustable(kind: str, psi: Callable[..., Any], parameters: Mapping[str, Any]) -> Mapping[str, Parameter]:
    """The parameters of a constraint that can be changed while a team runs, and what their values must satisfy.

    None for a text expression, because its numbers have no names. Other kinds are asked through their factory in `KINDS`.

    Args:
        kind: kind of the constraint.
        psi: its function.
        parameters: of a family of such constraints, with leading axis M ≥ 1.
    """
    if isinstance(psi, Formula):
        return {}
    if psi in ADJUSTABLE:
        return ADJUSTABLE[psi]
    free = {key: np.asarray(value)[0] for key, value in parameters.items() if key != "t"}
    if kind in KINDS:
        arguments = inspect.signature(KINDS[kind]).parameters
        if free.keys() <= arguments.keys():
            reads = {key: kind for key, each in arguments.items() if each.default is each.empty and key not in free}
            made = KINDS[kind](**free, **reads)
            if isinstance(made, Constraint) and made.psi is psi:
                return {key: made.parameters[key] for key in free}
    return {key: Fixed(None) for key in free}


KINDS: Final[Mapping[str, Callable[..., Constraint | list[Constraint]]]] = {
    factory.__name__: factory for factory in (within, outside, near, apart, displacement, halfspace, box, expr)
}
"""Factories by the name that ``kind:`` uses in a scenario file. The other keys of a constraint there are the arguments of its factory."""

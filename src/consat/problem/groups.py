"""Groups: many similar agents, whose constraints name other agents by relation rather than by id.

A member has an index in the group, from 0; its id is the name of the group followed by index + 1. The argument ``agent`` of a constraint
may be

* a text: the agent with this id, the same for all members;
* an integer: an offset of the index, such as ``-1`` for the member ahead; in a ring the offset wraps around;
* a list of integers, one per axis: an offset along each axis of a grid;
* ``{"nearest": k}``: the k members with the nearest places, with one constraint for each;
* an array of integers: the indices of the members to read, one for each constraint.

A member for which the relation points to nobody gets no constraint: the first member has nobody ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from consat.errors import Fault, closest, shown
from consat.problem.constraints.record import Constraint
from consat.problem.parameters import LARGEST, Path, is_number, is_printable, is_whole

Ints = NDArray[np.int64]

SHAPES = ("line", "ring", "grid", "random")
"""Arrangements of the places of a group; see `Group`."""
OTHER = "other"
"""In a text expression of a group: the agent that the argument ``agent`` selects."""
SELF = "self"
"""In a text expression of a group: the member that owns the constraint."""
PLACE = "place"
"""As a centre: the place of the member. As a displacement: the place of the member minus that of the other agent."""
ACROSS = "across"
"""As a centre: the place of the member, mirrored at the middle of the group."""
MOST = 2**27
"""Largest number of members: estimates and links are indexed by int32."""


@dataclass(frozen=True, eq=False)
class Each:
    """A constraint and the members of the group that own it; see `each`."""

    constraint: Any
    of: Any = None
    agent: Any = None


def each(constraint: Any, *, of: Any = None, agent: Any = None) -> Each:
    """A constraint for some members of a group.

    Args:
        constraint: what `consat.within` and the other factories return. A parameter may be an array with one value for each member that
            owns the constraint. A centre may also be ``"place"`` or ``"across"``, and a displacement ``"place"``.
        of: the members that own it: ``"first"``, ``"last"``, an id, a list of ids, ``{"every": k}`` (each k-th member; on a grid along each
            axis), or an array of indices in the group. If None, all members.
        agent: for a text expression, the agent that ``other`` stands for; see `consat.problem.groups`. ``self`` is the owner.
    """
    return Each(constraint, of, agent)


@dataclass(frozen=True, eq=False)
class Group:
    """Many similar agents, with ids name1, name2, …

    Attributes:
        name: prefix of the ids.
        count: number of members.
        constraints: constraints of every member; use `each` for those of some members.
        shape: arrangement of the places around the origin: ``line``, ``ring``, ``grid`` (square), or ``random`` (one place per volume
            spacing^d).
        spacing: distance between neighbouring places, length.
        scatter: largest distance on each axis between the start of a member and its place, length. If None, starts do not depend on places.
        start: (count, d) given start positions, length, which override `scatter`.
        seed: seed of the ``random`` places.
    """

    name: str
    count: int
    constraints: Sequence[Constraint | Each | Sequence[Constraint]] = ()
    shape: str = "line"
    spacing: float = 1.0
    scatter: float | None = None
    start: ArrayLike | None = None
    seed: int = 0


class Layout(NamedTuple):
    """The places of a group.

    Attributes:
        places: (N, d) positions, length.
        steps: (N, d) integer grid coordinates of each member; (N, 1) its index if the shape is no grid.
        sides: number of grid coordinates on each axis.
        ring: whether offsets wrap around from the last member to the first.
    """

    places: NDArray[np.floating]
    steps: Ints
    sides: tuple[int, ...]
    ring: bool


def layout(group: Group, dimension: int) -> Layout:
    """The places of the members. The group must have no faults; see `faults_of`."""
    count, along = group.count, np.arange(group.count)
    places = np.zeros((count, dimension))
    if group.shape == "grid":
        side = next(n for n in range(max(round(count ** (1 / dimension)) - 1, 1), count + 1) if n**dimension >= count)
        steps = np.stack(np.unravel_index(along, (side,) * dimension), axis=1)
        return Layout(group.spacing * (steps - 0.5 * (side - 1)), steps, (side,) * dimension, ring=False)
    if group.shape == "random":
        side = group.spacing * count ** (1 / dimension)
        places = side * (np.random.default_rng(group.seed).random((count, dimension)) - 0.5)
        places = places[np.argsort(_along_a_curve(places), kind="stable")]
    elif group.shape == "ring" and dimension > 1:
        angle = 2 * np.pi * along / count
        places[:, :2] = np.stack([np.cos(angle), np.sin(angle)], axis=1) * group.spacing / max(2 * np.sin(np.pi / max(count, 2)), 1e-9)
    else:
        places[:, 0] = group.spacing * (along - 0.5 * (count - 1))
    return Layout(places, along[:, None], (count,), group.shape == "ring")


def _along_a_curve(places: NDArray[np.float64]) -> Ints:
    """(N,) Morton codes of the places. Sorting by them makes neighbours in space neighbours in memory."""
    dimension = places.shape[1]
    bits = min(20, 62 // dimension)
    low, high = places.min(axis=0), places.max(axis=0)
    cells = ((places - low) / np.maximum(high - low, 1e-300) * (2**bits - 1)).astype(np.int64)
    code = np.zeros(len(places), dtype=np.int64)
    for bit in range(bits):
        for axis in range(dimension):
            code |= ((cells[:, axis] >> bit) & 1) << (bit * dimension + axis)
    return code


def faults_of(group: Group, path: Path, dimension: int) -> list[Fault]:
    """The faults of a group, except those of its constraints."""
    where = label(group)
    wrong: list[tuple[str, str]] = []
    if not is_printable(group.name):
        wrong.append(("group", f"group is {shown(group.name)}, but must be a printable text such as a, which gives a1, a2, …"))
    if not is_whole(group.count, 1, MOST):
        wrong.append(("count", f"count is {shown(group.count)}, but must be a whole number from 1 to {MOST}"))
    if group.shape not in SHAPES:
        wrong.append(("shape", f"there is no shape {shown(group.shape)}; the shapes are {', '.join(SHAPES)}{closest(group.shape, SHAPES)}"))
    distances: list[tuple[str, Any, float]] = [("spacing", group.spacing, 1 / LARGEST), ("scatter", group.scatter, 0.0)]
    for key, value, low in distances:
        if (value is not None or key == "spacing") and not (is_number(value) and low <= value <= LARGEST):
            wrong.append((key, f"{key} is {shown(value)}, but must be a {'positive ' if low else ''}number{'' if low else ' ≥ 0'}"))
    if not is_whole(group.seed, 0, 2**63 - 1):
        wrong.append(("seed", f"seed is {shown(group.seed)}, but must be a whole number from 0 to 2^63 - 1"))
    if group.start is not None and not any(key == "count" for key, _ in wrong):
        start = np.asarray(group.start)
        if start.shape != (group.count, dimension) or start.dtype.kind not in "iuf" or not (np.abs(start) <= LARGEST).all():
            wrong.append(("start", f"start must be finite numbers of shape {(group.count, dimension)}, a row for each member"))
    return [Fault((*path, key), message, where) for key, message in wrong]


def label(group: Group) -> str:
    """What messages call the group."""
    return f"group {group.name!r}"

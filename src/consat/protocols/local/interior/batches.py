"""Agents of the interior-point protocol in batches of similar size. The last axis of every array is the agent (the lane), size A."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import laid_out, on_device
from consat.problem.constraints.curvature import read_curvatures
from consat.problem.family import Family
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.protocols.local.interior.routes import Shared
from consat.protocols.local.lanewise import bend_of

Vectors = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Form:
    """Static properties of the constraints of one family.

    Attributes:
        psi: the function ψ.
        curvature: (R, arity·d) vectors v with Σ v vᵀ = the convex part of −∇²ψ for weight 1; None where it varies with the position.
        concave: whether ψ is proven concave.
        quadratic: whether it is a polynomial of degree ≤ 2.
        moves: whether any of its parameters moves with time.
    """

    psi: Callable[..., Any]
    curvature: Vectors | None
    concave: bool
    quadratic: bool
    moves: bool


class Kind(NamedTuple):
    """The constraints of one family in a batch, m for each agent with padding.

    Attributes:
        slots: (m, arity, A) which of the agent's copies each constraint reads.
        parameters: name to (m, …, A).
        weight: (m, A).
        used: (m, A) false where padded.
    """

    slots: Array
    parameters: dict[str, Array]
    weight: Array
    used: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Agents of similar size: up to n copies, m constraints, g neighbours and p variables shared with a neighbour.

    Attributes:
        agents: (A,) indices of the agents.
        rows: (n, A) rows of their copies, their own first; padded with the number of rows.
        members: (m, A) indices of their constraints among the multipliers; padded with the number of multipliers.
        pairs: (g, A) indices of their ends of links; padded with the number of ends.
        shared: (g, p, A) indices of the variables shared with each neighbour; the level is number n·d; padded with n·d + 1.
        kinds: their constraints, one entry per family.
        forms: static properties of these families.
        families: for each kind the index of its family in the team, and of its first multiplier.
    """

    agents: Array
    rows: Array
    members: Array
    pairs: Array
    shared: Array
    kinds: tuple[Kind, ...]
    forms: tuple[Form, ...] = field(metadata={"static": True})
    families: tuple[tuple[int, int], ...] = field(metadata={"static": True})

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Batch:
        """Copy with new constraint parameters. `values`: for each family the parameters to replace, (M_f, …)."""
        kinds, start = [], 0
        for kind, (family, offset) in zip(self.kinds, self.families, strict=True):
            m = len(kind.used)
            own, members = values[family], self.members[start : start + m] - offset
            last = min((len(array) for array in own.values()), default=1) - 1
            kinds.append(kind._replace(parameters={**kind.parameters, **laid_out(own, jnp.clip(members, 0, last))}))
            start += m
        return replace(self, kinds=tuple(kinds))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plan:
    """All agents in batches. The index arrays locate each result in the concatenated results of all batches.

    Attributes:
        batches: the agents.
        row: (C,) index of the result for each copy.
        agent: (N,) index of the result for each agent.
        member: (M,) index of the result for each constraint, family after family.
        pair: (P,) index of the result for each end of a link.
        floats: (P,) number of floats in a message over each end of a link.
        singles: (P,) number of those floats that may be sent in 32 bits.
        width: largest number of scalar variables that two neighbours share.
        exact: whether the agents can prove a bound: all used links form a tree, so that no information returns to its sender through
            others, and no constraint moves.
    """

    batches: tuple[Batch, ...]
    row: Array
    agent: Array
    member: Array
    pair: Array
    floats: Array
    singles: Array
    width: int = field(metadata={"static": True})
    exact: bool = field(metadata={"static": True})

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Plan:
        """Copy with new constraint parameters. `values`: for each family the parameters to replace, (M_f, …)."""
        return replace(self, batches=tuple(batch.with_parameters(values) for batch in self.batches))


ALIKE = 2**19
"""Largest number of matrix entries for which all agents are padded to one batch; beyond, there is one batch for each size class."""


class _Group(NamedTuple):
    """Agents of one batch, and the padded sizes n, g and p; see `Batch`."""

    agents: np.ndarray
    n: int
    g: int
    p: int


def plan_of(team: Team, copies: Estimates, shared: Shared) -> Plan:
    """Sort the agents of a team into batches of similar size.

    Args:
        team: the team.
        copies: the layout of estimates.
        shared: the variables that neighbours share.
    """
    count, d = team.count, team.dimension
    first = np.searchsorted(copies.holder, np.arange(count + 1))
    held = np.diff(first)
    degree = np.bincount(shared.pairs[:, 0], minlength=count)
    size = shared.sizes(d)
    widest = np.ones(count, dtype=np.int64)
    np.maximum.at(widest, shared.pairs[:, 0], size)
    power = np.ceil(np.log2(np.maximum(np.maximum(held, degree), 8) / 8) / 2).astype(int)  # size classes up to 8, 32, 128, …
    if count * max(degree.max(initial=0), 1) * (held.max(initial=0) * d + 1) ** 2 <= ALIKE:
        power[:] = 0
    forms = [form_of(family, d) for family in team.families]
    start = np.cumsum([0, *(family.size for family in team.families)])
    slot = np.arange(copies.count) - first[copies.holder]  # the own copy first, the others sorted by position
    mine = slot[copies.own]
    slot = np.where(slot == mine[copies.holder], 0, slot + (slot < mine[copies.holder]))
    made = [
        _made(team, copies, shared, forms, start, slot, group=_Group(np.flatnonzero(power == one), *(
            int(values[power == one].max(initial=0)) for values in (held, degree, widest)
        )))
        for one in np.unique(power)
    ]  # fmt: skip
    where = {}
    for name, total in (("rows", copies.count), ("agents", count), ("members", int(start[-1])), ("pairs", len(shared.pairs))):
        place, offset = np.zeros(total, dtype=np.int32), 0
        for batch in made:
            flat = np.asarray(getattr(batch, name)).ravel()
            inside = np.flatnonzero(flat < total)
            place[flat[inside]] = offset + inside
            offset += flat.size
        where[name] = on_device(place)
    places = size - np.bincount(shared.pair, weights=shared.row < 0, minlength=len(shared.pairs)).astype(np.int64)
    # quadratic + (barrier, level, margin, changes), and proof quadratic + (constant, weight, error)
    floats = size * (size + 3) // 2 + 4 + places * (places + 3) // 2 + 3
    return Plan(
        tuple(made), where["rows"], where["agents"], where["members"], where["pairs"],
        on_device(floats), on_device(size * (size + 3) // 2 + 3), int(size.max(initial=1)), shared.exact and not team.moves,
    )  # fmt: skip


def _made(team: Team, copies: Estimates, shared: Shared, forms: list[Form], start: np.ndarray, slot: np.ndarray, *, group: _Group) -> Batch:
    agents, d = group.agents, team.dimension
    place = np.full(team.count, -1)
    place[agents] = np.arange(len(agents))
    A, n = len(agents), group.n

    rows = np.full((n, A), copies.count, dtype=np.int32)
    chosen = np.flatnonzero(place[copies.holder] >= 0)
    rows[slot[chosen], place[copies.holder[chosen]]] = chosen

    pairs = np.full((group.g, A), len(shared.pairs), dtype=np.int32)
    talker = shared.pairs[:, 0]
    nth = np.arange(len(talker)) - np.searchsorted(talker, talker)
    ours = np.flatnonzero(place[talker] >= 0)
    pairs[nth[ours], place[talker[ours]]] = ours

    variables = np.full((group.g, group.p, A), n * d + 1, dtype=np.int32)
    width = np.where(shared.row < 0, 1, d)
    before = np.cumsum(width) - width
    within = before - before[np.searchsorted(shared.pair, shared.pair)]
    who = place[talker[shared.pair]]
    for axis in range(d):
        take = np.flatnonzero((who >= 0) & (axis < width))
        value = np.where(shared.row[take] < 0, n * d, slot[shared.row[take]] * d + axis)
        variables[nth[shared.pair[take]], within[take] + axis, who[take]] = value

    kinds, kept, members, families = [], [], [], []
    for number, (family, form, offset) in enumerate(zip(team.families, forms, start[:-1].tolist(), strict=True)):
        mine = np.flatnonzero(place[family.owner] >= 0)
        if not len(mine):
            continue
        mine = mine[np.argsort(family.owner[mine], kind="stable")]
        owner = place[family.owner[mine]]
        order = np.arange(len(mine)) - np.searchsorted(family.owner[mine], family.owner[mine])
        m = int(order.max()) + 1
        index = np.full((m, A), -1, dtype=np.int64)
        index[order, owner] = mine
        used = index >= 0
        filled = np.where(used, index, mine[0])
        held = slot[copies.rows(family.owner[:, None], family.agents)]  # (M_f, arity)
        slots = np.where(used[:, None, :], np.moveaxis(held[filled], -1, 1), 0)
        kinds.append(Kind(
            on_device(slots.astype(np.int32)),
            {key: on_device(np.moveaxis(np.asarray(value)[filled], 1, -1)) for key, value in family.parameters.items()},
            on_device(np.asarray(family.weight)[filled]),
            on_device(used),
        ))  # fmt: skip
        kept.append(form)
        families.append((number, offset))
        members.append(np.where(used, offset + index, start[-1]).astype(np.int32))
    stacked = np.concatenate([np.zeros((0, A), dtype=np.int32), *members])
    return Batch(
        on_device(agents.astype(np.int32)), on_device(rows), on_device(stacked), on_device(pairs), on_device(variables),
        tuple(kinds), tuple(kept), tuple(families),
    )  # fmt: skip


def form_of(family: Family, dimension: int) -> Form:
    """Static properties of the constraints of a family. `dimension`: d."""
    readings = read_curvatures(family.psi, family.arity, dimension, family.lasting, family.size)
    concave, quadratic, moves = bool(readings.concave.all()), readings.degree is not None, bool(family.tracks)
    bend = bend_of(family, dimension)
    if bend is None:
        return Form(family.psi, None, concave, quadratic, moves)
    values, vectors = np.linalg.eigh(bend)
    rows = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > 1e-12 * max(1e-300, np.abs(values).max(initial=0.0))].T
    return Form(family.psi, tuple(tuple(map(float, row)) for row in rows), concave, quadratic, moves)

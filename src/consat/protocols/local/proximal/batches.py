"""Agents sorted into batches that are solved together, laid out with the agents last, so that arithmetic runs along them.

Agents of the same *pattern* (as many constraints of each family, which read the same of their rows) make one batch: which row a
constraint reads is then known beforehand, and curvature that does not vary is a constant. Small teams, and agents of rare patterns, are
padded to a common shape instead, which compiles once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from consat.numerics import laid_out, on_device, once
from consat.problem.constraints.curvature import hessians
from consat.problem.constraints.domain import Extended, extended
from consat.problem.family import Family, distinct
from consat.problem.team import Team

SMALL_TEAM = 2000
"""Up to so many agents are batched by size and padded, which compiles once; of more, those of the common patterns, which runs faster."""
COMMON = 1 / 8
"""A pattern that this part of a team has is common."""
SQUARE = 2**15
"""Numbers in the matrices of a chunk, about: what stays in the cache while it is worked on."""
WIDEST, NARROWEST = 2048, 64
"""Agents in a chunk."""

MANY, PAIR = 16, 2
"""Of so many chunks or more there is an even number."""

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Form:
    """What is known beforehand of the constraints of one family in a batch.

    Attributes:
        psi: the function.
        slots: for each of an agent's constraints which of its rows ψ takes; None where that varies.
        bend: −∇²ψ, (arity·d)², for weight 1; None where it varies.
        family: which family of the team it is.
    """

    psi: Callable[..., Any]
    slots: tuple[tuple[int, ...], ...] | None
    bend: Matrix | None
    family: int


class Kind(NamedTuple):
    """The constraints of one family in a batch: m an agent, padded; leading axis the chunks, last axis the agents of a chunk.

    Attributes:
        slots: (chunks, m, arity, A) which of the agent's rows each constraint reads; None where known beforehand.
        parameters: (chunks, m, …, A).
        weight: (chunks, m, A); None if all are 1.
        used: (chunks, m, A) false where padded; None if nothing is.
        members: (chunks, m, A) places in the family; None where parameters stay what they are.
    """

    slots: Array | None
    parameters: Mapping[str, Array]
    weight: Array | None
    used: Array | None
    members: Array | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Agents of like shape.

    Attributes:
        agents: (chunks, A) which; the last is repeated where a chunk is not full.
        rows: (chunks, n, A) the rows of the state that their constraints read; the padding points past the last row.
        kinds: their constraints, a family each.
        forms: what is known of these beforehand.
        known: whether all of it is.
        convex: whether every ψ is known to be concave.
        partial: whether some ψ may be −∞ somewhere; see `consat.problem.constraints.domain`.
    """

    agents: Array
    rows: Array
    kinds: tuple[Kind, ...]
    forms: tuple[Form, ...] = field(metadata={"static": True})
    known: bool = field(metadata={"static": True})
    convex: bool = field(metadata={"static": True})
    partial: bool = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plan:
    """All batches, and where their answers go: gathered, which is faster than to scatter them.

    Attributes:
        batches: the agents that have constraints.
        row: (rows,) where the answer for each row stands among those of all batches, one after the other; past their end for rows that no
            constraint reads.
        agent: (N,) likewise for the agents.
        agents: N.
    """

    batches: tuple[Batch, ...]
    row: Array
    agent: Array
    agents: int = field(metadata={"static": True})

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Plan:
        """The same with other parameters; of each family those that are given, (M_f, …). For a plan made for it."""

        def changed(kind: Kind, form: Form) -> Kind:
            own = values[form.family]
            return kind if kind.members is None or not own else kind._replace(parameters={**kind.parameters, **laid_out(own, kind.members)})

        kinds = [tuple(map(changed, batch.kinds, batch.forms)) for batch in self.batches]
        return replace(self, batches=tuple(replace(batch, kinds=own) for batch, own in zip(self.batches, kinds, strict=True)))


def buckets(team: Team, row: Callable[[np.ndarray, np.ndarray], np.ndarray], count: int, convex: bool, *, live: bool = False) -> Plan:
    """Sort the agents that have constraints into batches.

    Args:
        team: the team.
        row: gives the row of the copy (holder, position).
        count: how many rows there are.
        convex: whether every ψ is known to be concave.
        live: whether parameters may change; see `Plan.with_parameters`.
    """
    sizes = np.stack([np.bincount(family.owner, minlength=team.count) for family in team.families], axis=1) if team.families else None
    made: list[_Made] = []
    if sizes is not None:
        bends = [_bend(family, team.dimension) for family in team.families]
        patterns = _patterns(team, sizes) if team.count > SMALL_TEAM else []
        others = np.asarray(sizes.any(axis=1))
        for group in patterns:
            others[group.agents] = False
        for group in [*patterns, *_padded(team, sizes, np.flatnonzero(others))]:
            made.append(_made(team, group, bends, row, count, live=live))
    rows, agents = np.full(count, -1, dtype=np.int32), np.full(team.count, -1, dtype=np.int32)
    row_start = agent_start = 0
    batches = []
    for one in made:
        flat = one.rows.ravel()  # chunk by chunk, row by row, agent by agent: the order of answers
        inside = flat < count
        rows[flat[inside]] = row_start + np.flatnonzero(inside)
        agents[one.agents.ravel()] = agent_start + np.arange(one.agents.size)
        row_start, agent_start = row_start + flat.size, agent_start + one.agents.size
        batches.append(one.batch(convex))
    rows[rows < 0], agents[agents < 0] = row_start, agent_start
    return Plan(tuple(batches), on_device(rows), on_device(agents), team.count)


class _Group(NamedTuple):
    """Agents for one batch.

    Attributes:
        agents: (A,).
        members: for each family (A, m) which of its constraints they have, −1 where padded.
        positions: (n, A) whose positions these read, −1 where padded.
        slots: for each family (m, arity, A), or if known beforehand (m, arity).
    """

    agents: np.ndarray
    members: list[np.ndarray]
    positions: np.ndarray
    slots: list[np.ndarray]


def _patterns(team: Team, sizes: np.ndarray) -> list[_Group]:
    """The agents of the common patterns."""
    some = np.flatnonzero(sizes.any(axis=1))
    base = np.concatenate([[1], np.cumprod(sizes.max(axis=0).astype(np.int64) + 1)[:-1]])
    code = sizes[some] @ base
    groups = []
    for one in distinct(code):
        agents = some[code == one]
        group = _pattern(team, agents, sizes[agents[0]]) if len(agents) >= COMMON * len(some) else None
        if group is not None:
            groups.append(group)
    return groups


def _pattern(team: Team, agents: np.ndarray, most: np.ndarray) -> _Group | None:
    """Agents that have as many constraints of each family; None if these do not read alike."""
    members = _members(team, agents, most)
    columns, slots = [agents.astype(np.int32)], []
    for family, mine in zip(team.families, members, strict=True):
        where = np.zeros((mine.shape[1], family.arity), dtype=np.int64)
        for k in range(mine.shape[1]):
            read = family.agents[mine[:, k]]
            for a in range(family.arity):
                equal = [int(np.count_nonzero(column == read[:, a])) for column in columns]
                if any(0 < number < len(agents) for number in equal):
                    return None
                if len(agents) not in equal:
                    equal.append(len(agents))
                    columns.append(read[:, a])
                where[k, a] = equal.index(len(agents))
        slots.append(where)
    return _Group(agents, members, np.stack(columns), slots)


def _members(team: Team, agents: np.ndarray, most: np.ndarray) -> list[np.ndarray]:
    """For each family (A, m) which of its constraints these agents have, −1 where padded."""
    place = np.full(team.count, -1, dtype=np.int32)
    place[agents] = np.arange(len(agents), dtype=np.int32)
    found = []
    for family, m in zip(team.families, most.tolist(), strict=True):
        mine = np.flatnonzero(place[family.owner] >= 0)
        owner = place[family.owner[mine]]
        if np.any(owner[1:] < owner[:-1]):
            order = np.argsort(owner, kind="stable")
            mine, owner = mine[order], owner[order]
        if len(mine) == len(agents) * m:
            found.append(mine.reshape(len(agents), m))
            continue
        index = np.full((len(agents), m), -1, dtype=np.int64)
        index[owner, np.arange(len(owner)) - np.searchsorted(owner, owner)] = mine
        found.append(index)
    return found


def _padded(team: Team, sizes: np.ndarray, own: np.ndarray) -> list[_Group]:
    """These agents by the number of their rows, to the same power of two."""
    if not len(own):
        return []
    n = team.count
    keys = [family.owner[:, None].astype(np.int64) * n + family.agents for family in team.families]
    theirs = np.zeros(n, dtype=bool)
    theirs[own] = True
    read = distinct(np.concatenate([own * (n + 1), *(key[theirs[f.owner]].ravel() for key, f in zip(keys, team.families, strict=True))]))
    holder, position = np.divmod(read, n)
    first = np.searchsorted(holder, np.arange(n + 1))
    width = np.diff(first)
    power = np.ceil(np.log2(np.maximum(width[own], 4))).astype(int)
    # the agent's own row comes first: its place does not hang on who the others are
    own_place = np.searchsorted(read, own * (n + 1)) - first[own]
    shifted = np.zeros(n, dtype=np.int64)
    shifted[own] = own_place
    groups = []
    for one in np.unique(power):
        agents = own[power == one]
        place = np.full(n, -1)
        place[agents] = np.arange(len(agents))
        positions = np.full((int(width[agents].max()), len(agents)), -1, dtype=np.int64)
        chosen = place[holder] >= 0
        slot = _own_first(np.flatnonzero(chosen) - first[holder[chosen]], shifted[holder[chosen]])
        positions[slot, place[holder[chosen]]] = position[chosen]
        members = _members(team, agents, sizes[agents].max(axis=0))
        slots = []
        for family, key, mine in zip(team.families, keys, members, strict=True):
            there = np.searchsorted(read, key) - first[family.owner][:, None]
            there = _own_first(there, shifted[family.owner][:, None])
            slots.append(np.moveaxis(np.where((mine >= 0)[..., None], there[mine], 0), 0, -1))
        groups.append(_Group(agents, members, positions, slots))
    return groups


def _own_first(slot: np.ndarray, own: np.ndarray) -> np.ndarray:
    return np.where(slot == own, 0, slot + (slot < own))


def _bend(family: Family, dimension: int) -> Matrix | None:
    """−∇²ψ for weight 1, if it is the same for all members."""
    try:
        constant = once(hessians(family.psi, family.arity, dimension, family.lasting, family.size))
    except ValueError:
        return None
    if len(constant) != 1 or not np.isfinite(constant).all():
        return None
    return tuple(tuple(map(float, line)) for line in -constant[0])


@dataclass(frozen=True)
class _Made:
    agents: np.ndarray
    rows: np.ndarray
    kinds: tuple[Kind, ...]
    forms: tuple[Form, ...]

    def batch(self, convex: bool) -> Batch:
        known = all(form.slots is not None and form.bend is not None for form in self.forms)
        partial = any(isinstance(form.psi, Extended) for form in self.forms)
        return Batch(on_device(self.agents), on_device(self.rows), self.kinds, self.forms, known, convex, partial)


def _made(team: Team, group: _Group, bends: Sequence[Matrix | None], row: Callable[..., np.ndarray], count: int, *, live: bool) -> _Made:
    agents, n = len(group.agents), len(group.positions)
    width = min(max(SQUARE // (n * team.dimension) ** 2, NARROWEST), WIDEST)
    chunks = -(-agents // width)
    chunks += -chunks % PAIR if chunks >= MANY else 0
    width = -(-agents // chunks)
    full = np.minimum(np.arange(chunks * width), agents - 1)

    def cut(values: np.ndarray) -> np.ndarray:
        """(…, A) → (chunks, …, width)."""
        whole = values if chunks * width == agents else values[..., full]
        return np.ascontiguousarray(np.moveaxis(whole.reshape(*values.shape[:-1], chunks, width), -2, 0))

    holder = np.broadcast_to(group.agents, group.positions.shape)
    rows = np.full(group.positions.shape, count, dtype=np.int32)
    there = group.positions >= 0
    if there.all():
        rows = row(holder, group.positions)
    else:
        rows[there] = row(holder[there], group.positions[there])
    kinds, forms = [], []
    for number, (family, members, slots, bend) in enumerate(zip(team.families, group.members, group.slots, bends, strict=True)):
        if not members.shape[1]:
            continue
        used = members >= 0
        index = members if used.all() else np.where(used, members, members[used][0])  # some constraint stands where there is none
        weight = family.weight[index]
        kinds.append(
            Kind(
                None if slots.ndim == 2 else on_device(cut(slots.astype(np.int32))),
                {key: on_device(cut(np.moveaxis(value[index], 0, -1))) for key, value in family.parameters.items()},
                None if (weight == 1.0).all() else on_device(cut(weight.T)),
                None if used.all() else on_device(cut(used.T)),
                on_device(cut(index.T.astype(np.int32))) if live else None,
            )
        )
        psi = extended(family.psi, family.arity, team.dimension, family.parameters)
        forms.append(Form(psi, tuple(map(tuple, slots.tolist())) if slots.ndim == 2 else None, bend, number))
    return _Made(cut(group.agents.astype(np.int32)), cut(rows), tuple(kinds), tuple(forms))

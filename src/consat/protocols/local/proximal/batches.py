"""Batches of agents that are solved together. The last axis of every array is the agent, so that operations are vectorised over agents.

Agents with the same *pattern* (the same number of constraints of each family, which read the same of their rows) form one batch. The rows
that a constraint reads, and a constant curvature, are then static. Small teams, and agents with rare patterns, are padded to a common shape
instead, which compiles once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from consat.numerics import distinct, laid_out, on_device
from consat.problem.constraints.domain import Extended, extended
from consat.problem.family import Family
from consat.problem.team import Team
from consat.protocols.local.lanewise import bend_of

SMALL_TEAM = 2000
"""Largest team whose agents are batched by size and padded, which compiles once. In larger teams common patterns get a batch of their own,
which runs faster."""
COMMON = 1 / 8
"""Smallest fraction of the agents with constraints that makes a pattern common."""
SQUARE = 2**15
"""Approximate number of matrix entries of a chunk, chosen to fit in the cache."""
WIDEST, NARROWEST = 2048, 64
"""Largest and smallest width of a chunk, in agents."""

MANY, PAIR = 16, 2
"""From `MANY` chunks on, their number is a multiple of `PAIR`, and `PAIR` chunks are computed at a time."""

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Form:
    """Static properties of the constraints of one family in a batch.

    Attributes:
        psi: the function ψ.
        slots: (m, arity) which of the agent's rows each constraint reads; None where this differs between agents.
        bend: (arity·d, arity·d) −∇²ψ for weight 1; None where it varies.
        family: index of the family in the team.
    """

    psi: Callable[..., Any]
    slots: tuple[tuple[int, ...], ...] | None
    bend: Matrix | None
    family: int


class Kind(NamedTuple):
    """The constraints of one family in a batch, m for each agent with padding. The first axis is the chunk, the last the agent in it.

    Attributes:
        slots: (chunks, m, arity, A) which of the agent's rows each constraint reads; None where `Form.slots` is set.
        parameters: name to (chunks, m, …, A).
        weight: (chunks, m, A); None if all are 1.
        used: (chunks, m, A) false where padded; None without padding.
        members: (chunks, m, A) indices in the family; None where parameters cannot change.
    """

    slots: Array | None
    parameters: Mapping[str, Array]
    weight: Array | None
    used: Array | None
    members: Array | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Agents of similar size.

    Attributes:
        agents: (chunks, A) indices of the agents; the last is repeated where a chunk is not full.
        rows: (chunks, n, A) rows of the state that their constraints read; padded with the number of rows.
        kinds: their constraints, one entry per family.
        forms: static properties of these families.
        known: whether slots and curvature of all families are static.
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
    """All batches, and the indices that gather their results (a gather is faster than a scatter).

    Attributes:
        batches: the agents that have constraints.
        row: (rows,) index of each row in the concatenated results of all batches; past their end for rows that no constraint reads.
        agent: (N,) index of each agent in the concatenated results; past their end for agents without constraints.
        agents: N.
    """

    batches: tuple[Batch, ...]
    row: Array
    agent: Array
    agents: int = field(metadata={"static": True})

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Plan:
        """Copy with new constraint parameters, for a plan made with ``live``. `values`: for each family those to replace, (M_f, …)."""

        def changed(kind: Kind, form: Form) -> Kind:
            own = values[form.family]
            return kind if kind.members is None or not own else kind._replace(parameters={**kind.parameters, **laid_out(own, kind.members)})

        kinds = [tuple(map(changed, batch.kinds, batch.forms)) for batch in self.batches]
        return replace(self, batches=tuple(replace(batch, kinds=own) for batch, own in zip(self.batches, kinds, strict=True)))


def buckets(team: Team, row: Callable[[np.ndarray, np.ndarray], np.ndarray], count: int, convex: bool, *, live: bool = False) -> Plan:
    """Sort the agents that have constraints into batches.

    Args:
        team: the team.
        row: function that returns the rows of the copies (holder, position).
        count: number of rows.
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
        flat = one.rows.ravel()  # ordered by chunk, row, agent, as the results are
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
        members: for each family (A, m) indices of their constraints, −1 where padded.
        positions: (n, A) agents whose positions these constraints read, −1 where padded.
        slots: for each family which of the n rows each constraint reads: (m, arity, A), or (m, arity) if equal for all agents.
    """

    agents: np.ndarray
    members: list[np.ndarray]
    positions: np.ndarray
    slots: list[np.ndarray]


def _patterns(team: Team, sizes: np.ndarray) -> list[_Group]:
    """One group for each common pattern. `sizes`: (N, families) number of constraints of each agent."""
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
    """Group of agents with the same number of constraints of each family, `most`, (families,); None if their slots differ."""
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
    """For each family (A, m) indices of the constraints of these agents, −1 where padded. `most`: (families,) m."""
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
    """Groups of the agents `own` by the number of their rows, rounded up to a power of two."""
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
    # the agent's own row comes first, so that its index does not depend on the other agents
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
    found = bend_of(family, dimension)
    return None if found is None else tuple(tuple(map(float, line)) for line in found)


@dataclass(frozen=True)
class _Made:
    """A batch whose agents and rows are still NumPy arrays; see `Batch`."""

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
        index = members if used.all() else np.where(used, members, members[used][0])  # padding repeats an existing constraint
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

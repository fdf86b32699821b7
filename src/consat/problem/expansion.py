"""Constraints of a group as arrays: resolves which members own them, and which agents they read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from consat.errors import Fault, shown
from consat.problem.constraints.record import OWNER, Constraint, Number, Vector, flatten
from consat.problem.entries import Entry, trace, wrong_name
from consat.problem.family import Family
from consat.problem.groups import ACROSS, OTHER, PLACE, SELF, Each, Group, Ints, Layout, label, layout
from consat.problem.index import Index
from consat.problem.names import Derived
from consat.problem.parameters import Path, Spot, checked, checked_rows
from consat.problem.schedule import Schedule, Track


@dataclass
class Expansion:
    """Turns the constraints of a group into arrays.

    Attributes:
        group: a group without faults; see `faults_of`.
        first: index of its first member in the team.
        index: ids of the team.
        dimension: d.
        path: place of the group in the input, for faults.
        faults: list to which faults are added.
        layout: places of the members.
    """

    group: Group
    first: int
    index: Index
    dimension: int
    path: Path
    faults: list[Fault]
    layout: Layout = field(init=False)

    def __post_init__(self) -> None:
        self.layout = layout(self.group, self.dimension)

    def parts(self) -> list[tuple[Family, Sequence[str]]]:
        """For each constraint of the group that a member owns: the family with one row per owner, and the names."""
        made: list[tuple[Family, Entry]] = []
        taken: set[str] = set()
        for path, each in self.entries():
            constraint = each.constraint
            where = f"{label(self.group)}, constraint {constraint.name or constraint.kind!r}"
            spot = Spot(path, "", where, self.faults)
            if constraint.name is not None:
                if message := wrong_name(constraint.name, taken, label(self.group)):
                    spot.fault(message, "name")
                    continue
                taken.add(constraint.name)
            family = self.family(each, spot)
            if family is not None and family.size:
                first = {key: value[0] for key, value in family.parameters.items()}
                made.append((family, Entry(constraint, self.first, tuple(range(family.arity)), "", path, where, first)))
        trace((entry for _, entry in made), self.dimension, self.faults)
        return self.named([(family, entry.constraint) for family, entry in made])

    def entries(self) -> Iterator[tuple[Path, Each]]:
        """(path, constraint with its owners) for each constraint of the group; nested lists are flattened."""
        for k, item in enumerate(self.group.constraints):
            path = (*self.path, "constraints", k)
            outer = item if isinstance(item, Each) else Each(item)
            for constraint in flatten(outer.constraint):
                if isinstance(constraint, Constraint):
                    yield path, replace(outer, constraint=constraint)
                elif isinstance(constraint, Each):
                    yield path, constraint
                else:
                    message = f"{constraint!r} is no constraint; use consat.within and its like"
                    self.faults.append(Fault(path, message, label(self.group)))

    def family(self, each: Each, spot: Spot) -> Family | None:
        """The family of one constraint of the group, with one row per owner and agent read, not numbered; None if it has faults."""
        constraint, known = each.constraint, len(self.faults)
        rows = self.members(each.of, spot)
        reads, relation = self.slots(constraint, each.agent, spot)
        if len(self.faults) > known:
            return None
        row, other = self.related(relation, rows, spot)
        columns = [row + self.first if kind == OWNER else other if kind == OTHER else np.full(len(row), kind) for kind in reads]
        values, tracks = {}, {}
        for key, parameter in constraint.parameters.items():
            value = self.values(parameter, row, other, spot.under(key))
            if isinstance(value, Schedule):
                many = len(row)
                times, places = (np.broadcast_to(each, (many, *each.shape)) for each in (value.times, value.values))
                tracks[key] = Track(np.arange(many, dtype=np.int32), times, places)
                value = np.broadcast_to(value.at(0.0), (many, *value.values.shape[1:]))
            values[key] = value
        weight = self.values(Number(constraint.weight, positive=True), row, other, spot.under("weight"))
        if isinstance(weight, Schedule):
            spot.fault("weight moves with time, but must be a positive number", "weight")
        if len(self.faults) > known or isinstance(weight, Schedule):
            return None
        return Family(
            kind=constraint.kind,
            psi=constraint.psi,
            agents=np.stack(columns, axis=1).astype(np.int32),
            owner=(row + self.first).astype(np.int32),
            number=np.zeros(len(row), dtype=np.int32),
            parameters=values,
            weight=weight,
            sources=None if constraint.source is None else (constraint.source,) * len(row),
            tracks=tracks if len(row) else {},
        )

    def members(self, of: Any, spot: Spot) -> Ints:
        """The indices, in the group, of the members that own a constraint; see `each` for `of`."""
        count = self.group.count
        if of is None:
            return np.arange(count)
        if isinstance(of, np.ndarray) and of.ndim == 1 and of.dtype.kind in "iu":
            if not len(of) or (of.min() >= 0 and of.max() < count):
                return of.astype(np.int64)
            spot.fault(f"of holds places beyond 0 to {count - 1}", "of")
            return np.arange(0)
        if of in ("first", "last"):
            return np.array([0 if of == "first" else count - 1])
        if isinstance(of, Mapping) and list(of) == ["every"] and type(of["every"]) is int and of["every"] >= 1:
            return np.flatnonzero((self.layout.steps % of["every"] == 0).all(axis=1))
        chosen = of if isinstance(of, list | tuple) else [of]
        places = [self.index.get(name) for name in chosen if isinstance(name, str)]
        inside = [place - self.first for place in places if place is not None and 0 <= place - self.first < count]
        if len(inside) != len(chosen) or not inside:
            example = f"first, last, {{every: 10}}, or ids of the group such as [{self.group.name}1]"
            spot.fault(f"of is {shown(of)}, but must be one of {example}", "of")
        return np.unique(np.array(inside, dtype=np.int64))

    def slots(self, constraint: Constraint, agent: Any, spot: Spot) -> tuple[list[Any], Any]:
        """Resolve the positions that a constraint reads. `agent` is the relation of a text expression; see `each`.

        Returns:
            `OWNER`, `OTHER`, or the index of an agent in the team, for each position; and how `OTHER` is found, None if ψ does not read it.
        """
        reads: list[Any] = []
        relation: Any = None
        written = constraint.source is not None
        for read in constraint.reads:
            if isinstance(read, str) and (read == OWNER or (written and read == SELF)):
                reads.append(OWNER)
            elif not isinstance(read, str) or (written and read == OTHER):
                relation = agent if isinstance(read, str) else read
                reads.append(OTHER)
            elif (place := self.index.get(read)) is not None:
                reads.append(place)
            else:
                relative = f"; in a group, {SELF} is the member and {OTHER} the one that `agent` tells of" if written else ""
                key = "psi" if written else "agent"
                spot.fault(f"there is no agent {shown(read)}{relative}", key)
        if OWNER not in reads and not self.faults:
            key = "psi" if written else "agent"
            spot.fault(f"it must read the position of its owner, {SELF}, but does not", key)
        if OTHER in reads and relation is None:
            message = f"agent is missing: it tells who `{OTHER}` is, such as -1 for the one ahead"
            spot.fault(message, "agent")
        elif agent is not None and OTHER not in reads:
            spot.fault(f"agent tells who `{OTHER}` is, but psi does not read `{OTHER}`", "agent")
        fixed = [read for read in reads if isinstance(read, int)]
        if len(set(fixed)) < len(fixed):
            spot.fault("it names the same agent twice; name another agent", "agent")
        return reads, relation

    def related(self, relation: Any, rows: Ints, spot: Spot) -> tuple[Ints, Ints]:
        """Resolve a relation for the owners `rows`.

        Returns:
            the indices, in the group, of the owners for which the relation finds an agent, and the indices, in the team, of these agents.
        """
        if relation is None:
            return rows, np.zeros(len(rows), dtype=np.int64)
        if isinstance(relation, np.ndarray):
            inside = (relation >= 0) & (relation < self.group.count) if relation.dtype.kind in "iu" else np.zeros(1, dtype=bool)
            if relation.shape == rows.shape and inside.all():
                if (rows == relation).any():
                    spot.fault("agent names the owner itself for some of these constraints", "agent")
                return rows, relation.astype(np.int64) + self.first
            message = f"agent must be an array of {len(rows)} places from 0 to {self.group.count - 1}, one for each of these constraints"
        elif isinstance(relation, Mapping):
            k = relation.get("nearest")
            if list(relation) == ["nearest"] and type(k) is int and 1 <= k < self.group.count:
                return self.nearest(k, rows)
            message = f"agent is {shown(relation)}, but must be {{nearest: k}} with k from 1 to {self.group.count - 1}"
        else:
            steps = list(relation) if isinstance(relation, list | tuple) else [relation]
            axes = len(self.layout.sides)
            if all(type(step) is int for step in steps) and any(steps) and len(steps) in (1, axes):
                return self.shifted(steps, rows)
            grid = f", or a list of {axes} of them, steps along the axes of the grid" if axes > 1 else ""
            message = (
                f"agent is {shown(relation)}, but must be an id, a whole number other than 0, such as -1 for the one ahead{grid}, "
                "or {nearest: k}"
            )
        spot.fault(message, "agent")
        return rows[:0], rows[:0]

    def shifted(self, steps: list[int], rows: Ints) -> tuple[Ints, Ints]:
        """Resolve an offset along the group (one step) or along the axes of its grid (d steps)."""
        count = self.group.count
        if len(steps) == 1:
            other = rows + steps[0]
            if self.layout.ring:
                other %= count
            inside = (other >= 0) & (other < count) & (other != rows)
            return rows[inside], other[inside] + self.first
        target = self.layout.steps[rows] + np.array(steps)
        inside = ((target >= 0) & (target < self.layout.sides)).all(axis=1)
        rows = rows[inside]
        other = np.ravel_multi_index(tuple(target[inside].T), self.layout.sides)
        exists = other < count  # the last row of a grid may be short
        return rows[exists], other[exists] + self.first

    def nearest(self, k: int, rows: Ints) -> tuple[Ints, Ints]:
        """Resolve ``{"nearest": k}``: k rows for each owner."""
        from scipy.spatial import cKDTree

        places = self.layout.places
        found = cKDTree(places, balanced_tree=False, compact_nodes=False).query(places[rows], k + 1, workers=-1)[1]
        itself = found == rows[:, None]
        itself[~itself.any(axis=1), -1] = True  # where places coincide, the owner may be missing among those found
        return np.repeat(rows, k), found[~itself].reshape(-1, k).ravel() + self.first

    def values(self, parameter: Any, row: Ints, other: Ints, spot: Spot) -> np.ndarray | Schedule:
        """(M, …) values of one parameter, or one schedule for all. Placeholder values if a fault was added."""
        value, places, key = parameter.value, self.layout.places, spot.name
        if isinstance(parameter, Vector) and isinstance(value, str) and value == ACROSS and key == "center":
            return -places[row]
        if isinstance(parameter, Vector) and isinstance(value, str) and value == PLACE and key in ("center", "vector"):
            return places[row] - places[other - self.first] if key == "vector" else places[row]
        if (
            isinstance(value, np.ndarray)
            and value.ndim == (2 if isinstance(parameter, Vector) else 1)
            and isinstance(parameter, Number | Vector)
        ):
            rows = checked_rows(parameter, (len(row), self.dimension), spot)
            return np.zeros(len(row)) if rows is None else rows
        one = checked(parameter, self.dimension, spot)
        if isinstance(one, Schedule):
            return one
        return np.zeros(len(row)) if one is None else np.broadcast_to(one, (len(row), *one.shape))

    def named(self, made: list[tuple[Family, Constraint]]) -> list[tuple[Family, Sequence[str]]]:
        """The families, numbered by their order in the group, with names. A name that one owner would have twice gets a number."""
        stems: dict[str, list[int]] = {}
        others = []
        for p, (family, constraint) in enumerate(made):
            reads = family.agents if constraint.name is None else family.agents[:, :0]
            others.append(_others(reads, family.owner))
            stems.setdefault(constraint.name or f"{constraint.kind}({others[p].shape[1]})", []).append(p)
        names: dict[int, Sequence[str]] = {}
        for parts in stems.values():
            owner = np.concatenate([made[p][0].owner for p in parts])
            rank = _ranks([owner, *np.concatenate([others[p] for p in parts]).T])
            ends = np.cumsum([len(others[p]) for p in parts])[:-1]
            mine = [None] * len(parts) if rank is None else np.split(rank, ends)
            for p, again in zip(parts, mine, strict=True):
                constraint = made[p][1]
                names[p] = Derived(
                    constraint.name or constraint.kind, self.index.ids if constraint.name is None else None, others[p], again
                )
        return [(replace(family, number=family.number + p), names[p]) for p, (family, _) in enumerate(made)]


def _others(agents: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """(M, k − 1) the agents read besides the owner, which is one of the k; (M, 0) if k = 0."""
    if not agents.shape[1]:
        return agents
    if (agents[:, 0] == owner).all():
        return agents[:, 1:]
    return agents[agents != owner[:, None]].reshape(len(agents), agents.shape[1] - 1)


def _ranks(keys: list[np.ndarray]) -> np.ndarray | None:
    """(M,) number of earlier rows with equal keys; None if all rows differ."""
    order = np.lexsort(keys[::-1]) if len(keys) > 1 else np.argsort(keys[0], kind="stable")
    new = np.ones(len(order), dtype=bool)
    new[1:] = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
    if new.all():
        return None
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order)) - np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))
    return rank

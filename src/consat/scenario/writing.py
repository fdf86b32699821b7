"""Team and settings as the text of a scenario file.

YAML 1.2 contains JSON, so short values are written in its style; the layout is chosen for reading.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import numpy as np

from consat.constraints import KINDS, OWNER, Constraint, box
from consat.errors import Fault, InvalidTeam
from consat.scenario.document import resolve
from consat.scenario.schema import SETTINGS, VERSION
from consat.settings import Settings
from consat.team import TOPOLOGIES, Family, Team, topology

WIDTH: Final = 110
"""Lists and mappings up to this many characters stand on one line."""

_WORDS = re.compile(r"[A-Za-z][\w-]*( [\w-]+)*", re.ASCII)
_UNPRINTED = re.compile("[\x7f-\x9f\u2028\u2029\ufeff]")


def dump(team: Team, settings: Settings | None = None, name: str = "team") -> str:
    """The scenario file of a team; loading it gives the same team.

    Args:
        team: built of library constraints and text expressions. A `consat.box` is written as the half-spaces it consists of.
        settings: start, protocol and smoothing are written; the rest is for the command line.
        name: of the scenario.

    Raises:
        InvalidTeam: names the constraints that are Python functions: no file can hold them.
    """
    constraints: dict[int, dict[str, Any]] = {}
    for family in team.families:
        constraints.update(zip(map(int, family.number), _constraints(team, family), strict=True))
    owned: list[list[dict[str, Any]]] = [[] for _ in team.ids]
    faults = []
    for number, owner in enumerate(team.owner):
        if "kind" not in constraints[number]:
            message = "it is a Python function, which no file can hold; use a library constraint or consat.expr"
            path = ("agents", int(owner), "constraints", len(owned[owner]))
            faults.append(Fault(path, message, f"agent {team.ids[owner]!r}, constraint {team.names[number]!r}"))
        owned[owner].append(constraints[number])
    if faults:
        raise InvalidTeam(faults)
    agents = [
        {"id": agent} | ({} if np.isnan(start).any() else {"start": start.tolist()}) | ({"constraints": own} if own else {})
        for agent, start, own in zip(team.ids, team.starts, owned, strict=True)
    ]
    chosen = (settings or Settings()).model_dump(mode="json", by_alias=True, exclude_defaults=True, include=set(SETTINGS))
    head = {"consat": VERSION, "name": name, "dimension": team.dimension}
    return write(head | {"agents": agents, "communication": _communication(team)} | chosen)


def write(data: Mapping[str, Any]) -> str:
    """YAML for plain data."""
    return "\n".join(_lines(data)) + "\n"


def _constraints(team: Team, family: Family) -> Iterator[dict[str, Any]]:
    """The entries of a family, in its order; without ``kind`` if no file can hold them."""
    for k, number in enumerate(family.number):
        parameters = {key: values[k].tolist() for key, values in family.parameters.items()}
        reads = [team.ids[i] for i in family.agents[k]]
        entry: dict[str, Any] = {}
        if family.sources is not None:
            entry = {"kind": "expr", "psi": family.sources[k]}
        elif family.psi in _SIDES:
            sign, bound = _SIDES[family.psi]
            normal = sign * family.parameters["axis"][k]
            entry = {"kind": "halfspace", "normal": normal.tolist(), "offset": float(normal @ family.parameters[bound][k])}
        elif family.psi in _KIND_OF:
            entry = {"kind": _KIND_OF[family.psi]} | ({"agent": reads[1]} if len(reads) > 1 else {}) | parameters
        others = [agent for agent, i in zip(reads, family.agents[k], strict=True) if i != family.owner[k]]
        derived = f"{entry.get('kind')}({', '.join(others)})" if others else entry.get("kind")
        if team.names[number] != derived:
            entry["name"] = team.names[number]
        if family.weight[k] != 1:
            entry["weight"] = float(family.weight[k])
        yield entry


def _kinds() -> Iterator[tuple[Callable[..., Any], str]]:
    for kind, factory in KINDS.items():
        if kind not in ("box", "expr"):
            required = [key for key, each in inspect.signature(factory).parameters.items() if each.default is each.empty]
            probe = factory(**dict.fromkeys(required, OWNER))
            if isinstance(probe, Constraint):
                yield probe.psi, kind


_KIND_OF: Final = dict(_kinds())
_SIDES: Final = {side.psi: (-1.0, "low") if "low" in side.parameters else (1.0, "high") for side in box([0], [1])}
"""Of the sides of a box: the sign of their normal, and the parameter that bounds them."""


def _communication(team: Team) -> dict[str, Any]:
    for graph in ("task", *TOPOLOGIES):
        if len(team.links) and np.array_equal(topology(graph, team.count, team.families), team.links):
            return {"graph": graph}
    return {"links": [[team.ids[i], team.ids[j]] for i, j in team.links]}


def _lines(value: Mapping[str, Any] | list[Any]) -> Iterator[str]:
    """The lines of a block: one an entry where the entry is short and holds no mapping, else its own block, indented."""
    entries = [(f"{_flow(key)}:", each) for key, each in value.items()] if isinstance(value, Mapping) else [("-", each) for each in value]
    for lead, each in entries:
        if not isinstance(each, dict | list) or not any(map(_holds_mapping, each.values() if isinstance(each, dict) else each)):
            text = _flow(each)
            if len(text) <= WIDTH or not isinstance(each, dict | list):
                yield f"{lead} {text}"
                continue
        inner = _lines(each)
        yield f"- {next(inner)}" if lead == "-" else lead
        yield from (f"  {line}" for line in inner)


def _holds_mapping(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(map(_holds_mapping, value)))


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, str):
        if _WORDS.fullmatch(value) and resolve(value) == value:
            return value
        return _UNPRINTED.sub(lambda odd: f"\\u{ord(odd[0]):04x}", json.dumps(value, ensure_ascii=False))
    return str(int(value)) if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 else json.dumps(value)

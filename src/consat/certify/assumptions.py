"""Checks of the paper's Assumptions 1 to 3 (connected communication, one cluster, compact level sets), convexity and a unique optimum.

For concave ψ_k = c_k + b_k·y + ½ yᵀH_k y the level sets are compact iff

    {d : H_k d = 0 and b_k·d ≥ 0 for all k} = {0}.

Then the minimiser of f exists and is unique. Otherwise there is no minimiser, or a whole line of them; see `recession`. Constraints of
higher degree can only shrink the level sets.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from consat.certify.quadratics import Floats, Ints, expand, shape_of
from consat.certify.recession import Recession, recession
from consat.problem.constraints.library import within
from consat.problem.family import Family
from consat.problem.graphs import clusters, disconnected, members, relays
from consat.problem.team import Team
from consat.problem.units import scale

SCHEMA = "consat.check/1"
MOST_LISTED = 10_000
"""Above this many agents the report leaves out the lists of agents and constraints."""
AUXILIARY = "auxiliary"
"""Name of the constraints that `with_auxiliary` adds."""


def report(team: Team) -> dict[str, Any]:
    """The report that ``check --json`` prints (schema consat.check/1).

    ``agents`` (ids), ``clusters``, ``relays`` and ``constraints`` are null above `MOST_LISTED` agents.
    """
    shape, cluster = shape_of(team), clusters(team)
    listed = team.count <= MOST_LISTED
    bounded, unique, adrift = existence(team)
    parts, joining = disconnected(team), _relays(team, cluster)
    count = int(cluster.max(initial=-1)) + 1
    return {
        "schema": SCHEMA,
        "agents": list(team.ids) if listed else None,
        "count": team.count,
        "clusters": members(team, cluster) if listed else None,
        "cluster_count": count,
        "communication_connected": not parts,
        "relays": joining if listed else None,
        "constraint_count": len(team.owner),
        "constraints": _constraints(team) if listed else None,
        "convex": bool(shape.concave.all()),
        "unique_optimum": unique,
        "bounded": bounded,
        "assumptions": [_communication(parts, joining), _one_cluster(count), _compact(team, bounded, adrift)],
    }


def existence(team: Team) -> tuple[bool | None, bool | None, list[str]]:
    """Existence and uniqueness of the optimum.

    Agents whose position no constraint reads are left out: their position does not matter.

    Returns:
        whether the level sets are compact, whether f has exactly one minimiser (None: unknown), and the ids of agents that can move to
        infinity without any ψ getting worse (empty unless the level sets are proven not compact).
    """
    shape = shape_of(team)
    model = expand(team, np.full((team.count, team.dimension), scale(team).center))
    good, read = shape.concave & shape.quadratic, np.zeros(team.count, dtype=bool)
    for family in team.families:
        read[family.agents] = True
    kept = recession(model.keep(good), read)
    bounded, unique, adrift = kept.bounded, None, kept.adrift
    if not bounded and not good.all():
        nobody = Recession(None, None, np.zeros(team.count, dtype=bool))
        everything = recession(model, read) if shape.quadratic.all() else nobody
        bounded = False if everything.bounded is False else None
        unique = False if everything.invariant else None
        adrift = everything.adrift
    elif shape.concave.all():
        unique = bounded  # equivalent for concave constraints; see the docstring of this module
    return bounded, unique, [team.ids[i] for i in np.flatnonzero(adrift).tolist()] if bounded is False else []


def with_auxiliary(team: Team, radius: float) -> Team:
    """The team with an auxiliary constraint ψ = radius² − ‖x_i − o‖² for each agent, so that level sets are compact and the optimum unique.

    The centre o is the natural centre of the team; see `consat.problem.units`.

    Args:
        team: the team.
        radius: √c_aux > 0, length. It should be too large to bind; see `binding_auxiliaries`.
    """
    center = scale(team).center
    ball = within(center, radius)
    agents = np.arange(team.count, dtype=np.int32)
    ends = np.cumsum(team.constraints_per_agent)
    moved = [replace(family, number=(family.number + family.owner).astype(np.int32)) for family in team.families]
    added = Family(
        kind=ball.kind, psi=ball.psi, agents=agents[:, None], owner=agents, number=(ends + agents).astype(np.int32),
        parameters={"center": np.tile(center, (team.count, 1)), "radius": np.full(team.count, float(radius))}, weight=np.ones(team.count),
    )  # fmt: skip
    owner = np.insert(team.owner, ends, agents).astype(np.int32)
    names = np.insert(np.array(team.names, dtype=object), ends, AUXILIARY).tolist()
    return team.with_constraints([*moved, added], owner, tuple(names))


def binding_auxiliaries(team: Team, multipliers: Floats, threshold: float = 1e-6) -> list[str]:
    """The ids of agents whose auxiliary constraint binds at the optimum. If there are any, the radius is too small.

    Args:
        team: a team returned by `with_auxiliary`.
        multipliers: (M,) multipliers of its optimum.
        threshold: multipliers up to this count as 0; solvers leave small residues.
    """
    return [team.ids[int(team.owner[k])] for k in np.flatnonzero(multipliers > threshold).tolist() if team.names[k] == AUXILIARY]


def _constraints(team: Team) -> list[dict[str, Any]]:
    shape = shape_of(team)
    reads: list[list[str]] = [[] for _ in team.owner]
    for family in team.families:
        for number, agents in zip(family.number, family.agents, strict=True):
            reads[number] = [team.ids[i] for i in agents]
    return [
        {"agent": team.ids[owner], "name": name, "reads": read, "curvature": str(curvature), "strict_in_own": bool(strict)}
        for owner, name, read, curvature, strict in zip(team.owner, team.names, reads, shape.curvature, shape.strict_in_own, strict=True)
    ]


def _relays(team: Team, cluster: Ints) -> list[dict[str, Any]]:
    """The relays, each with the ids of the agents of the cluster it serves; see `consat.problem.graphs.relays`."""
    return [
        {"agent": team.ids[i], "for": [team.ids[int(k)] for k in np.flatnonzero(cluster == c)]}
        for c, joining in relays(team, cluster).items()
        for i in sorted(joining)
    ]


def _communication(parts: list[list[list[str]]], joining: list[dict[str, Any]]) -> dict[str, Any]:
    passing = "".join(f" {relay['agent']} relays for {{{_few(relay['for'])}}}." for relay in joining[:5])
    if not parts:
        reach = "In every cluster" if joining else "Inside every cluster"
        return _assumption(1, True, f"{reach} each agent can reach every other over links.{passing}")
    shown = " and ".join("{" + _few(part) + "}" for part in parts[0][:4])
    cure = "; ".join(f"add a link such as [{broken[0][0]}, {broken[1][0]}]" for broken in parts[:5])
    return _assumption(1, False, f"The constraints tie {shown} together, but no path of links joins them.", cure)


def _one_cluster(count: int) -> dict[str, Any]:
    if count == 1:
        return _assumption(2, True, "All agents depend on each other, directly or through others: one cluster.")
    return _assumption(2, False, f"There are {count} clusters that do not depend on each other; each is solved for itself.")


def _compact(team: Team, bounded: bool | None, adrift: list[str]) -> dict[str, Any]:
    if bounded:
        return _assumption(3, True, "Level sets are compact: no agent can move off for ever without some constraint suffering.")
    far = 100 * (scale(team).length + scale(team).spread)
    cure = f"keep every agent in a large ball with --auxiliary RADIUS, e.g. --auxiliary {far:.3g}"
    if bounded is None:
        return _assumption(3, None, "It cannot be proven that level sets are compact.", cure)
    return _assumption(
        3, False, f"Level sets are not compact: {_few(adrift)} can move off for ever without any constraint suffering.", cure
    )


def _assumption(number: int, holds: bool | None, what: str, cure: str | None = None) -> dict[str, Any]:
    return {"number": number, "holds": holds, "what": what, "cure": cure}


def _few(ids: list[str]) -> str:
    return ", ".join(ids[:5]) + (f", … ({len(ids)} agents)" if len(ids) > 5 else "")

"""Changes of a state between two rounds: its transfer to a team of another structure, after agents, constraints or links were added or
removed, and bodies that are put elsewhere.

Every array of the state has one row for each copy, constraint, neighbour, end of a link, or agent. A row whose name existed before keeps
its values; a new row has the values of an initial state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from consat.engine.bodies import Driven
from consat.engine.round import Now, by_axis
from consat.engine.world import World
from consat.numerics import on_device
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.protocols.interior_point import InteriorState
from consat.protocols.local.interior import Shared

if TYPE_CHECKING:
    from consat.robots.model import Model


@dataclass(frozen=True)
class Names:
    """Names of the rows of a state, which do not depend on their order.

    Attributes:
        row: (C,) for each copy: holder and owner of the position.
        agent: (N,) ids.
        constraint: (M,) for each constraint, family after family: owner and name.
        link: (E,) for each end of a link: the copy, and the agent at the other end.
        pair: (P,) for each directed pair of neighbours: both agents, and the variables that they share.
    """

    row: Sequence[Any]
    agent: Sequence[Any]
    constraint: Sequence[Any]
    link: Sequence[Any]
    pair: Sequence[Any]

    @classmethod
    def of(cls, team: Team, copies: Estimates, *, pairs: bool) -> Names:
        """Names for a team and its layout of copies. `pairs`: whether the protocol sends one message per pair of neighbours."""
        ids = list(team.ids)
        row = [(ids[i], ids[j]) for i, j in zip(copies.holder.tolist(), copies.position.tolist(), strict=True)]
        numbers = [int(k) for family in team.families for k in family.number]
        owner = team.owner.tolist()
        constraint = [(ids[owner[k]], team.names[k]) for k in numbers]
        receiver, sender, block = copies.ends()
        here, there = ((ends.astype(np.int64)[:, None] * block + np.arange(block)).ravel().tolist() for ends in (receiver, sender))
        link = [(row[a], row[b][0]) for a, b in zip(here, there, strict=True)]
        return cls(row, ids, constraint, link, _pairs(ids, copies) if pairs else [])


def _pairs(ids: Sequence[str], copies: Estimates) -> list[Any]:
    shared = Shared.of(copies)
    travels: list[list[Any]] = [[] for _ in shared.pairs]
    for pair, row in zip(shared.pair.tolist(), shared.row.tolist(), strict=True):
        travels[pair].append(None if row < 0 else ids[copies.position[row]])
    return [(ids[a], ids[b], tuple(what)) for (a, b), what in zip(shared.pairs.tolist(), travels, strict=True)]


def carried(per: Mapping[str, Any], old: Any, new: Any, before: Names, after: Names) -> Any:
    """The new state, with the rows of the old state whose names occur in both.

    Args:
        per: leading axis of each field; see `consat.protocols.Rounds.per`.
        old: state of the protocol before the change.
        new: initial state of the protocol after the change.
        before: names of the rows of `old`.
        after: names of the rows of `new`.
    """
    places = {kind: _places(getattr(before, kind), getattr(after, kind)) for kind in ("row", "agent", "constraint", "link", "pair")}
    return by_axis(per, lambda axis, there, here: _merged(here, there, places[axis]), new, old)


def _places(before: Sequence[Any], after: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Indices in `before` and in `after` of the names that occur in both."""
    known = {name: k for k, name in enumerate(before)}
    both = [(known[name], k) for k, name in enumerate(after) if name in known]
    here, there = np.array(both, dtype=np.int64).reshape(-1, 2).T
    return here, there


def _merged(old: Any, new: Any, places: tuple[np.ndarray, np.ndarray]) -> Any:
    """The new array, with rows of the old one at `places`; where the rows have different shapes, the common part is copied."""
    here, there = places
    kept, merged = np.asarray(old)[here], np.array(new)
    fits: Any = tuple(slice(min(a, b)) for a, b in zip(kept.shape[1:], merged.shape[1:], strict=True))
    merged[(there, *fits)] = kept[(slice(None), *fits)]
    return jnp.asarray(merged)


def robots_carried(model: Model[Any], old: Driven, new: Driven, before: Sequence[str], after: Sequence[str]) -> Driven:
    """Transfer the state of the robots to a team with other members. Remaining robots keep their state, and the report is continued.

    Args:
        model: model of the new robots.
        old: the robots before the change.
        new: initial state of the robots after the change.
        before: ids of the old robots.
        after: ids of the new robots.
    """
    from consat.robots import Fleet, Simulated

    report = new.memory.report._replace(
        **{name: getattr(old.memory.report, name) for name in old.memory.report._fields if name != "halted"}
    )
    state = new.state
    mixed = isinstance(model.reference if isinstance(model, Simulated) else model, Fleet)
    if not mixed and str(jax.tree.structure(old.state)) == str(jax.tree.structure(new.state)):
        places = _places(before, after)
        state = jax.tree.map(lambda a, b: _merged(a, b, places), old.state, new.state)
    return new._replace(state=state, memory=new.memory._replace(report=report))


def robot_placed(model: Model[Any], state: Any, i: int, place: np.ndarray) -> Any:
    """The state of the robots with robot `i` at rest at ``place[i]``. `place`: (N, d) positions."""
    from consat.robots import Fleet, Simulated

    if isinstance(model, Simulated):
        bodies = _row_taken(state.bodies, model.start(jnp.asarray(place)).bodies, i)
        return state._replace(reference=robot_placed(model.reference, state.reference, i, place), bodies=bodies)
    if isinstance(model, Fleet):
        kind = int(model.kinds[i])
        rows = model.members[kind]
        own = robot_placed(model.models[kind], state[kind], int(np.searchsorted(rows, i)), place[rows])
        return (*state[:kind], own, *state[kind + 1 :])
    return _row_taken(state, model.start(jnp.asarray(place)), i)


def _row_taken(state: Any, fresh: Any, i: int) -> Any:
    return jax.tree.map(lambda a, b: jnp.asarray(a).at[i].set(jnp.asarray(b)[i]), state, fresh)


@jax.jit
def _body_moved(body: Any, x: Any, row: Any, i: Any, value: Any) -> tuple[Any, Any]:
    return body.at[i].set(value), x.at[row].set(value)


def placed(now: Now, world: World, i: int, value: np.ndarray, *, own: bool) -> Now:
    """Copy of the state with the body of agent `i` at `value`, (d,). `own`: whether the agent's own estimate is set, too."""
    row = world.own[i]
    body, x = _body_moved(now.body, now.state.x, row, on_device(i), on_device(value))
    state = now.state
    if own:
        state = state._replace(memory=state.memory._replace(y=x)) if isinstance(state, InteriorState) else state._replace(x=x)
    heard = now.heard
    if heard is not None:
        heard = heard._replace(position=heard.position.at[row].set(on_device(value)))
    robots = now.robots
    if robots is not None and world.drive is not None:
        robots = robots._replace(state=robot_placed(world.drive.model, robots.state, i, np.asarray(body)))
    return now._replace(state=state, body=body, heard=heard, robots=robots)

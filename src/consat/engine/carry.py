"""What agents remember, carried over to a team of another structure: agents, constraints or links have come or gone.

Everything an agent remembers has one row of something: a copy, a constraint, a neighbour, an end of a link, itself. What was there before
under the same name keeps what is remembered of it; what is new begins as at a start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from consat.engine.round import Driven
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.protocols.local.interior import Shared

if TYPE_CHECKING:
    from consat.robots.model import Model


@dataclass(frozen=True)
class Names:
    """What the rows of everything that agents remember are called, whatever their order.

    Attributes:
        row: (C,) of each copy: its holder and whose position it is.
        agent: (N,).
        constraint: (M,) family after family: owner and name.
        link: (E,) of each end: the copy, and who is at the other end.
        pair: (P,) of each neighbour: both, and what they share.
    """

    row: Sequence[Any]
    agent: Sequence[Any]
    constraint: Sequence[Any]
    link: Sequence[Any]
    pair: Sequence[Any]

    @classmethod
    def of(cls, team: Team, copies: Estimates, *, pairs: bool) -> Names:
        """Of a team whose copies are laid out; pairs: whether its protocol speaks to neighbours as a whole."""
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
    """The new state, with what the old one remembers of whatever is in both.

    Args:
        per: what each field has one of; see `consat.protocols.Rounds`.
        old: the state of the protocol before.
        new: a state to begin with after.
        before: the names of its rows before.
        after: likewise after.
    """
    places = {kind: _places(getattr(before, kind), getattr(after, kind)) for kind in ("row", "agent", "constraint", "link", "pair")}

    def choose(per: str | Mapping[str, Any], here: Any, there: Any) -> Any:
        if isinstance(per, str):
            return jax.tree.map(lambda a, b: _merged(a, b, places[per]), here, there)
        return type(there)(**{name: choose(kind, getattr(here, name), getattr(there, name)) for name, kind in per.items()})

    return choose(per, old, new)


def _places(before: Sequence[Any], after: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Where in `before` and where in `after` what is in both stands."""
    known = {name: k for k, name in enumerate(before)}
    both = [(known[name], k) for k, name in enumerate(after) if name in known]
    here, there = np.array(both, dtype=np.int64).reshape(-1, 2).T
    return here, there


def _merged(old: Any, new: Any, places: tuple[np.ndarray, np.ndarray]) -> Any:
    """The new rows, with the old ones where they were; of wider ones what fits."""
    here, there = places
    kept, merged = np.asarray(old)[here], np.array(new)
    fits: Any = tuple(slice(min(a, b)) for a, b in zip(kept.shape[1:], merged.shape[1:], strict=True))
    merged[(there, *fits)] = kept[(slice(None), *fits)]
    return jnp.asarray(merged)


def robots_carried(model: Model[Any], old: Driven, new: Driven, before: Sequence[str], after: Sequence[str]) -> Driven:
    """Robots of a team of other members: those who stay go on as they were, and what came of it so far stays."""
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
    """The state of robots of which one, i, is now at rest at its place among (N, d)."""
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

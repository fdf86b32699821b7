"""Local part of the interior-point protocol: the Newton step of an agent, its messages, and the bound that it proves.

`layout` defines the variables of an agent and the shared ones, and sorts agents into batches; `lanes` evaluates their constraints; `state`
is what an agent keeps, and how it begins; `step` computes a round; `proof` is the bound that the agents prove together.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import on_device, pick, taken
from consat.problem.team import Team
from consat.problem.units import Scale
from consat.protocols.estimates import Estimates
from consat.protocols.local.interior import state, step
from consat.protocols.local.interior.batches import Batch, Plan, plan_of
from consat.protocols.local.interior.lanes import Lanes, Units
from consat.protocols.local.interior.proof import Proof
from consat.protocols.local.interior.routes import Route, Shared, Way, route_of
from consat.protocols.local.interior.state import Gains, Memory
from consat.protocols.local.interior.step import Mail

__all__ = ["Gains", "Interior", "Mail", "Memory", "Proof", "Route", "Shared", "Units", "Way", "route_of"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Interior:
    """Local interior-point step for all agents of a team or for a single agent. P is the number of ends of links (directed pairs).

    Attributes:
        plan: the agents in batches.
        units: units and region of the team; common knowledge.
        talker: (P,) the sending agent at each end of a link.
        other: (P,) index of the other end of the same link; empty for a single agent, whose links end in other processes.
        owner: (M,) the owner of each constraint, family after family.
        degree: (N,) number of neighbours of each agent.
        level: (P,) whether the level, and with it the least margin, is sent over this link.
    """

    plan: Plan
    units: Units
    talker: Array
    other: Array
    owner: Array
    degree: Array
    level: Array

    @classmethod
    def of(cls, team: Team, copies: Estimates, size: Scale) -> Interior:
        """Build for a whole team whose copies were laid out by `route_of`."""
        shared = Shared.of(copies)
        talker, listener = shared.pairs.astype(np.int64).T
        keys = talker * team.count + listener
        owner = np.concatenate([np.zeros(0, dtype=np.int32), *(family.owner for family in team.families)])
        return cls(
            plan_of(team, copies, shared),
            Units.of(size),
            on_device(talker.astype(np.int32)),
            on_device(np.searchsorted(keys, listener * team.count + talker).astype(np.int32)),
            on_device(owner),
            on_device(np.bincount(talker, minlength=team.count)),
            on_device(shared.level),
        )

    @classmethod
    def alone(cls, team: Team, copies: Estimates, shared: Shared, units: Units) -> Interior:
        """Build for a single agent (a team of one), whose links end in other processes."""
        pairs, constraints = len(shared.pairs), sum(family.size for family in team.families)
        talker, nothing = np.zeros(pairs, dtype=np.int32), np.zeros(0, dtype=np.int32)
        owner = np.zeros(constraints, dtype=np.int32)
        arrays = (on_device(each) for each in (talker, nothing, owner, np.array([pairs]), shared.level))
        return cls(plan_of(team, copies, shared), units, *arrays)

    def silence(self) -> Mail:
        """Mail before any message was received; leading axis P."""
        p, pairs = self.plan.width, len(self.talker)
        matrix, vector, number = jnp.zeros((pairs, p, p)), jnp.zeros((pairs, p)), jnp.zeros(pairs)
        return Mail(matrix, vector, number - 1.0, number, number - jnp.inf, number, Proof(matrix, vector, number, number - 1.0, number))

    def across(self, mail: Mail) -> Mail:
        """The mail at the other end of each link; leading axis P."""
        return jax.tree.map(lambda leaf: pick(leaf, self.other), mail)

    def begin(self, x: Array, gains: Gains) -> Memory:
        """Initial state for the initial estimates `x`, (C, d)."""

        def start(batch: Batch) -> Memory:
            y = jnp.moveaxis(taken(_normal(x, self.units), batch.rows, 0.0), 1, -1)
            return _out(state.begin(_lanes(batch, self.units, gains, self.plan.exact), y, gains))

        return self._collected([start(batch) for batch in self.plan.batches])

    def round(self, memory: Memory, inbox: Mail, margin: Array, gains: Gains) -> tuple[Memory, Mail]:
        """Compute one round. Returns the new state and the mail to send over each end of a link.

        Args:
            memory: state before the round.
            inbox: the mail last received over each end of a link.
            margin: (N,) ᾱ_i at the positions of the bodies.
            gains: gains of the protocol.
        """
        units, pairs, inbox = self.units, len(self.talker), self._counted(inbox)
        y, body_margin = _normal(memory.y, units), margin / units.psi

        def turn(batch: Batch) -> tuple[Memory, Mail]:
            agents, rows, ends, shared = batch.agents, batch.rows, batch.pairs, batch.shared
            multiplier = taken(memory.multiplier, batch.members, 0.0)
            copies, drift = (jnp.moveaxis(taken(each, rows, 0.0), 1, -1) for each in (y, memory.drift))
            mine = Memory(copies, drift, multiplier, *(leaf[agents] for leaf in memory[3:]))
            p = shared.shape[1]

            def at(values: Array, empty: float = 0.0) -> Array:
                found = jnp.moveaxis(taken(values, ends, empty), 1, -1) if pairs else jnp.zeros((0, *values.shape[1:], len(agents)))
                return found[(slice(None), *[slice(p)] * (values.ndim - 1))]

            heard = Mail(
                at(inbox.matrix), at(inbox.vector), at(inbox.barrier, -1.0), at(inbox.level), at(inbox.margin, jnp.inf), at(inbox.changes),
                Proof(*map(at, inbox.proof)),
            )  # fmt: skip
            lanes = _lanes(batch, units, gains, self.plan.exact)
            found, mail = step.act(lanes, shared, rows < len(y), mine, heard, body_margin=body_margin[agents], gains=gains)
            return _out(found), jax.tree.map(lambda leaf: _widened(leaf, self.plan.width), mail)

        found = [turn(batch) for batch in self.plan.batches]
        mail = jax.tree.map(lambda *leaves: pick(jnp.concatenate(leaves), self.plan.pair), *[each[1] for each in found])
        return self._collected([each[0] for each in found]), mail

    def least(self, inbox: Mail, margin: Array) -> Array:
        """(N,) the smallest margin of the team that each agent knows of. `margin`: (N,) its own."""
        theirs = self._counted(inbox).margin * self.units.psi
        return jnp.minimum(margin, jax.ops.segment_min(theirs, self.talker, len(margin), indices_are_sorted=True))

    def _counted(self, inbox: Mail) -> Mail:
        """Keep only the margins received along the spanning tree: around a loop an outdated margin would circulate for ever."""
        return inbox._replace(margin=jnp.where(self.level, inbox.margin, jnp.inf))

    def _collected(self, found: list[Memory]) -> Memory:
        """Gather the results of all batches in the order of the team."""
        plan = self.plan
        whole = Memory(*(jnp.concatenate(leaves) for leaves in zip(*found, strict=True)))
        agents = {name: pick(getattr(whole, name), plan.agent) for name in Memory._fields if name not in ("y", "drift", "multiplier")}
        x = self.units.center[None] + self.units.length * pick(whole.y, plan.row)
        multiplier = pick(whole.multiplier, plan.member) if len(whole.multiplier) else jnp.zeros(0)
        return Memory(y=x, drift=pick(whole.drift, plan.row), multiplier=multiplier, **agents)


def _normal(x: Array, units: Units) -> Array:
    return (x - units.center[None]) / units.length


def _lanes(batch: Batch, units: Units, gains: Gains, exact: bool) -> Lanes:
    n, count = batch.rows.shape
    return Lanes(batch, units, gains.cap, (n, len(units.center), count), exact)


def _out(memory: Memory) -> Memory:
    """Flatten the arrays of a batch: y and drift to (n·A, d), multiplier to (m·A,); per-agent arrays stay (A,)."""
    y, drift = (jnp.moveaxis(each, -1, 1).reshape(-1, each.shape[1]) for each in (memory.y, memory.drift))
    return memory._replace(y=y, drift=drift, multiplier=memory.multiplier.reshape(-1))


def _widened(leaf: Array, width: int) -> Array:
    """(g, p, …, A) → (g·A, width, …), padded with zeros."""
    leaf = jnp.moveaxis(leaf, -1, 1)
    leaf = leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])
    return jnp.pad(leaf, [(0, 0), *[(0, width - size) for size in leaf.shape[1:]]])

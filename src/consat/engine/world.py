"""Data of a run in rounds that is constant: all agents with their constraints, the ends of their links, and the faults, on the device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.engine.bodies import Body
from consat.engine.live import Live
from consat.faults import Faults
from consat.numerics import Groups, distinct, on_device, pick
from consat.problem.graphs import hops
from consat.problem.objective import Nu, Objective
from consat.problem.team import Team
from consat.problem.units import Region, Scale
from consat.protocols import agreement
from consat.protocols.estimates import Estimates
from consat.protocols.local import proximal as prox
from consat.protocols.local.interior import Interior
from consat.protocols.solver import EXACT, LocalSolver

if TYPE_CHECKING:
    from consat.robots.drive import Drive

QUICK = prox.Precision(tolerance=None)
"""Precision of the local steps of a large team. Exact steps would cost more and save no rounds. Each step starts at the solution of the
last one, so that the steps become exact as the team converges."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ends:
    """`consat.protocols.Links` of all agents: both ends of every link of every copy.

    Attributes:
        other: (B,) index of the other end of the same link, in blocks of copies; see `consat.protocols.estimates.Estimates.ends`.
        groups: groups the ends by copy, in blocks.
        degree: (C,) number of links that share each copy.
        metropolis: (E,) Metropolis weights.
        block: number of copies in a block.
    """

    other: Array
    groups: Groups
    degree: Array
    metropolis: Array
    block: int = field(metadata={"static": True})

    @classmethod
    def of(cls, receiver: np.ndarray, sender: np.ndarray, block: int, copies: int) -> Ends:
        """Build from the ends of `consat.protocols.estimates.Estimates.ends`. `copies`: C."""
        here, there, count = receiver.astype(np.int64), sender.astype(np.int64), copies // block
        other = np.searchsorted(here * count + there, there * count + here)
        degree = np.bincount(receiver, minlength=count)
        metropolis = 1.0 / (1.0 + np.maximum(degree[receiver], degree[sender]))
        return cls(
            on_device(other.astype(np.int32)),
            Groups.of(receiver, count),
            on_device(np.repeat(degree.astype(float), block)),
            on_device(np.repeat(metropolis, block)),
            block,
        )

    def __len__(self) -> int:
        return len(self.metropolis)

    def at(self, rows: Array) -> Array:
        return self._in_blocks(self.groups.spread, rows)

    def sum(self, links: Array) -> Array:
        return self._in_blocks(self.groups.sum, links)

    def least(self, links: Array) -> Array:
        return -self._in_blocks(self.groups.max, -links)

    def across(self, links: Array) -> Array:
        """(E, …) → (E, …): the value at the other end of each link."""
        return self._in_blocks(lambda blocks: pick(blocks, self.other), links)

    def _in_blocks(self, function: Callable[[Array], Array], values: Array) -> Array:
        if self.block == 1:
            return function(values)
        found = function(values.reshape(-1, self.block, *values.shape[1:]))
        return found.reshape(-1, *found.shape[2:])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Everyone(LocalSolver):
    """Solver of all agents.

    Attributes:
        links: all ends of links.
        agents: N.
    """

    links: Ends
    agents: int = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Part:
    """Place of a process's agents in the whole team. Its own agents come first, then their neighbours in other processes.

    Attributes:
        agent: (n,) index of each agent in the team.
        pair: index of each directed pair in the team.
        ours: (n,) whether the agent belongs to this process.
        agents: N of the team.
        pairs: number of directed pairs of the team.
    """

    agent: Array
    pair: Array
    ours: Array
    agents: int = field(metadata={"static": True})
    pairs: int = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class World:
    """Constant data of a run.

    Attributes:
        everyone: the agents.
        observer: the objective at the positions of the bodies.
        own: (N,) rows of own positions.
        talker: (E,) the agent at each end of a link.
        pair: (E,) the directed pair of agents of each end; a message to a neighbour carries all copies of a pair.
        reach: () largest distance that a body moves in a round; None without a limit.
        owners: see `consat.protocols.agreement`; None where bodies are at the estimates, and agents use these.
        loss: see `consat.faults.Faults`.
        sleep: see `consat.faults.Faults`.
        pairs: number of directed pairs.
        rough: whether messages can be lost or agents sleep.
        part: place in the whole team, for one process of several.
        live: constraint parameters that change; None if all are constant.
        wind: (d,) velocity of the air, m/s; None without wind.
        noise: () largest error of a measured position, m; None for exact measurements.
        burst: (2,) see `consat.faults.Faults`; None without bursts.
        drive: the robots; None for bodies that follow the estimates.
        events: whether agents send only what is new; see `consat.protocols.sending`.
    """

    everyone: Everyone
    observer: Objective
    own: Array
    talker: Array
    pair: Array
    reach: Array | None
    owners: agreement.Owners | None
    loss: Array
    sleep: Array
    pairs: int = field(metadata={"static": True})
    rough: bool = field(metadata={"static": True})
    part: Part | None = None
    live: Live | None = None
    wind: Array | None = None
    noise: Array | None = None
    burst: Array | None = None
    drive: Drive | None = field(default=None, metadata={"static": True})
    events: bool = field(default=False, metadata={"static": True})

    def at(self, round_: Array) -> World:
        """The same data with the constraints after `round_` rounds."""
        if self.live is None:
            return self
        values = self.live.at(round_)
        return replace(self, everyone=self.everyone.with_parameters(values), observer=self.observer.with_parameters(values))


def precision_for(count: int) -> prox.Precision:
    """Precision of the local steps of a team of `count` agents."""
    return EXACT if count <= prox.SMALL_TEAM else QUICK


def world_of(
    team: Team,
    copies: Estimates,
    nu: Nu,
    size: Scale,
    *,
    convex: bool,
    faults: Faults,
    body: Body | None,
    speaks: str = "link",
    partial: bool = False,
    live: Live | None = None,
    events: bool = False,
) -> World:
    """Put the constant data of a run on the device.

    Args:
        team: the team.
        copies: the layout of estimates.
        nu: the smoothing.
        size: the natural scale of the team.
        convex: whether every ψ is known to be concave.
        faults: loss and sleep.
        body: motion of the bodies; None if they are at the estimates.
        speaks: see `consat.protocols.Rounds.speaks`.
        partial: whether the data is that of one process of several, which must know whose messages it counts.
        live: constraint parameters that change.
        events: whether agents send only what is new.
    """
    receiver, sender, block = copies.ends()
    talker, listener = (np.repeat(copies.holder[rows * block], block) for rows in (receiver, sender))
    everyone = Everyone(
        links=Ends.of(receiver, sender, block, copies.count),
        length=on_device(size.length),
        region=Region.of(size),
        plan=prox.buckets(team, copies.rows, copies.count, convex, live=live is not None) if speaks == "link" else None,
        interior=Interior.of(team, copies, size) if speaks == "pair" else None,
        nu=Nu(on_device(nu.alpha), on_device(nu.beta)),
        local=Objective.of(team, lambda family: copies.rows(family.owner[:, None], family.agents), copies.count),
        holder=on_device(copies.holder),
        own=on_device(copies.own),
        talkers=Groups.of(talker, team.count),
        agents=team.count,
        hops=hops(team.count, copies.links),
        convex=convex,
        precision=precision_for(team.count),
    )
    rough = faults.loss > 0 or faults.sleep > 0 or faults.burst is not None
    keys = talker.astype(np.int64) * team.count + listener
    pairs = distinct(keys)
    if not (rough or partial or events):  # `talker` and `pair` are not used
        talker, keys = talker[:0], keys[:0]
    reach = None if body is None else body.reach
    return World(
        everyone=everyone,
        observer=Objective.at_positions(team),
        own=on_device(copies.own),
        talker=on_device(talker),
        pair=on_device(np.searchsorted(pairs, keys).astype(np.int32)),
        reach=None if reach is None else on_device(reach),
        owners=None if reach is None and speaks == "link" else _owners(copies, receiver, sender, block),
        loss=on_device(faults.loss),
        sleep=on_device(faults.sleep),
        pairs=len(pairs),
        rough=rough,
        live=live,
        wind=jnp.asarray(body.wind, dtype=float) if body is not None and any(body.wind) else None,
        burst=None if faults.burst is None else jnp.asarray(faults.burst, dtype=float),
        noise=on_device(body.noise) if body is not None and body.noise > 0 else None,
        drive=None if body is None else body.drive,
        events=events,
    )


def _owners(copies: Estimates, receiver: np.ndarray, sender: np.ndarray, block: int) -> agreement.Owners:
    row, other = ((ends.astype(np.int64)[:, None] * block + np.arange(block)).ravel() for ends in (receiver, sender))
    return agreement.Owners.of(copies.own, row, copies.holder[other] == copies.position[other], copies.count)

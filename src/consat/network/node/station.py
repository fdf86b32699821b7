"""The base of a node in every mode of communication: the agent's core, neighbours, membership, body and log."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import Any, Final, Literal

import numpy as np

from consat.errors import Fault, InvalidTeam
from consat.network.node import guard
from consat.network.node.body import Body
from consat.network.node.codec import Codec
from consat.network.node.core import Moment, Rows
from consat.network.node.embodied import AgentView, Embodied
from consat.network.node.membership import Membership
from consat.network.node.modes import NodeSettings
from consat.network.node.neighbours import Peers
from consat.network.node.news import NewsFilter
from consat.network.node.part import Part
from consat.network.transports import Transport
from consat.network.wire import VERSION, Kind, Message, Reason
from consat.numerics import float64, number
from consat.problem.changes import adjusted, changed, changes_of, is_adjustment
from consat.problem.schedule import Schedule

SILENT: Final = 0.5
"""Time without a message, s, after which a neighbour counts as down."""

Knowledge = Literal["satisfied", "infeasible"] | None
"""What an agent knows about the whole team: all are satisfied; proven infeasible; or neither (None)."""
Log = Callable[[dict[str, Any]], None]


class Station:
    """One agent on the network, in any mode.

    Args:
        part: the agent's part.
        core: the protocol compiled for the agent.
        settings: settings of the agent; messages of agents with another mode are refused.
        transport: transport of the messages.
        clock: the agent's clock, s.
        incarnation: a number that is larger after each restart of the agent.
        body: sensor and actuator.
        log: function that takes events (JSON-serialisable data).
        wall: Unix time, s, which the agents of a team share.
    """

    def __init__(
        self,
        part: Part,
        core: Embodied,
        settings: NodeSettings,
        transport: Transport,
        *,
        clock: Callable[[], float],
        incarnation: int,
        body: Body,
        log: Log,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.part, self.settings, self.body, self.clock = part, settings, body, clock
        self.membership = Membership(part)
        self._use(core)
        expected = {neighbour.id: self.codec.expected(neighbour) for neighbour in part.neighbours}
        self.peers = Peers(part, part.problem(settings.mode, settings.sends), expected, transport, clock, incarnation)
        self._transport, self._log, self._period = transport, log, settings.report
        self.epoch, self._wall = part.epoch, wall
        self._time, self._restarts = 0.0, 0
        self._strange = False
        self._born = clock()
        self._track: list[list[float]] = []
        self.known: Knowledge = None
        """What the agent knows about the team."""
        self._near = False
        self._down = frozenset(self.peers.all)
        self._next_report = clock()
        self._gone: frozenset[str] = frozenset()
        self._view: AgentView | None = None
        self.target: np.ndarray | None = None
        """(d,) target of the body; None before the first step."""
        self.regroup(None)

    def _use(self, core: Embodied) -> None:
        """Make this the core of the agent."""
        self.core, self.codec = core, Codec(self.part, core, self.membership, self.settings)
        self._filter = None if self.settings.beat is None else NewsFilter(core, self.settings.beat)

    # -- membership --------------------------------------------------------------------------------------------------------------------

    @property
    def present(self) -> list[str]:
        """Ids of the neighbours that are present."""
        return [neighbour.id for neighbour in self.core.part.neighbours]

    def regroup(self, state: Any) -> Any:
        """Rebuild the core for the agents that are present, and transfer the state to it. Nothing changes if the membership is the same.
        `state`: the present state; None before the start."""
        gone = self.membership.gone
        if gone != self._gone:
            for event, agents in (("left", gone - self._gone), ("joined", self._gone - gone)):
                if state is not None and agents:
                    self.log(event, agents=sorted(agents))
            before = self.core
            self._use(before.without(gone))
            self._gone, self._view = gone, None
            if state is not None:
                state = self.core.carry(before, state, self.first(), self._time)
        return state

    @property
    def changed(self) -> bool:
        """Whether the membership has changed since the last `regroup`."""
        return self.membership.gone != self._gone

    def first(self) -> np.ndarray:
        """(rows, d) initial estimates of the agents that are present, with the measured position for the agent itself."""
        first = self.part.first[[agent not in self._gone for agent in self.part.team.ids]]
        position = self.body.position()
        if position is not None:
            first[self.core.part.own] = position
        return first

    @property
    def estimates(self) -> dict[str, np.ndarray]:
        """The newest estimate, (d,), of each position that the agent holds."""
        return {} if self._view is None else dict(zip(self.core.part.team.ids, self._view.x, strict=True))

    @property
    def settled(self) -> bool:
        """Whether the agent knows a final result: all are satisfied, or the team is infeasible and near its best margin."""
        return self.known == "satisfied" or (self.known == "infeasible" and self._near)

    # -- constraints -------------------------------------------------------------------------------------------------------------------

    @float64
    def change(self, state: Any, constraint: str, parameters: Mapping[str, Any]) -> Any:
        """Change parameters of one of the agent's own constraints, with the checks of a scenario. All proofs become invalid.

        Args:
            state: the present state; None before the start.
            constraint: name of the constraint.
            parameters: new values of its parameters.

        Returns:
            The state for the changed core.

        Raises:
            InvalidTeam: unknown constraint or parameter, or an invalid value; nothing has changed.
        """
        team = self.part.team
        changes = changes_of(team, self.part.me, constraint, parameters)
        if self.epoch is None and any(isinstance(value, Schedule) for change in changes for value in change.given.values()):
            message = "it moves with time, but nobody has said when t = 0 is; start the agent with --epoch"
            raise InvalidTeam([Fault((), message, f"agent {self.part.me!r}, constraint {constraint!r}")])
        before = self.core
        if is_adjustment(team, changes):
            self.part = replace(self.part, team=adjusted(team, changes))
            self.core = before.adjusted(self.part)
            state = state and self.core.without_proofs(state)
        else:
            self.part = replace(self.part, team=changed(team, changes))
            self._use(before.without(self._gone, self.part))
            state = state and self.core.carry(before, state, self.first(), self._time)
        self.log("changed", constraint=constraint, parameters=dict(parameters))
        return state

    def check_restarts(self, state: Any) -> Any:
        """The state, with proofs dropped if a neighbour has restarted since the last call, because its constraints may have changed."""
        before, self._restarts = self._restarts, sum(peer.restarts for peer in self.peers.all.values())
        return state if before == self._restarts else self.core.without_proofs(state)

    # -- messages ----------------------------------------------------------------------------------------------------------------------

    def receive(self) -> list[Message]:
        """The received messages, after an update of the membership with them."""
        messages = self.peers.receive()
        if not self._strange and self.peers.dropped.get(Reason.VERSION):
            self._strange = True
            self.log("refused", why=f"a neighbour speaks another version of the wire format than {VERSION}; update the team as a whole")
        for message in messages:
            if message.kind not in (Kind.GOODBYE, Kind.SAME):
                shares = self.peers.all[message.source].known.shares
                epochs = message.arrays[0] if message.kind is Kind.HELLO else message.arrays[0][:, -1]
                self.membership.update(shares, epochs)
        now = self.clock()
        for neighbour in self.present:
            peer = self.peers.all[neighbour]
            if now - max(peer.heard, self._born) > self.settings.give_up:
                self.membership.drop(neighbour)
        return messages

    def turn(self, state: Any, inbox: Rows, arrived: Rows, moment: Moment) -> tuple[Any, Rows, AgentView]:
        """Compute a step; see `Embodied.turn`. Messages that would make the state NaN or infinite are not used; see `guard`."""
        self._time = moment.time
        done = guard.turn(self.core, state, inbox, arrived, moment)
        for neighbour in done.refused:
            self.log("refused", peer=neighbour)
        if done.restarted:
            self.log("anew")
        return done.state, done.outbox, done.view

    def filter(self, rows: Rows) -> tuple[Rows, AbstractSet[str]]:
        """The rows that the neighbours hold after this step, and the ids of those to which a message must be sent."""
        if self._filter is None:
            return rows, self.peers.all.keys()
        rows, goes = self._filter.filter(rows)
        return rows, self.peers.all.keys() - {self.present[k] for k in np.flatnonzero(~goes)}

    def resume(self, rows: Rows, state: Any) -> None:
        """Continue after a restart. `rows`: the rows that were sent last; `state`: the state at that time."""
        if self._filter is not None:
            self._filter.resume(rows, np.asarray(state.bodies.position))

    def send_same(self, round_: np.ndarray, but: AbstractSet[str]) -> None:
        """Tell all neighbours but those in `but` that a round brought no news. `round_`: (1,) the round."""
        for neighbour in self._listeners():
            if neighbour not in but:
                self.peers.send(neighbour, Kind.SAME, [round_])

    def send_hello(self) -> None:
        """Send a greeting, which contains the membership, to the neighbours."""
        for neighbour in self._listeners():
            self.peers.send(neighbour, Kind.HELLO, [self.membership.of(self.peers.all[neighbour].known.shares)])

    def send(self, arrays: Mapping[str, list[np.ndarray]], to: AbstractSet[str] | None = None) -> None:
        """Send a state message.

        Args:
            arrays: see `Codec.encode`.
            to: ids of the receivers; None for all neighbours.
        """
        for neighbour in self._listeners():
            if to is None or neighbour in to:
                self.peers.send(neighbour, Kind.STATE, arrays[neighbour], self.codec.single(arrays[neighbour]))

    def send_goodbye(self) -> None:
        """Send a goodbye: the process stops. An agent that leaves for good announces that in earlier messages."""
        for neighbour in self._listeners():
            self.peers.send(neighbour, Kind.GOODBYE, [])

    def _listeners(self) -> list[str]:
        """Present neighbours, and absent ones that were heard recently, because they may not know that they count as absent."""
        now = self.clock()
        return [neighbour for neighbour, peer in self.peers.all.items() if neighbour not in self._gone or now - peer.heard < 4 * SILENT]

    # -- time and position -----------------------------------------------------------------------------------------------------------------

    @property
    def timed(self) -> bool:
        """Whether the present constraints are known: they do not move, or the time t = 0 is set."""
        return self.epoch is not None or not self.part.team.moves

    def now(self) -> float:
        """Time since t = 0, s, by the clock that the team shares; 0 if t = 0 is not set."""
        return 0.0 if self.epoch is None else self._wall() - self.epoch

    def delays(self) -> np.ndarray:
        """(E,) half the round-trip time to the neighbour at each end, s; 0 before it is known."""
        return np.array([0.5 * np.nan_to_num(self.peers.all[neighbour].trip) for neighbour, _ in self.core.ends])

    def fresh(self, within: float) -> np.ndarray:
        """(E,) whether a message of the neighbour at each end arrived within the last `within` s."""
        now = self.clock()
        return np.array([now - self.peers.all[neighbour].heard <= within for neighbour, _ in self.core.ends], dtype=bool)

    def place(self) -> np.ndarray:
        """(d,) position of the body; NaN if unknown."""
        position = self.body.position()
        if position is None or not self.body.sensed(self.clock()):
            return np.full(self.part.team.dimension, np.nan)
        return position

    # -- log and reports -------------------------------------------------------------------------------------------------------------------

    def log(self, event: str, **details: Any) -> None:
        """Log one event."""
        self._log({"event": event, "id": self.part.me, "t": self.clock(), **details})

    def move(self, view: AgentView, stamp: float) -> None:
        """Set the body's target to the agent's estimate, record its position, and log what is new.

        Args:
            view: result of the last step.
            stamp: round or time, s, of the recorded position.
        """
        self.target = view.x[self.core.part.own]
        self.body.follow(self.target, self.clock())
        position = self.body.position()
        if position is not None:
            self._track.append([stamp, *position.tolist()])
        self._view = view
        self.conclude(stamp)
        if self._period <= 0:
            self.report()

    def conclude(self, stamp: float, *, lately: bool = True) -> None:
        """Update what the agent knows about the team, and log changes.

        Args:
            stamp: round or time, s, of the event.
            lately: whether the others were heard recently. If not, the agent does not know where they are.
        """
        view, before = self._view, (self.known, self._near)
        self.known, self._near = None, False
        if view is not None and lately and view.known > 0:
            self.known = "satisfied"
        elif view is not None and view.bound < 0:
            self.known, self._near = "infeasible", lately and view.near
        if before != (self.known, self._near):
            if self.known is None:
                self.log("unsatisfied" if before[0] == "satisfied" else "undecided", stamp=stamp)
            elif self.known == "satisfied":
                self.log("satisfied", stamp=stamp)
            elif view is not None:
                self.log("infeasible", stamp=stamp, near=self._near, bound=view.bound, margin=number(view.least))

    def watch(self) -> float:
        """Log which neighbours went down or came up, and a report when one is due. Returns the time of the next report, s."""
        now = self.clock()
        alive = self._transport.alive()
        down = frozenset(
            neighbour
            for neighbour, peer in self.peers.all.items()
            if neighbour not in self._gone and (now - peer.heard > SILENT or neighbour not in alive)
        )
        for neighbour in sorted(down ^ self._down):
            if neighbour not in self._gone:
                self.log("down" if neighbour in down else "up", peer=neighbour)
        self._down = down
        if self._period <= 0:
            return now + SILENT
        if now >= self._next_report:
            self.report()
            self._next_report = max(self._next_report + self._period, now)
        return self._next_report

    def report(self) -> None:
        """Log a report, with the positions of the body since the last report.

        `margin` is the agent's margin at its `position` and the last received positions of the others' bodies; `estimate_margin` is its
        margin at its estimates; `bound` is a proven upper bound on the best margin of the team.
        """
        view, position = self._view, self.body.position()
        margin = estimate_margin = None
        if view is not None:
            estimate_margin = number(self.core.margin(view.x, self._time))
            if view.heard and position is not None:
                bodies = view.bodies.copy()
                bodies[self.core.part.own] = position
                margin = number(self.core.margin(bodies, self._time))
        peers = {}
        for neighbour, peer in self.peers.all.items():
            if neighbour not in self._gone:
                trip = None if np.isnan(peer.trip) else round(peer.trip, 6)
                peers[neighbour] = {
                    "up": neighbour not in self._down, "silent": number(round(self.clock() - peer.heard, 4)),
                    "loss": round(peer.lost, 4), "trip": trip,
                }  # fmt: skip
        self.log(
            "report",
            position=None if position is None else position.tolist(),
            margin=margin,
            estimate_margin=estimate_margin,
            known=None if view is None else view.known,
            bound=None if view is None else number(view.bound),
            track=self._track,
            peers=peers,
            sent=dict(self.peers.sent),
            dropped=self.peers.dropped,
        )
        self._track = []

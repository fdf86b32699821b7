"""Observer of a team of processes: collects the events that the agents log and builds a `Trace` from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import jax
import numpy as np

from consat.engine.live import Live
from consat.engine.violations import shares_of
from consat.network.deploy.commands import Stage
from consat.network.deploy.fleet import Event
from consat.network.node.station import Knowledge
from consat.numerics import on_device
from consat.problem.objective import Nu, Objective
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.results.trace import Ending, Trace, satisfied_from

SAMPLE: Final = 0.05
"""Sampling interval of a trace over time, s."""


@dataclass
class AgentRecord:
    """The events of one agent so far.

    Attributes:
        stamps: rounds or times, s, of the recorded positions.
        places: position of its body, (d,), at each stamp.
        report: its last report; None before the first.
        known: what it knows of the team, see `consat.network.node.station.Knowledge`.
        known_from: stamp from which it knows this, or None.
        settled_from: stamp from which it knows the final outcome, or None; see `consat.network.node.station.Station.settled`.
        finished: whether its last round is over.
        born: time at which its process was ready, by its own clock, s; None before.
        ended: its ``end`` event, or None.
    """

    stamps: list[float] = field(default_factory=list)
    places: list[list[float]] = field(default_factory=list)
    report: Event | None = None
    known: Knowledge = None
    known_from: float | None = None
    settled_from: float | None = None
    finished: bool = False
    born: float | None = None
    ended: Event | None = None
    _sent: Counter[str] = field(default_factory=Counter)
    _before: Counter[str] = field(default_factory=Counter)

    def take(self, event: Event) -> None:
        """Update from an event."""
        match event["event"]:
            case "standby":
                self.born = event["t"]
            case "start":
                self._before, self._sent, self.ended = self._before + self._sent, Counter(), None
                self._learn(None, None, settled=False)
                self.born = event["t"]
            case "report":
                self.report = event
                self._sent = Counter(event["sent"])
                for stamp, *place in event["track"]:
                    self.stamps.append(stamp)
                    self.places.append(place)
            case "satisfied":
                self._learn("satisfied", event["stamp"], settled=True)
            case "infeasible":
                self._learn("infeasible", event["stamp"], settled=event["near"])
            case "unsatisfied" | "undecided":
                self._learn(None, None, settled=False)
            case "finished":
                self.finished = True
            case "end":
                self.ended = event
            case _:
                return

    def lose(self) -> None:
        """Update for the end of its process: what it knew is lost with it."""
        self.born = self.ended = None
        self._learn(None, None, settled=False)

    def _learn(self, known: Knowledge, stamp: float | None, *, settled: bool) -> None:
        if known != self.known:
            self.known, self.known_from = known, stamp
        self.settled_from = stamp if settled else None

    @property
    def sent(self) -> Counter[str]:
        """Numbers of messages and floats sent, including those before restarts."""
        return self._before + self._sent

    def moved(self, since: float) -> float:
        """The largest distance, on any axis, from its current position since the stamp `since`; ∞ if its record starts later."""
        if not self.stamps or self.stamps[0] > since:
            return np.inf
        first = int(np.searchsorted(self.stamps, since))
        places = np.array(self.places[max(first - 1, 0) :])
        return float(np.abs(places - places[-1]).max())


class Observer:
    """Observes a team through the events of its agents.

    Args:
        team: the whole team.
        start: (N, d) start positions of the bodies, length.
        clock: unit of the stamps: ``round`` or ``time``.

    Attributes:
        team: the whole team.
        clock: unit of the stamps.
        present: ids of the agents that are present now.
        origin: stamp of t = 0. None if nothing depends on time; then time is counted from the first stamp.
        records: the events of each agent, by id.
    """

    def __init__(self, team: Team, start: np.ndarray, clock: Literal["round", "time"]) -> None:
        self.team, self.clock, self.present = team, clock, frozenset(team.ids)
        self.origin: float | None = None
        self.records = {agent: AgentRecord() for agent in team.ids}
        self._start = start

    def take(self, events: Sequence[Event]) -> None:
        """Update from events. Events of unknown agents are ignored."""
        for event in events:
            if event.get("id") in self.records:
                self.records[event["id"]].take(event)

    @property
    def present_records(self) -> list[AgentRecord]:
        """The records of the agents that are present."""
        return [record for agent, record in self.records.items() if agent in self.present]

    def all_known(self) -> tuple[Knowledge, float | None]:
        """What all agents know, and the stamp from which they know it; (None, None) if any agent knows nothing.

        Some agents may know that all agents they can hear of are satisfied, while others know that the team is infeasible. Then the result
        is ``infeasible``.
        """
        known = [record.known for record in self.present_records]
        if None in known:
            return None, None
        return "infeasible" if "infeasible" in known else "satisfied", max(record.known_from or 0.0 for record in self.present_records)

    def concluded(self) -> float | None:
        """The stamp from which all agents know the final outcome, or None."""
        since = [record.settled_from for record in self.present_records]
        return None if None in since else max(stamp for stamp in since if stamp is not None)

    @property
    def latest(self) -> float:
        """The stamp up to which the positions of all agents are known; −∞ while one is unknown."""
        return min(record.stamps[-1] if record.stamps else -np.inf for record in self.present_records)

    def settled(self, window: float, distance: float) -> bool:
        """Whether the team has converged: all agents hear all their neighbours, and none has moved.

        Args:
            window: length of the time to look back, in units of stamps.
            distance: motion up to this on each axis counts as none, length.
        """
        if any(record.report is None or not all(peer["up"] for peer in record.report["peers"].values()) for record in self.present_records):
            return False
        return all(record.moved(self.latest - window) <= distance for record in self.present_records)

    def positions(self) -> np.ndarray:
        """(N, d) current positions of the bodies, length."""
        return np.array(
            [record.places[-1] if record.places else start for record, start in zip(self.records.values(), self._start, strict=True)]
        )

    def network(self) -> dict[str, Any]:
        """Network measurements of the agents, for the summary: loss, round-trip time (s), messages, CPU time (s)."""
        links, agents = [], {}
        for agent, record in self.records.items():
            report = record.report or {}
            links += list(report.get("peers", {}).values())
            cpu = None if record.ended is None else record.ended.get("cpu")
            agents[agent] = {"sent": dict(record.sent), "dropped": report.get("dropped", {}), "cpu": cpu}
        trips = [link["trip"] for link in links if link["trip"] is not None]
        return {
            "loss": float(np.mean([link["loss"] for link in links])) if links else None,
            "round_trip": float(np.median(trips)) if trips else None,
            "known_from": self._known_from(),
            "agents": agents,
        }

    def trace(
        self, copies: Estimates, nu: Nu, ending: Ending, seconds: Mapping[str, float], stages: Sequence[Stage], tick: float
    ) -> Trace:  # fmt: skip
        """The trace of the agents that are present at the end. It begins at the start positions; a position holds until the next stamp.

        Args:
            copies: the estimates at the end: holders and positions held.
            nu: smoothing of the margin.
            ending: why the run ended.
            seconds: wall-clock times of compilation and run, s.
            stages: states of the team, in order of time.
            tick: duration of a round, s.
        """
        begin = self._begin()
        end = max([begin, *(record.stamps[-1] for record in self.records.values() if record.stamps)])
        if self.clock == "round":
            stamps = steps = np.arange(int(end) + 1, dtype=float)
        else:
            stamps = np.append(np.arange(begin, end, SAMPLE), end)
            steps = stamps - begin
        position = np.stack(
            [self._along(record, row, stamps) for record, row in zip(self.records.values(), self._start, strict=True)], axis=1
        )
        if len(stamps) > 1:
            position[0] = self._start  # the first stamp is that of a step, after which the body may be elsewhere
        dt = tick if self.clock == "round" else SAMPLE
        times = steps * (tick if self.clock == "round" else 1.0)
        margins, smooth = _margins(stages, position, times, nu)
        final, there = stages[-1].present_team()
        sent = sum((record.sent for record in self.records.values()), Counter[str]())
        still = len(stages) == 1 and not final.moves
        margin, position = margins.min(axis=1), position[:, there]
        return Trace(
            clock=self.clock,
            steps=steps if self.clock == "time" else steps.astype(int),
            position=position,
            velocity=np.diff(position, axis=0, append=position[-1:]) / dt,
            margin=margin,
            smooth_margin=smooth,
            agent_margin=margins[:, there],
            estimate=None,
            integral=None,
            holder=copies.holder,
            held=copies.position,
            cluster=copies.cluster,
            ending=ending,
            satisfied_from=satisfied_from(steps, margin, interpolate=False),
            messages=sent["messages"],
            floats_sent=sent["floats"],
            bytes=sent["bytes"],
            known=self.all_known()[0],
            known_from=self._known_from(),
            seconds=seconds,
            period=tick if self.clock == "round" and final.moves else None,
            violated=shares_of(final, position) if still else None,
            motion=None if still else _motion(times, margin),
        )

    def _known_from(self) -> float | None:
        """The round from which all agents know the outcome, or the time, s, since `_begin`; None if they do not."""
        since = self.all_known()[1]
        if since is None:
            return None
        return int(since) if self.clock == "round" else since - self._begin()

    def _begin(self) -> float:
        """The stamp from which time is counted."""
        if self.origin is not None:
            return self.origin
        return min((record.stamps[0] for record in self.records.values() if record.stamps), default=0.0)

    def _along(self, record: AgentRecord, start: np.ndarray, stamps: np.ndarray) -> np.ndarray:
        order = np.argsort(record.stamps, kind="stable")
        known = np.array(record.stamps, dtype=float)[order]
        places = np.concatenate([start[None], np.array(record.places, dtype=float).reshape(-1, len(start))[order]])
        return places[np.searchsorted(known, stamps, side="right")]


def _margins(stages: Sequence[Stage], position: np.ndarray, times: np.ndarray, nu: Nu) -> tuple[np.ndarray, np.ndarray]:
    """Margins by the constraints that were valid at each time.

    Args:
        stages: states of the team, in order of time.
        position: (T, N, d) positions.
        times: (T,) s.
        nu: smoothing.

    Returns:
        (T, N) ᾱ_i, +∞ for absent agents; and (T,) β.
    """
    margins, smooth = np.full(position.shape[:2], np.inf), np.zeros(len(times))
    which = np.searchsorted([stage.since for stage in stages], times, side="right") - 1
    for k in np.unique(which):
        rows = which == k
        team, there = stages[k].present_team()
        live = Live.of(team, 1.0, all_of_them=False)
        found = _margins_at(Objective.at_positions(team), live, on_device(position[:, there]), on_device(times), nu)
        margins[np.ix_(rows, there)], smooth[rows] = (np.asarray(each)[rows] for each in found)
    return margins, smooth


@jax.jit
def _margins_at(observer: Objective, live: Live | None, position: jax.Array, times: jax.Array, nu: Nu) -> tuple[jax.Array, jax.Array]:
    """(T, N) ᾱ_i and (T,) β, compiled as one program. `live` gives the moving parameters; None if nothing moves."""

    def at(x: jax.Array, time: jax.Array) -> tuple[jax.Array, jax.Array]:
        here = observer if live is None else observer.with_parameters(live.at(time))
        return here.agent_margins(x), here.smooth_margin(x, nu)

    return jax.vmap(at)(position, times)


def _motion(times: np.ndarray, margin: np.ndarray) -> dict[str, Any]:
    """The entry ``motion`` of the summary, for a team that moves or is changed, from (T,) times, s, and (T,) margins."""
    good = margin > 0
    first = int(np.argmax(good)) if good.any() else None
    return {
        "duration": float(times[-1] - times[0]),
        "satisfied_share": float(good.mean()),
        "satisfied_share_after": None if first is None else float(good[first:].mean()),
        "worst_margin_after": None if first is None else float(margin[first:].min()),
    }

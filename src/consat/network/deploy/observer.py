"""What an observer of a team of processes learns from their logs, and the `Trace` that it makes of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from consat.engine.violations import shares_of
from consat.network.deploy.fleet import Event
from consat.network.node.station import Knowledge
from consat.problem.objective import Nu, Objective
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.results.trace import Ending, Trace, satisfied_from

SAMPLE: Final = 0.05
"""Time between two samples of a trace in time, s."""


@dataclass
class Seen:
    """What one agent has told.

    Attributes:
        stamps: rounds or times.
        places: (d,) where its body was at each.
        report: the last one.
        known: what it knows of the team, see `consat.network.node.station.Knowledge`.
        known_from: since which stamp, or None.
        settled_from: since which stamp it knows all that there is to find, or None; see `consat.network.node.station.Station.settled`.
        finished: whether its last round is over.
        born: when its process was ready, by its clock.
        ended: its last event, if it came.
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
        """Learn from an event."""
        match event["event"]:
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

    def _learn(self, known: Knowledge, stamp: float | None, *, settled: bool) -> None:
        if known != self.known:
            self.known, self.known_from = known, stamp
        self.settled_from = stamp if settled else None

    @property
    def sent(self) -> Counter[str]:
        """In all lives."""
        return self._before + self._sent

    def moved(self, since: float) -> float:
        """How far it was, at most, from where it is, on any axis, since a stamp; ∞ if it has told of nothing that old."""
        if not self.stamps or self.stamps[0] > since:
            return np.inf
        first = int(np.searchsorted(self.stamps, since))
        places = np.array(self.places[max(first - 1, 0) :])
        return float(np.abs(places - places[-1]).max())


class Observer:
    """Watches a team through its logs.

    Args:
        team: as everybody together knows it.
        start: (N, d) where the bodies begin.
        clock: what stamps count.
    """

    def __init__(self, team: Team, start: np.ndarray, clock: str) -> None:
        self.team, self.clock = team, clock
        self.seen = {agent: Seen() for agent in team.ids}
        self._start = start

    def take(self, events: Sequence[Event]) -> None:
        """Learn from events."""
        for event in events:
            if event.get("id") in self.seen:
                self.seen[event["id"]].take(event)

    def all_known(self) -> tuple[Knowledge, float | None]:
        """What all agents know, and since which stamp. Where some know that all that they can hear of are satisfied, and others that the
        team cannot be, it is infeasible."""
        known = [seen.known for seen in self.seen.values()]
        if None in known:
            return None, None
        return "infeasible" if "infeasible" in known else "satisfied", max(seen.known_from or 0.0 for seen in self.seen.values())

    def concluded(self) -> float | None:
        """Since which stamp all know all that there is to find, or None."""
        since = [seen.settled_from for seen in self.seen.values()]
        return None if None in since else max(stamp for stamp in since if stamp is not None)

    def settled(self, window: float, distance: float) -> bool:
        """Whether nobody has moved by more than `distance` over the last `window` of stamps, and all are up and heard."""
        if any(seen.report is None or not all(peer["up"] for peer in seen.report["peers"].values()) for seen in self.seen.values()):
            return False
        latest = min((seen.stamps[-1] if seen.stamps else -np.inf) for seen in self.seen.values())
        return all(seen.moved(latest - window) <= distance for seen in self.seen.values())

    def positions(self) -> np.ndarray:
        """(N, d) where the bodies are."""
        return np.array([seen.places[-1] if seen.places else start for seen, start in zip(self.seen.values(), self._start, strict=True)])

    def network(self) -> dict[str, Any]:
        """What the agents measured of the network, for the summary."""
        links, agents = [], {}
        for agent, seen in self.seen.items():
            report = seen.report or {}
            links += list(report.get("peers", {}).values())
            agents[agent] = {
                "sent": dict(seen.sent), "dropped": report.get("dropped", {}), "cpu": None if seen.ended is None else seen.ended.get("cpu"),
            }  # fmt: skip
        trips = [link["trip"] for link in links if link["trip"] is not None]
        return {
            "loss": float(np.mean([link["loss"] for link in links])) if links else None,
            "round_trip": float(np.median(trips)) if trips else None,
            "known_from": self._known_from(),
            "agents": agents,
        }

    def trace(self, copies: Estimates, nu: Nu, ending: Ending, seconds: Mapping[str, float]) -> Trace:
        """All of it as a trace. Positions between two stamps are those at the earlier one."""
        begin = self._begin()
        end = max((seen.stamps[-1] for seen in self.seen.values() if seen.stamps), default=0.0)
        if self.clock == "round":
            stamps = steps = np.arange(int(end) + 1, dtype=float)
        else:
            stamps = np.append(np.arange(begin, end, SAMPLE), end)
            steps = stamps - begin
        position = np.stack([self._along(seen, row, stamps) for seen, row in zip(self.seen.values(), self._start, strict=True)], axis=1)
        dt = 1.0 if self.clock == "round" else SAMPLE
        margins, smooth = map(np.asarray, _look(Objective.at_positions(self.team), jnp.asarray(position), nu))
        sent = sum((seen.sent for seen in self.seen.values()), Counter[str]())
        return Trace(
            clock="round" if self.clock == "round" else "time",
            steps=steps if self.clock == "time" else steps.astype(int),
            position=position,
            velocity=np.diff(position, axis=0, append=position[-1:]) / dt,
            margin=margins.min(axis=1),
            smooth_margin=smooth,
            agent_margin=margins,
            estimate=None,
            integral=None,
            holder=copies.holder,
            held=copies.position,
            cluster=copies.cluster,
            ending=ending,
            satisfied_from=satisfied_from(steps, margins.min(axis=1), interpolate=False),
            messages=sent["messages"],
            floats_sent=sent["floats"],
            known=self.all_known()[0],
            known_from=self._known_from(),
            seconds=seconds,
            violated=shares_of(self.team, position),
        )

    def _known_from(self) -> float | None:
        """Since which round all know it, or since how many s after the first stamp."""
        since = self.all_known()[1]
        if since is None:
            return None
        return int(since) if self.clock == "round" else since - self._begin()

    def _begin(self) -> float:
        """The first stamp."""
        return min((seen.stamps[0] for seen in self.seen.values() if seen.stamps), default=0.0)

    def _along(self, seen: Seen, start: np.ndarray, stamps: np.ndarray) -> np.ndarray:
        order = np.argsort(seen.stamps, kind="stable")
        known = np.array(seen.stamps, dtype=float)[order]
        places = np.concatenate([start[None], np.array(seen.places, dtype=float).reshape(-1, len(start))[order]])
        return places[np.searchsorted(known, stamps, side="right")]


@jax.jit
def _look(observer: Objective, position: jax.Array, nu: Nu) -> tuple[jax.Array, jax.Array]:
    """(T, N) ᾱ_i and (T,) β."""
    return jax.vmap(observer.agent_margins)(position), jax.vmap(lambda x: observer.smooth_margin(x, nu))(position)

"""From a part and a word, such as ``admm``, to an agent that runs: which core, which way of taking turns, what it asks of the transport."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol, get_args

import numpy as np

from consat.errors import InvalidSettings
from consat.network.node.body import Body
from consat.network.node.core import Embodied, RoundCore
from consat.network.node.link_core import LinkCore
from consat.network.node.lockstep import Lockstep
from consat.network.node.paced import Paced
from consat.network.node.pair_core import PairCore
from consat.network.node.part import RUNS, Part
from consat.network.node.station import REPORT, Log, Station
from consat.network.transports import Transport
from consat.protocols import PAIRED, ROUNDS, with_gains
from consat.protocols.sending import BEAT, SENDS, Sends

Mode = Literal["interior-point", "admm", "link", "lockstep"]
DEFAULT_MODE: Final = "interior-point"
RATE: Final = {"interior-point": 100.0, "admm": 100.0, "link": 50.0}
"""Turns a second where nobody says, Hz."""
HEARTBEAT: Final = 0.08
"""An agent is silent for so long at most, s: six messages on end must be lost before a neighbour takes it to be down."""


@dataclass(frozen=True)
class Manner:
    """How an agent runs.

    Attributes:
        mode: how it talks.
        rate: turns a second, Hz; in lockstep, at most so many. None for the mode's own.
        pace: of link, seconds of the protocol's time in each real one.
        turns: after how many it is done; None for never.
        memory: in lockstep, a file in which it keeps its state, so that a restart goes on where it was.
        give_up: a neighbour silent for so long, s, has left for good.
        report: time between two reports, s.
        sends: ``all``, or only what is news: ``events``, see `consat.protocols.sending`.
    """

    mode: Mode = DEFAULT_MODE
    rate: float | None = None
    pace: float = 1.0
    turns: int | None = None
    memory: Path | None = None
    give_up: float = np.inf
    report: float = REPORT
    sends: Sends = "all"

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise InvalidSettings(f"there is no mode {self.mode!r}; choose one of {', '.join(get_args(Mode))}")
        if self.memory is not None and self.mode != "lockstep":
            raise InvalidSettings(f"mode {self.mode} needs no memory to start anew; only lockstep takes a memory file")
        if self.sends not in SENDS:
            raise InvalidSettings(f"sends is {self.sends!r}, but must be one of {', '.join(SENDS)}")
        if self.sends == "events" and self.mode == "link":
            raise InvalidSettings("mode link integrates what it hears in time, and sends all; run another mode to send only what is news")
        if self.pace != 1.0 and self.mode != "link":
            raise InvalidSettings(f"mode {self.mode} has no time of its own; only link takes a pace")

    @property
    def beat(self) -> float | None:
        """Turns of silence after which an agent repeats itself, ∞ in lockstep; None where it sends all."""
        if self.sends == "all":
            return None
        return np.inf if self.mode == "lockstep" else min(float(BEAT), max(1.0, HEARTBEAT * (self.rate or RATE[self.mode]) // 1.0))

    @property
    def reliable(self) -> bool:
        """Whether the transport should rather wait than drop."""
        return self.mode == "lockstep"


class Runner(Protocol):
    """An agent that runs, one step after the other."""

    @property
    def station(self) -> Station:
        """Its neighbours, body and log."""
        ...

    @property
    def done(self) -> bool:
        """Whether it is."""
        ...

    def step(self) -> float:
        """Do what is due; when to be called again at the latest. To be called as well when a message has come."""
        ...

    def change(self, constraint: str, parameters: Mapping[str, Any]) -> None:
        """Go on with other parameters of an own constraint.

        Raises:
            InvalidTeam: they cannot be; nothing has changed.
            InvalidSettings: the mode does not allow it.
        """
        ...

    def leave(self) -> None:
        """Leave for good: the others go on without this agent's constraints."""
        ...


def protocol_of(mode: Mode, asked: str | None) -> str:
    """The kind of protocol that runs in a mode, where a scenario asks for one, or for none.

    Raises:
        InvalidSettings: the mode does not run the protocol that is asked for.
    """
    kind = asked or RUNS[mode]
    if mode == "link" and kind != RUNS["link"]:
        raise InvalidSettings(
            f"mode link runs the protocol {RUNS['link']}, but the protocol is {kind}; mode lockstep runs protocols in rounds"
        )
    if mode == "interior-point" and kind not in PAIRED:
        raise InvalidSettings(
            f"mode interior-point runs the protocols {' and '.join(PAIRED)}, but the protocol is {kind}; "
            "mode lockstep runs every protocol in rounds"
        )
    if mode == "admm" and kind != "admm":
        raise InvalidSettings(f"mode admm runs the protocol admm, but the protocol is {kind}; mode lockstep runs every protocol in rounds")
    if mode == "lockstep" and kind not in ROUNDS:
        raise InvalidSettings(f"mode lockstep runs protocols in rounds, {', '.join(ROUNDS)}, but the protocol is {kind}")
    return kind


def mode_for(kind: str | None) -> Mode:
    """How agents talk where nobody says, given the protocol that they are to run."""
    return "admm" if kind == "admm" else DEFAULT_MODE


def core_of(part: Part, manner: Manner) -> Embodied:
    """What the agent computes."""
    asked = part.settings.protocol
    kind = protocol_of(manner.mode, asked.kind)
    if manner.mode == "link":
        gains = {"k1": 1.0, "k2": 1.0} | {key: value for key in ("k1", "k2") if (value := getattr(asked, key)) is not None}
        return Embodied(LinkCore(part, gains["k1"] * manner.pace, gains["k2"] * manner.pace))
    protocol = with_gains(ROUNDS[kind](), asked)
    return Embodied(PairCore(protocol, part) if kind in PAIRED else RoundCore(protocol, part))


def runner_of(
    part: Part,
    manner: Manner,
    transport: Transport,
    *,
    clock: Callable[[], float],
    incarnation: int,
    body: Body,
    log: Log,
    core: Embodied | None = None,
    wall: Callable[[], float] = time.time,
) -> Runner:
    """An agent ready to run; its first step will begin. `core` is what `core_of` gives, if that is at hand; wall: Unix time, s."""
    lockstep = manner.mode == "lockstep"
    station = Station(
        part, core or core_of(part, manner), manner.mode, transport, clock=clock, incarnation=incarnation, body=body, log=log,
        frames=2 if lockstep else 1, stamped=lockstep, beat=manner.beat, give_up=manner.give_up, report=manner.report, wall=wall,
    )  # fmt: skip
    if lockstep:
        return Lockstep(station, turns=manner.turns, rate=manner.rate, memory=manner.memory)
    return Paced(station, manner.rate or RATE[manner.mode], manner.turns)

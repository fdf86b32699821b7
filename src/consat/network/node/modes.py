"""Build the runner of a node from its part and its mode, such as ``admm``: the core, the timing, and the transport's requirements."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol, get_args

import numpy as np

from consat.errors import InvalidSettings
from consat.network.node.body import Body
from consat.network.node.embodied import Embodied
from consat.network.node.fixed_rate import FixedRate
from consat.network.node.link_core import LinkCore
from consat.network.node.lockstep import Lockstep
from consat.network.node.pair_core import PairCore
from consat.network.node.part import RUNS, Part
from consat.network.node.round_core import RoundCore
from consat.network.node.station import REPORT, Log, Station
from consat.network.transports import Transport
from consat.protocols import PAIRED, ROUNDS, GradientFlow, with_gains
from consat.protocols.sending import BEAT
from consat.settings import Sends

Mode = Literal["interior-point", "admm", "link", "lockstep"]
DEFAULT_MODE: Final = "interior-point"
RATE: Final = {"interior-point": 100.0, "admm": 100.0, "link": 50.0}
"""Default rate of steps, Hz, for each mode."""
HEARTBEAT: Final = 0.08
"""Longest silence of an agent, s: a neighbour takes it to be down only if six messages in succession are lost."""


@dataclass(frozen=True)
class NodeSettings:
    """Settings of a runner.

    Attributes:
        mode: mode of communication.
        rate: steps per second, Hz; an upper limit in mode lockstep. None for the default of the mode.
        pace: in mode link, seconds of protocol time per second of real time.
        turns: number of steps after which the agent is done; None for no end.
        memory: in mode lockstep, a file for the state, from which a restarted agent continues; None for none.
        give_up: silence of a neighbour, s, after which it counts as having left for good.
        report: time between two reports, s.
        sends: ``all``, or only what is news: ``events``; see `consat.protocols.sending`.

    Raises:
        InvalidSettings: unknown mode, or a setting that does not apply to it.
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
        if self.sends not in get_args(Sends):
            raise InvalidSettings(f"sends is {self.sends!r}, but must be one of {', '.join(get_args(Sends))}")
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
        """Whether the transport should block instead of dropping messages."""
        return self.mode == "lockstep"


class Runner(Protocol):
    """An agent that runs step by step."""

    @property
    def station(self) -> Station:
        """The agent's station: neighbours, body and log."""
        ...

    @property
    def done(self) -> bool:
        """Whether the agent has finished."""
        ...

    def step(self) -> float:
        """Do what is due. Returns the latest time of the next call, by the station's clock, s. Call it also when a message arrives."""
        ...

    def change(self, constraint: str, parameters: Mapping[str, Any]) -> None:
        """Change parameters of one of the agent's own constraints.

        Args:
            constraint: name of the constraint.
            parameters: new values of its parameters.

        Raises:
            InvalidTeam: the values are invalid; nothing has changed.
            InvalidSettings: the mode does not allow changes.
        """
        ...

    def leave(self) -> None:
        """Leave the team for good: the others continue without this agent's constraints."""
        ...


def protocol_of(mode: Mode, asked: str | None) -> str:
    """The protocol that runs in a mode. `asked`: protocol of the scenario; None for the default of the mode.

    Raises:
        InvalidSettings: the mode does not support the protocol of the scenario.
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
    """Default mode for a protocol."""
    return "admm" if kind == "admm" else DEFAULT_MODE


def core_of(part: Part, settings: NodeSettings) -> Embodied:
    """Build the core of the agent: the protocol compiled for it."""
    asked = part.settings.protocol
    kind = protocol_of(settings.mode, asked.kind)
    if settings.mode == "link":
        gains = (1.0 if gain is None else gain for gain in (asked.k1, asked.k2))
        return Embodied(LinkCore(GradientFlow(*(gain * settings.pace for gain in gains)), part))
    protocol = with_gains(ROUNDS[kind](), asked)
    return Embodied(PairCore(protocol, part) if kind in PAIRED else RoundCore(protocol, part))


def runner_of(
    part: Part,
    settings: NodeSettings,
    transport: Transport,
    *,
    clock: Callable[[], float],
    incarnation: int,
    body: Body,
    log: Log,
    core: Embodied | None = None,
    wall: Callable[[], float] = time.time,
) -> Runner:
    """Build the runner of an agent, which starts with its first step.

    Args:
        part: the agent's part.
        settings: settings of the runner.
        transport: transport of the messages.
        clock: the agent's clock, s.
        incarnation: a number that is larger after each restart of the agent.
        body: sensor and actuator.
        log: function that takes events.
        core: result of `core_of`, if it was computed before.
        wall: Unix time, s.
    """
    lockstep = settings.mode == "lockstep"
    station = Station(
        part, core or core_of(part, settings), settings.mode, transport, clock=clock, incarnation=incarnation, body=body, log=log,
        lockstep=lockstep, beat=settings.beat, give_up=settings.give_up, report=settings.report, wall=wall,
    )  # fmt: skip
    if lockstep:
        return Lockstep(station, turns=settings.turns, rate=settings.rate, memory=settings.memory)
    return FixedRate(station, settings.rate or RATE[settings.mode], settings.turns)

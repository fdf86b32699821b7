"""The modes of communication, such as ``admm``: which protocols run in them, and the settings of an agent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np

from consat.errors import InvalidSettings
from consat.network.node.part import RUNS
from consat.protocols import PAIRED, ROUNDS
from consat.protocols.sending import BEAT
from consat.settings import Sends

Mode = Literal["interior-point", "admm", "link", "lockstep"]
DEFAULT_MODE: Final = "interior-point"
RATE: Final = {"interior-point": 100.0, "admm": 100.0, "link": 50.0}
"""Default rate of steps, Hz, for each mode."""
REPORT: Final = 0.1
"""Default time between two reports, s."""
HEARTBEAT: Final = 0.08
"""Longest silence of an agent, s: a neighbour takes it to be down only if six messages in succession are lost."""


@dataclass(frozen=True)
class NodeSettings:
    """Settings of an agent.

    Attributes:
        mode: mode of communication.
        rate: steps per second, Hz; an upper limit in mode lockstep. None for the default of the mode.
        pace: in mode link, seconds of protocol time per second of real time.
        turns: number of steps after which the agent is done; None for no end.
        memory: in mode lockstep, a file for the state, from which a restarted agent continues; None for none.
        give_up: silence of a neighbour, s, after which it counts as having left for good.
        report: time between two reports, s; 0 reports after each step.
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
    def period(self) -> float:
        """Shortest time between two steps, s; 0 without limit, in lockstep."""
        rate = self.rate or RATE.get(self.mode)
        return 0.0 if rate is None else 1.0 / rate

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

"""Build the runner of an agent from its part and its settings: the core, the station, and the timing."""

from __future__ import annotations

import time
from collections.abc import Callable

from consat.network.node.body import Body
from consat.network.node.embodied import Embodied
from consat.network.node.fixed_rate import FixedRate
from consat.network.node.link_core import LinkCore
from consat.network.node.lockstep import Lockstep
from consat.network.node.modes import NodeSettings, protocol_of
from consat.network.node.pair_core import PairCore
from consat.network.node.part import Part
from consat.network.node.round_core import RoundCore
from consat.network.node.runner import Runner
from consat.network.node.station import Log, Station
from consat.network.transports import Transport
from consat.protocols import PAIRED, ROUNDS, GradientFlow, with_gains


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
    core = core or core_of(part, settings)
    station = Station(part, core, settings, transport, clock=clock, incarnation=incarnation, body=body, log=log, wall=wall)
    return Lockstep(station) if settings.mode == "lockstep" else FixedRate(station)

"""Build what runs an agent, from its part and its settings: its core, then its station with this core, then its runner."""

from __future__ import annotations

from consat.network.node.embodied import Embodied
from consat.network.node.fixed_rate import FixedRate
from consat.network.node.link_core import LinkCore
from consat.network.node.lockstep import Lockstep
from consat.network.node.modes import NodeSettings, protocol_of
from consat.network.node.pair_core import PairCore
from consat.network.node.part import Part
from consat.network.node.round_core import RoundCore
from consat.network.node.runner import Runner
from consat.network.node.station import Station
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


def runner_of(station: Station) -> Runner:
    """Build the runner of an agent, which starts with its first step."""
    return Lockstep(station) if station.settings.mode == "lockstep" else FixedRate(station)

"""Protocols: functions of one agent's state, its own constraints and its neighbours' messages; interfaces in `base`.

Input: initial estimates, a `Solver` or a `Local` of the agent, received messages. Output: the agent's new state, and its messages. Each
protocol has a module that begins with its equations; add a new one to `FLOWS` or `ROUNDS`. Must not import `consat.engine` or
`consat.network`, which call it.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Final

from consat.errors import InvalidSettings
from consat.protocols.admm import Admm
from consat.protocols.base import Flow, Known, Links, Local, Rounds, Solver, State
from consat.protocols.gradient_flow import GradientFlow
from consat.protocols.interior_point import InteriorPoint, max_min
from consat.protocols.proportional_integral import ProportionalIntegral
from consat.protocols.proximal import Proximal
from consat.protocols.selfish import Selfish
from consat.settings import ProtocolSettings

FLOWS: Final[Mapping[str, Callable[[], Flow]]] = {flow.name: flow for flow in (GradientFlow, ProportionalIntegral, Selfish)}
"""Continuous-time protocols, by their name in ``--protocol``."""

ROUNDS: Final[Mapping[str, Callable[[], Rounds]]] = {
    "interior-point": InteriorPoint, "max-min": max_min, "admm": Admm, "proximal": Proximal,
}  # fmt: skip
"""Discrete-time protocols (rounds), by their name in ``--protocol``."""

PAIRED: Final = tuple(name for name, protocol in ROUNDS.items() if protocol().speaks == "pair")
"""Protocols that send one message per pair of neighbours instead of one per shared copy."""


def with_gains(protocol: Any, asked: ProtocolSettings) -> Any:
    """Replace the gains of `protocol` by those that the scenario sets. Raises: InvalidSettings: the protocol has no such gain."""
    gains = {key: value for key, value in asked.model_dump().items() if key not in ("kind", "estimates") and value is not None}
    if unknown := gains.keys() - {field.name for field in dataclasses.fields(protocol)}:
        raise InvalidSettings(f"protocol {asked.kind} has no gain {', '.join(sorted(unknown))}; leave it out")
    return dataclasses.replace(protocol, **gains)


__all__ = [
    "FLOWS", "PAIRED", "ROUNDS", "Admm", "Flow", "GradientFlow", "InteriorPoint", "Known", "Links", "Local", "ProportionalIntegral",
    "Proximal", "Rounds", "Selfish", "Solver", "State", "with_gains",
]  # fmt: skip

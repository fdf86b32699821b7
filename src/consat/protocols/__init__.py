"""The protocols, one a file with its equation first. To add one, write such a file and list it here."""

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
"""What ``--protocol`` may say of continuous time."""

ROUNDS: Final[Mapping[str, Callable[[], Rounds]]] = {
    "interior-point": InteriorPoint, "max-min": max_min, "admm": Admm, "proximal": Proximal,
}  # fmt: skip
"""What ``--protocol`` may say of rounds."""

PAIRED: Final = tuple(name for name, protocol in ROUNDS.items() if protocol().speaks == "pair")
"""Protocols that speak to each neighbour as a whole, not copy by copy."""


def with_gains(protocol: Any, asked: ProtocolSettings) -> Any:
    """The protocol with the gains that the scenario asks for. Raises: InvalidSettings: it has no such gain."""
    gains = {key: value for key, value in asked.model_dump().items() if key not in ("kind", "estimates") and value is not None}
    if unknown := gains.keys() - {field.name for field in dataclasses.fields(protocol)}:
        raise InvalidSettings(f"protocol {asked.kind} has no gain {', '.join(sorted(unknown))}; leave it out")
    return dataclasses.replace(protocol, **gains)


__all__ = [
    "FLOWS", "PAIRED", "ROUNDS", "Admm", "Flow", "GradientFlow", "InteriorPoint", "Known", "Links", "Local", "ProportionalIntegral",
    "Proximal", "Rounds", "Selfish", "Solver", "State", "with_gains",
]  # fmt: skip

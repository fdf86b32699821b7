"""The protocols, one a file with its equation first. To add one, write such a file and list it here."""

from collections.abc import Callable, Mapping
from typing import Final

from consat.protocols.base import Flow, Local, State
from consat.protocols.gradient_flow import GradientFlow
from consat.protocols.proportional_integral import ProportionalIntegral
from consat.protocols.selfish import Selfish

FLOWS: Final[Mapping[str, Callable[[], Flow]]] = {flow.name: flow for flow in (GradientFlow, ProportionalIntegral, Selfish)}
"""What ``--protocol`` may say."""

__all__ = ["FLOWS", "Flow", "GradientFlow", "Local", "ProportionalIntegral", "Selfish", "State"]

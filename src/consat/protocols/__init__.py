"""The protocols, one a file with its equation first. To add one, write such a file and list it here."""

from collections.abc import Callable, Mapping
from typing import Final

from consat.protocols.admm import Admm
from consat.protocols.base import Flow, Links, Local, Rounds, Solver, State
from consat.protocols.gradient_flow import GradientFlow
from consat.protocols.max_min import MaxMin
from consat.protocols.proportional_integral import ProportionalIntegral
from consat.protocols.proximal import Proximal
from consat.protocols.selfish import Selfish

FLOWS: Final[Mapping[str, Callable[[], Flow]]] = {flow.name: flow for flow in (GradientFlow, ProportionalIntegral, Selfish)}
"""What ``--protocol`` may say of continuous time."""

ROUNDS: Final[Mapping[str, Callable[[], Rounds]]] = {rounds.name: rounds for rounds in (Admm, Proximal, MaxMin)}
"""What ``--protocol`` may say of rounds."""

__all__ = [
    "FLOWS", "ROUNDS", "Admm", "Flow", "GradientFlow", "Links", "Local", "MaxMin", "ProportionalIntegral", "Proximal", "Rounds", "Selfish",
    "Solver", "State",
]  # fmt: skip

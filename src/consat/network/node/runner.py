"""`Runner`: an agent that runs step by step. `lockstep` and `fixed_rate` are the two ways to time its steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Final

from consat.network.node.station import Station

FAREWELLS: Final = 30
"""Number of messages in which a leaving agent announces it: enough under heavy message loss."""


class Runner(ABC):
    """An agent that runs step by step.

    Args:
        station: the agent's station: neighbours, body and log.

    Attributes:
        done: whether the agent has finished.
    """

    def __init__(self, station: Station) -> None:
        self.station, self.done = station, False
        self._state: Any = None  # of the core; None before the first step
        self._round = 0  # number of steps taken
        self._regrouped = 0  # `_round` at the last change of membership, from which a protocol counts its rounds
        self._farewells = 0

    @abstractmethod
    def step(self) -> float:
        """Do what is due. Returns the latest time of the next call, by the station's clock, s. Call it also when a message arrives."""

    @abstractmethod
    def change(self, constraint: str, parameters: Mapping[str, Any]) -> None:
        """Change parameters of one of the agent's own constraints.

        Args:
            constraint: name of the constraint.
            parameters: new values of its parameters.

        Raises:
            InvalidTeam: the values are invalid; nothing has changed.
            InvalidSettings: the mode does not allow changes.
        """

    def leave(self) -> None:
        """Leave the team for good: the others continue without this agent's constraints. It is announced in `FAREWELLS` messages."""
        self.station.membership.drop(self.station.part.me)
        self._farewells = FAREWELLS

    def _say_farewell(self) -> None:
        self._farewells -= 1
        self.done = self._farewells == 0
        self.station.send_hello()

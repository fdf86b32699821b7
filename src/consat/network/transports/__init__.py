"""`Transport`: the interface of an agent to the network. It sends bytes to neighbours and returns the bytes that they sent."""

from __future__ import annotations

from typing import Protocol


class Transport(Protocol):
    """The links of one agent to its neighbours. Messages may be lost, delayed, duplicated or reordered."""

    def send(self, neighbour: str, payload: bytes) -> None:
        """Send a message. Does not wait for delivery."""
        ...

    def receive(self) -> list[bytes]:
        """All messages from all neighbours since the last call. Does not wait. The queue is bounded; the oldest messages are dropped."""
        ...

    def wait(self, timeout: float) -> bool:
        """Wait until a message has arrived, at most `timeout`, s. Returns whether one has."""
        ...

    def alive(self) -> frozenset[str]:
        """The neighbours that are up, as far as the network knows."""
        ...

    def close(self) -> None:
        """Close the links. The neighbours see that this agent is down."""
        ...
